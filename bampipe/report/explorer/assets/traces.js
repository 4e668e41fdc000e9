// The traces of every trial along one axis of time, all with one view and one cursor.

const state = {
  view: [0, 1],
  cursor: null,
  models: new Set(),
  axis: "",
  mark: null,
};
const session = [content.trials[0]?.start ?? 0, content.trials.at(-1)?.stop ?? 1];
const colourOf = (model) => SERIES[model % SERIES.length];
const labelOf = (model) => content.models[model].label;
const axisOf = (name) => content.axes.find((one) => one.name === name);
const newestShown = () => Math.max(-1, ...state.models);

/** What can be traced: title, unit, and the channels with their looks. */
function traceable() {
  const found = [];
  for (const { name, noun, unit } of content.axes) {
    const [measured] = find({ role: "measured", axis: name });
    if (!measured) continue;
    const predicted = find({ role: "predicted", axis: name }).map((channel) => ({ channel, label: labelOf(channel.model), colour: colourOf(channel.model) }));
    const first = { channel: measured, label: "measured", colour: "faint", width: 3.5 };
    found.push({ id: `${noun} ${name}`, unit, axis: name, lines: [first, ...predicted] });
    const residual = find({ role: "residual", axis: name }).map((channel) => ({ channel, label: labelOf(channel.model), colour: colourOf(channel.model) }));
    found.push({ id: `residual ${name}`, unit, axis: name, residual: true, lines: residual });
  }
  for (const channel of [...find({ role: "motion" }), ...find({ role: "recorded" })]) {
    found.push({ id: channel.label, unit: channel.unit, lines: [{ channel, label: channel.label, colour: "blue" }] });
  }
  return found;
}

class Trace {
  constructor(host, described) {
    this.described = described;
    this.figure = new Figure(host, {
      title: described.id,
      yLabel: described.unit,
      height: described.residual || described.axis ? 190 : 140,
      label: `${described.id} against time; arrow keys move the cursor, plus and minus zoom`,
      sync: "session",
      yWidth: 62,
      select: (from, to) => setView(from, to),
      reset: () => setView(...session),
      hover: (x) => setCursor(x),
      xTicks: timeTicks,
      keys: traceKeys,
      resized: () => this.draw(),
      table: () => this.table(),
    });
    followTouch(this.figure.canvas);
  }

  /** The lines of the model versions that are shown. */
  lines() {
    return this.described.lines.filter(({ channel }) => channel.model === undefined || state.models.has(channel.model));
  }

  load() {
    return Promise.all(this.described.lines.map(({ channel }) => channel.load()));
  }

  draw() {
    const lines = this.lines();
    const grid = this.described.lines[0].channel.on;
    if (!grid.x || lines.some(({ channel }) => !channel.values)) return;
    const pixels = this.figure.width * devicePixelRatio;
    const { dense, columns } = reduce(grid, lines.map((line) => line.channel), ...state.view, pixels);
    const [x, ...values] = columns;
    this.figure.show({
      x,
      dense,
      lines: lines.map((line, k) => ({ ...line, values: values[k] })),
      behind: this.behind(),
      xRange: state.view,
    });
    this.read();
  }

  behind() {
    const starts = content.trials.slice(1).map((trial) => ({ kind: "rule", x: trial.start - 0.25, colour: "faint", dash: [3, 3] }));
    const marked = state.mark ? [{ kind: "spans", values: state.mark.spans, colour: "orange", alpha: 0.3 }] : [];
    const window = state.window && (!this.described.axis || this.described.axis === state.window.axis)
      ? [{ kind: "spans", values: [state.window.span], colour: "purple", alpha: 0.16 }]
      : [];
    if (!this.described.residual) return [...marked, ...window, ...starts];
    const floor = content.models[newestShown()]?.validate?.axes[this.described.axis]?.noise_floor;
    const levels = floor ? [{ kind: "band", x: session, low: [-2 * floor, -2 * floor], high: [2 * floor, 2 * floor], colour: "green", alpha: 0.14, label: "± 2 noise floors" }] : [];
    return [...levels, ...marked, ...window, { kind: "rule", y: 0, colour: "faint" }, ...starts];
  }

  /** Values at the cursor, as text. */
  readings() {
    const lines = this.lines();
    const grid = this.described.lines[0].channel.on;
    if (state.cursor === null || !grid.x) return null;
    const i = grid.nearest(state.cursor);
    return lines.map(({ channel }) => (channel.values ? format(channel.values[i]) : ""));
  }

  read() {
    this.figure.read(this.readings());
  }

  table() {
    const grid = this.described.lines[0].channel.on;
    const lines = this.lines();
    const rows = [];
    for (const [a, b] of grid.segments(...state.view)) {
      for (let i = a; i < b; i++) {
        if (grid.x[i] < state.view[0] || grid.x[i] > state.view[1]) continue;
        const { trial, time } = placeOf(grid.x[i]);
        rows.push([trial.id, time.toFixed(6), ...lines.map(({ channel }) => channel.values[i])]);
      }
    }
    const unit = this.described.unit ? ` (${this.described.unit})` : "";
    return { head: ["trial", "t (s)", ...lines.map((line) => `${line.label}${unit}`)], rows };
  }
}

