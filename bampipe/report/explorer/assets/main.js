// State that all figures share: the view, the cursor, the mark, the versions shown.

let waiting = 0;

/** Draw what follows the view once it rests. */
function viewChanged() {
  clearTimeout(waiting);
  waiting = setTimeout(() => {
    drawMaps();
    drawStructure();
    drawPose();
  }, 120);
}

/** Put the cursor at a time along the session; `spoken` says it to screen readers. */
function setCursor(time, spoken = false, drawn = spoken) {
  state.cursor = time;
  for (const trace of traces.values()) {
    trace.read();
    if (drawn) trace.figure.pointAt(time);
  }
  for (const map of maps.values()) map.point();
  drawPose();
  if (!spoken || time === null) return;
  const { trial, time: local } = placeOf(time);
  const values = [...traces.values()].map((trace) => {
    const lines = trace.lines();
    return `${trace.described.id}: ${trace.readings().map((text, k) => `${lines[k].label} ${text}`).join(", ")}`;
  });
  document.getElementById("reading").textContent = `${trial.id}, ${format(local)} s. ${values.join(". ")}.`;
}

function setMark(mark) {
  state.mark = mark?.rows.size ? mark : null;
  const place = document.getElementById("marked");
  place.hidden = !mark;
  if (mark) {
    const clear = make("button", { type: "button", onclick: () => setMark(null) }, "Remove the mark");
    place.replaceChildren(`${mark.rows.size} samples marked: ${mark.words}. `, clear);
  }
  drawTraces();
  drawMaps();
}

/** Show one of the worst windows with as much again to either side. */
function showWindow(window) {
  const trial = content.trials.find((one) => one.id === window.trial_id);
  if (!trial) return;
  const [from, to] = [window.t_start + trial.offset, window.t_end + trial.offset];
  state.window = { axis: window.axis, span: [from, to] };
  document.getElementById("window").value = String(content.windows.indexOf(window));
  if (window.axis !== state.axis) setAxis(window.axis);
  const width = Math.max(to - from, 1e-3);
  setView(from - 1.5 * width, to + 1.5 * width);
}

function stepWindow(step) {
  const chosen = document.getElementById("window");
  if (!chosen) return;
  const now = chosen.value === "" ? -1 : Number(chosen.value);
  const count = content.windows.length;
  showWindow(content.windows[(Math.max(now, step > 0 ? -1 : 0) + step + count) % count]);
}

async function setAxis(axis) {
  const before = state.axis;
  state.axis = axis;
  document.querySelectorAll('[name="axis"]').forEach((one) => (one.checked = one.value === axis));
  const follows = (id) => traces.has(id) || (id === `velocity ${axis}` && traces.has(`velocity ${before}`));
  const chosen = traceable().filter(
    (one) => one.axis === axis || (one.axis !== before && one.id !== `velocity ${before}` && follows(one.id)),
  );
  await showTraces(new Set(chosen.map((one) => one.id)));
  buildStructure();
  await buildMaps();
  drawStructure();
}

/** Trace these, in the order of the list. */
async function showTraces(names) {
  const host = document.getElementById("plots");
  for (const [name, trace] of traces) {
    if (!names.has(name)) {
      trace.figure.destroy();
      traces.delete(name);
    }
  }
  const wanted = traceable().filter((one) => names.has(one.id));
  const all = wanted.map((described) => traces.get(described.id) ?? new Trace(host, described));
  traces.clear();
  for (const trace of all) {
    traces.set(trace.described.id, trace);
    host.append(trace.figure.root);
  }
  document.querySelectorAll('[name="trace"]').forEach((one) => (one.checked = names.has(one.value)));
  await Promise.all(all.map((trace) => trace.load()));
  drawTraces();
}

function choice(type, name, value, text, checked, act, colour = null) {
  const input = make("input", { type, name, value, checked });
  input.addEventListener("change", () => act(input));
  const swatch = colour ? make("span", { class: "swatch", style: `border-color: var(--${colour})` }) : null;
  return make("label", {}, input, swatch, text);
}

function group(title, ...children) {
  return make("fieldset", {}, make("legend", {}, title), make("div", { class: "choices" }, ...children));
}

