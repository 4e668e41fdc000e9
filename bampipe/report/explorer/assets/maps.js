// Residual maps: every sample against possible causes of its residual, linked with the traces.

const MOST_DOTS = 6000;
const MOST_MAPS = 6;
const maps = new Map();

/** The samples of one axis: rows in motion, their residual by the newest version shown. */
function samplesOf(axis) {
  const residuals = find({ role: "residual", axis }).filter((one) => state.models.has(one.model));
  const channel = residuals.at(-1);
  if (!channel?.values) return null;
  const moving = find({ role: "moving", axis })[0]?.values;
  const rows = [];
  for (let i = 0; i < channel.values.length; i++) {
    if (!Number.isNaN(channel.values[i]) && (!moving || moving[i] > 0.5)) rows.push(i);
  }
  return { channel, rows, residual: channel.values, x: channel.on.x };
}

/** The variables that the residual of an axis was mapped against, those that carry most first. */
function variablesOf(axis) {
  const shares = new Map();
  for (const one of content.maps.filter((map) => map.axis === axis)) {
    shares.set(one.variable, { share: Math.max(one.variance_share, shares.get(one.variable)?.share ?? 0), unit: one.unit });
  }
  return [...shares].map(([variable, rest]) => ({ variable, ...rest })).sort((a, b) => b.share - a.share);
}

/** Lowest and highest value, a share of the outermost left out. */
function rangeOf(values, outside = 0) {
  const sorted = Float64Array.from(values).filter(Number.isFinite).sort();
  if (!sorted.length) return [0, 1];
  const low = sorted[Math.floor(outside * (sorted.length - 1))];
  const high = sorted[Math.ceil((1 - outside) * (sorted.length - 1))];
  const margin = 0.04 * (high - low) || Math.abs(high) || 1;
  return [low - margin, high + margin];
}

class ResidualMap {
  constructor(host, axis, { variable, unit, share }) {
    this.axis = axis;
    this.variable = variable;
    [this.channel] = find({ role: "variable", axis, label: variable });
    const percent = Math.round(100 * share);
    this.figure = new Figure(host, {
      title: `residual ${axis} by ${variable}`,
      xLabel: unit ? `${variable} (${unit})` : variable === "trial" ? "trial, from 0" : variable,
      yLabel: axisOf(axis).unit,
      height: 210,
      rectangle: true,
      label: `Residual of ${axis} against ${variable}, which carries ${percent} % of its variance; arrow keys mark a strip of it, with Shift they widen and narrow it`,
      select: (x0, x1, y0, y1) => this.mark(x0, x1, y0, y1),
      reset: () => setMark(null),
      hover: (x, y) => this.hover(x, y),
      keys: (event) => this.keys(event),
      table: () => this.table(),
    });
  }

  load() {
    return this.channel?.load();
  }

  draw() {
    const samples = samplesOf(this.axis);
    const behind = [];
    let xs = [];
    this.samples = samples;
    if (samples && this.channel?.values) {
      const values = this.channel.values;
      const every = Math.ceil(samples.rows.length / MOST_DOTS);
      const groups = { away: [], seen: [], marked: [] };
      samples.rows.forEach((row, k) => {
        const marked = state.mark?.rows.has(row);
        if ((k % every && !marked) || Number.isNaN(values[row])) return;
        const inView = samples.x[row] >= state.view[0] && samples.x[row] <= state.view[1];
        groups[marked ? "marked" : inView ? "seen" : "away"].push([values[row], samples.residual[row]]);
      });
      xs = samples.rows.map((row) => values[row]).filter(Number.isFinite);
      const colour = colourOf(samples.channel.model);
      behind.push(
        { kind: "dots", points: groups.away, colour: "faint", alpha: 0.45 },
        { kind: "dots", points: groups.seen, colour, alpha: 0.55 },
        { kind: "dots", points: groups.marked, colour: "orange", alpha: 1, radius: 2 },
      );
    }
    behind.push({ kind: "rule", y: 0, colour: "muted" });
    const drawn = content.maps.filter((one) => one.axis === this.axis && one.variable === this.variable && state.models.has(one.model));
    for (const one of drawn) {
      const colour = colourOf(one.model);
      behind.push({ kind: "band", x: one.center, low: one.low, high: one.high, colour, alpha: 0.28 });
      behind.push({ kind: "curve", x: one.center, y: one.mean, colour, label: labelOf(one.model) });
    }
    const residual = samples ? samples.rows.map((row) => samples.residual[row]) : [];
    const edges = drawn.flatMap((one) => [...one.low, ...one.high]);
    const [low, high] = residual.length ? rangeOf(residual, 0.002) : [0, 0];
    const yRange = rangeOf([low, high, ...edges]);
    const xRange = rangeOf(xs.length ? xs : drawn.flatMap((one) => one.center));
    this.range = xRange;
    this.figure.show({ x: xRange, lines: [], behind, xRange, yRange });
    this.figure.drawKey();
  }