/** Ticks of the time: of the trial where one is in view, else the trials' names. */
function timeTicks(min, max, width) {
  const seen = content.trials.filter((trial) => trial.stop > min && trial.start < max);
  if (seen.length === 1) {
    const { offset } = seen[0];
    const rough = ((max - min) * 75) / width;
    const decade = 10 ** Math.floor(Math.log10(rough));
    const step = decade * [1, 2, 5, 10].find((one) => one * decade >= rough);
    const splits = [];
    for (let k = Math.ceil((min - offset) / step); k * step + offset <= max; k++) splits.push(k * step + offset);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    return { splits, texts: splits.map((at) => `${(at - offset).toFixed(digits)} s`) };
  }
  const longest = Math.max(...seen.map((trial) => trial.id.length));
  const most = Math.max(1, Math.floor(width / Math.max(90, 7.5 * longest)));
  const every = Math.ceil(seen.length / most);
  const named = seen.filter((_, k) => k % every === 0);
  const middle = (trial) => (Math.max(trial.start, min) + Math.min(trial.stop, max)) / 2;
  return { splits: named.map(middle), texts: named.map((trial) => trial.id) };
}

const traces = new Map();

function drawTraces() {
  performance.mark("zoom");
  for (const trace of traces.values()) trace.draw();
  performance.measure("zoom", "zoom");
}

/** Show the session from one time to another. */
function setView(from, to) {
  const least = 0.002 * Math.min(1, session[1] - session[0]);
  let [a, b] = from < to ? [from, to] : [to, from];
  if (b - a < least) [a, b] = [(a + b - least) / 2, (a + b + least) / 2];
  const width = Math.min(b - a, session[1] - session[0]);
  const start = Math.max(session[0], Math.min(a, session[1] - width));
  state.view = [start, start + width];
  drawTraces();
  viewChanged();
}

/** Zoom about the cursor, or about the middle, and move by a share of the view. */
function zoom(factor, shift = 0) {
  const [from, to] = state.view;
  const inside = state.cursor !== null && state.cursor >= from && state.cursor <= to;
  const centre = inside ? state.cursor : (from + to) / 2;
  const by = shift * (to - from);
  setView(centre + (from - centre) * factor + by, centre + (to - centre) * factor + by);
}

/** Show the trial before or after the one in view. */
function stepTrial(step) {
  const middle = (state.view[0] + state.view[1]) / 2;
  const all = state.view[1] - state.view[0] > 0.999 * (session[1] - session[0]);
  const now = all ? (step > 0 ? -1 : content.trials.length) : content.trials.indexOf(placeOf(middle).trial);
  showTrial(content.trials[Math.max(0, Math.min(content.trials.length - 1, now + step))]);
}

function showTrial(trial) {
  setView(trial.start, trial.stop);
}

function traceKeys(event) {
  const [from, to] = state.view;
  const by = (sign) => {
    if (event.shiftKey) return zoom(1, 0.2 * sign);
    const grid = traces.values().next().value.described.lines[0].channel.on;
    const step = Math.max((to - from) / 200, 1e-9);
    const start = state.cursor ?? (from + to) / 2;
    const next = Math.min(to, Math.max(from, start + sign * step));
    setCursor(grid.x[grid.nearest(next)] === state.cursor ? next : grid.x[grid.nearest(next)], true);
  };
  const actions = {
    ArrowLeft: () => by(-1),
    ArrowRight: () => by(1),
    "+": () => zoom(0.5),
    "=": () => zoom(0.5),
    "-": () => zoom(2),
    0: () => setView(...session),
    PageUp: () => stepTrial(-1),
    PageDown: () => stepTrial(1),
    n: () => stepWindow(1),
    p: () => stepWindow(-1),
    Escape: () => setMark(null),
  };
  const action = event.ctrlKey || event.metaKey || event.altKey ? undefined : actions[event.key];
  if (!action) return;
  event.preventDefault();
  action();
}

/** One finger moves the view, two zoom. */
function followTouch(element) {
  const fingers = new Map();
  const over = () => traces.values().next().value.figure.area();
  const timeAt = (clientX) => {
    const { left, width } = over();
    const x = clientX - element.getBoundingClientRect().left - left;
    return state.view[0] + (x / width) * (state.view[1] - state.view[0]);
  };
  element.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "touch") fingers.set(event.pointerId, event.clientX);
  });
  element.addEventListener("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const before = [...fingers.values()];
    fingers.set(event.pointerId, event.clientX);
    const after = [...fingers.values()];
    const [from, to] = state.view;
    if (after.length === 1) {
      const by = timeAt(before[0]) - timeAt(after[0]);
      setView(from + by, to + by);
    } else if (after.length === 2 && Math.abs(after[0] - after[1]) > 10) {
      const factor = Math.abs(before[0] - before[1]) / Math.abs(after[0] - after[1]);
      const centre = timeAt((after[0] + after[1]) / 2);
      setView(centre + (from - centre) * factor, centre + (to - centre) * factor);
    }
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
    element.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
}