function buildControls() {
  const host = document.getElementById("controls");
  const button = (text, label, act) => make("button", { type: "button", "aria-label": label, onclick: act }, text);
  const trials = make("select", { "aria-label": "Trial" }, make("option", { value: "" }, "all trials"), ...content.trials.map((trial, k) => make("option", { value: String(k) }, trial.id)));
  trials.addEventListener("change", () => (trials.value === "" ? setView(...session) : showTrial(content.trials[Number(trials.value)])));
  host.append(
    group(
      "View",
      trials,
      button("◀", "Trial before", () => stepTrial(-1)),
      button("▶", "Trial after", () => stepTrial(1)),
      button("+", "Zoom in", () => zoom(0.5)),
      button("−", "Zoom out", () => zoom(2)),
      button("All", "Show all", () => setView(...session)),
    ),
  );
  if (content.windows.length) {
    const windows = make("select", { id: "window", "aria-label": "Worst window" }, make("option", { value: "" }, "choose"), ...content.windows.map((one, k) => make("option", { value: String(k) }, `${one.axis}, ${one.trial_id}, ${format(one.t_start, 3)} s: ${format(one.rmse, 3)} ${one.unit} (${labelOf(one.model)})`)));
    windows.addEventListener("change", () => windows.value !== "" && showWindow(content.windows[Number(windows.value)]));
    windows.style.maxWidth = "min(22rem, 86vw)";
    host.append(group("Worst windows", windows, button("▶", "Next worst window", () => stepWindow(1))));
  }
  if (content.models.length) {
    const toggle = (input) => {
      const model = Number(input.value);
      if (input.checked) state.models.add(model);
      else state.models.delete(model);
      drawTraces();
      drawMaps();
      drawStructure();
      drawCorrelations();
    };
    host.append(
      group("Model versions", ...content.models.map((model, k) => choice("checkbox", "model", String(k), model.added ? `${model.label} (+ ${model.added})` : model.label, true, toggle, colourOf(k)))),
    );
  }
  if (content.models.length > 1) {
    const { label, name } = content.models[content.shown];
    host.append(make("p", { class: "remark counts" }, `${label === name ? name : `${label} (${name})`} is the version that the report shows.`));
  }
  const axes = content.axes.filter(({ name }) => find({ role: "measured", axis: name }).length);
  if (axes.length > 1) {
    host.append(group("Axis", ...axes.map(({ name }) => choice("radio", "axis", name, name, false, () => setAxis(name)))));
  }
  const toggled = () => showTraces(new Set([...document.querySelectorAll('[name="trace"]:checked')].map((one) => one.value)));
  host.append(
    make("details", {}, make("summary", {}, "More traces"), group("", ...traceable().map((one) => choice("checkbox", "trace", one.id, one.id, false, toggled)))),
  );
}

function showVerdict() {
  const plain = (words) => words.replace(/[*`]/g, "");
  const callouts = content.callouts.map(({ tone, title, lines }) => make("div", { class: `callout ${tone}` }, make("p", { class: "title" }, plain(title)), ...lines.map((line) => make("p", {}, plain(line)))));
  document.getElementById("verdict").append(...callouts);
}

/** The axis whose error stands highest over its floor. */
function worstAxis() {
  const ratio = (axis) => {
    const rung = content.ladder[axis]?.[0];
    return rung?.floor ? rung.error / rung.floor : 0;
  };
  return content.axes.map((one) => one.name).sort((a, b) => ratio(b) - ratio(a))[0];
}

function repaint() {
  const figures = [...traces.values(), ...maps.values()].map((one) => one.figure);
  for (const figure of [...figures, ...Object.values(structure), ...ladders]) figure.repaint();
}

async function start() {
  content.models.forEach((_, k) => state.models.add(k));
  showVerdict();
  buildEffects();
  buildTables();
  if (!content.trials.length) {
    document.getElementById("plots").append(make("p", {}, "No trial of this session could be used: the table of trials gives the reasons."));
    document.documentElement.dataset.complete = String(Math.round(performance.now()));
    return;
  }
  state.view = [...session];
  buildControls();
  buildLadder();
  buildParameterMap();
  drawCorrelations();
  const axis = worstAxis();
  const velocity = `velocity ${axis}`;
  const first = traceable().filter((one) => one.axis === axis || one.id === velocity);
  const shown = first.length ? first : traceable().slice(0, 8);
  state.axis = axis;
  document.querySelectorAll('[name="axis"]').forEach((one) => (one.checked = one.value === axis));
  await showTraces(new Set(shown.map((one) => one.id)));
  document.documentElement.dataset.ready = String(Math.round(performance.now()));
  await buildPose();
  buildStructure();
  await buildMaps();
  drawStructure();
  document.documentElement.dataset.complete = String(Math.round(performance.now()));
}

for (const media of ["(prefers-color-scheme: dark)", "print"]) {
  window.matchMedia(media).addEventListener("change", repaint);
}
start();