  mark(x0, x1, y0, y1) {
    const { samples, channel } = this;
    if (!samples || !channel?.values) return;
    const rows = samples.rows.filter((row) => {
      const [x, y] = [channel.values[row], samples.residual[row]];
      return x >= x0 && x <= x1 && y >= y0 && y <= y1;
    });
    const within = (low, high, unit) => (Number.isFinite(low) ? `${format(low, 3)} to ${format(high, 3)}${unit ? ` ${unit}` : ""}` : "any");
    const unit = variablesOf(this.axis).find((one) => one.variable === this.variable)?.unit;
    const words = `${this.variable} of ${this.axis} ${within(x0, x1, unit)}, residual ${within(y0, y1, axisOf(this.axis).unit)}`;
    setMark({ rows: new Set(rows), spans: spansOf(rows, samples.channel.on), words });
  }

  /** Mark a strip by keyboard, at first a tenth of the map: arrows move it by half its width. */
  keys(event) {
    const sign = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || (!sign && event.key !== "Escape")) return;
    event.preventDefault();
    if (!sign) {
      this.strip = null;
      return setMark(null);
    }
    const [low, high] = this.range;
    const first = { middle: sign > 0 ? low : high, width: 0.1 * (high - low) };
    let { middle, width } = this.strip ?? first;
    if (event.shiftKey) width *= sign > 0 ? 1.5 : 1 / 1.5;
    else middle = Math.min(high, Math.max(low, middle + (sign * width) / 2));
    this.strip = { middle, width };
    this.mark(middle - width / 2, middle + width / 2, -Infinity, Infinity);
  }

  hover(x, y) {
    const { samples, channel } = this;
    if (x === null || !samples || !channel?.values) return setCursor(null, false, true);
    const { plot } = this.figure;
    const [px, py] = [plot.valToPos(x, "x"), plot.valToPos(y, "y")];
    let best = Infinity;
    let found = -1;
    for (const row of samples.rows) {
      const dx = plot.valToPos(channel.values[row], "x") - px;
      const dy = plot.valToPos(samples.residual[row], "y") - py;
      const distance = dx * dx + dy * dy;
      if (distance < best) [best, found] = [distance, row];
    }
    if (found >= 0 && best < 400) setCursor(samples.x[found], false, true);
  }

  /** Show where the sample at the cursor lies. */
  point() {
    const { samples, channel } = this;
    if (state.cursor === null || !samples || !channel?.values) return this.figure.ringAt(null);
    const row = samples.channel.on.nearest(state.cursor);
    this.figure.ringAt(channel.values[row], samples.residual[row]);
  }

  table() {
    const { samples, channel } = this;
    if (!samples || !channel?.values) {
      const bins = content.maps.filter((one) => one.axis === this.axis && one.variable === this.variable).at(-1);
      return { head: [this.variable, "mean", "low", "high"], rows: bins.center.map((x, i) => [x, bins.mean[i], bins.low[i], bins.high[i]]) };
    }
    const rows = samples.rows.map((row) => {
      const { trial, time } = placeOf(samples.x[row]);
      return [trial.id, time.toFixed(6), channel.values[row], samples.residual[row], state.mark ? Number(state.mark.rows.has(row)) : ""];
    });
    return { head: ["trial", "t (s)", this.variable, `residual ${labelOf(samples.channel.model)}`, "marked"], rows };
  }
}

/** Rows of a grid as stretches of time, half a sample to either side. */
function spansOf(rows, grid) {
  const found = [];
  const ends = new Set(grid.ends);
  const half = grid.length > 1 ? 0.5 * (grid.x[1] - grid.x[0]) : 0.01;
  let last = -2;
  for (const row of rows) {
    if (row === last + 1 && !ends.has(row)) found.at(-1)[1] = grid.x[row] + half;
    else found.push([grid.x[row] - half, grid.x[row] + half]);
    last = row;
  }
  return found;
}

async function buildMaps() {
  const host = document.getElementById("map-figures");
  for (const map of maps.values()) map.figure.destroy();
  maps.clear();
  host.replaceChildren();
  const variables = variablesOf(state.axis);
  if (!variables.length) {
    host.append(make("p", { class: "remark" }, `No diagnosis of ${state.axis} yet: run bampipe diagnose ${content.session}.`));
    return;
  }
  const add = (one) => maps.set(one.variable, new ResidualMap(host, state.axis, one));
  variables.slice(0, MOST_MAPS).forEach(add);
  if (variables.length > MOST_MAPS) {
    const rest = variables.slice(MOST_MAPS);
    const more = make("button", { type: "button" }, `${rest.length} more maps`);
    more.addEventListener("click", async () => {
      more.remove();
      rest.forEach(add);
      await loadMaps();
      drawMaps();
    });
    host.append(more);
  }
  await loadMaps();
  drawMaps();
}

const loadMaps = () =>
  Promise.all([
    ...find({ role: "residual", axis: state.axis }).map((one) => one.load()),
    ...find({ role: "moving", axis: state.axis }).map((one) => one.load()),
    ...[...maps.values()].map((map) => map.load()),
  ]);

function drawMaps() {
  for (const map of maps.values()) map.draw();
}
