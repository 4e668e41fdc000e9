// Spectrum and correlation of the samples in view; the ladder; parameters by version.

const structure = {};
const ladders = [];
const LAGS_S = 1;
const FAINTEST = 1e-10;
const NAME_PX = 150; // room for the name of a variable in one line

/** Make the figures of the axis in question anew. */
function buildStructure() {
  const host = document.getElementById("structure-figures");
  for (const figure of Object.values(structure)) figure.destroy();
  const { axis } = state;
  const { noun, unit } = axisOf(axis);
  structure.spectrum = new Figure(host, {
    title: `power spectrum ${axis}`, xLabel: "frequency (Hz)", yLabel: `(${unit})²/Hz`, height: 240, logX: true, logY: true,
    label: `Power spectrum of the ${noun} of ${axis} and of its residual, in view`,
  });
  structure.lags = new Figure(host, {
    title: `autocorrelation of the residual ${axis}`, xLabel: "lag (s)", yLabel: "correlation", height: 240,
    label: `Autocorrelation of the residual of ${axis} in view, with 95 % bounds`,
  });
  delete structure.causes;
  if (!variablesOf(axis).length) return; // variables come with the maps of a diagnosis
  structure.causes = new Figure(host, {
    title: `residual ${axis}: correlation with motion and load`, xLabel: "the strongest first; all of them in the CSV", yLabel: "correlation", height: 260,
    label: `Correlation of the residual of ${axis} in view with each variable, with 95 % intervals`,
    xTicks: (_min, _max, width) => {
      const { names } = structure.causes;
      // Words below each other where they would run into the next name.
      const narrow = width < NAME_PX * names.length;
      return { splits: names.map((_, k) => k), texts: names.map((name) => (narrow ? name.replaceAll(" ", "\n") : name)) };
    },
    table: () => structure.causes.found,
  });
  structure.causes.names = [];
}

function drawStructure() {
  const { axis, view } = state;
  const residuals = find({ role: "residual", axis }).filter((one) => state.models.has(one.model) && one.values);
  const [measured] = find({ role: "measured", axis });
  if (!residuals.length || !measured?.values) return;
  const { x } = measured.on;
  const rate = 1 / Math.max(1e-9, x[1] - x[0]);
  const sources = [{ channel: measured, label: "measured", colour: "ink" }, ...residuals.map((channel) => ({ channel, label: `residual, ${labelOf(channel.model)}`, colour: colourOf(channel.model) }))];
  const spectra = sources.map((source) => spectrum(pieces(source.channel, ...view), rate));
  const { frequency } = spectra[0];
  // The remainder of a filtered density far beyond the band has no place on a logarithmic axis.
  const least = FAINTEST * Math.max(...spectra.flatMap((one) => one.density));
  if (frequency.length) {
    structure.spectrum.show({
      x: frequency,
      lines: sources.map((source, k) => ({ ...source, values: spectra[k].density.map((v) => (v > least ? v : null)) })),
      xRange: [frequency[0], frequency.at(-1)],
    });
  }
  const most = Math.max(2, Math.round(LAGS_S * rate));
  const lagged = residuals.map((channel) => autocorrelation(pieces(channel, ...view), most));
  if (lagged.every((one) => one.n > most)) {
    const lag = Array.from({ length: most + 1 }, (_, k) => k / rate);
    const newest = lagged.at(-1);
    const half = bartlett(newest.values, newest.n);
    structure.lags.show({
      x: lag,
      lines: residuals.map((channel, k) => ({ label: labelOf(channel.model), colour: colourOf(channel.model), values: lagged[k].values })),
      behind: [
        { kind: "band", x: lag.slice(1), low: half.slice(1).map((v) => -v), high: half.slice(1), colour: "faint", alpha: 0.35, label: "95 % bounds, were it zero from that lag on" },
        { kind: "rule", y: 0, colour: "faint" },
      ],
      xRange: [0, lag.at(-1)],
      yRange: [-1.05, 1.05],
    });
    structure.lags.drawKey();
  }
  if (structure.causes) drawCauses(residuals.at(-1));
}

/** The correlation of one residual with each variable of the maps. */
function drawCauses(channel) {
  const { axis, view } = state;
  const moving = find({ role: "moving", axis })[0]?.values;
  const known = variablesOf(axis).map(({ variable }) => find({ role: "variable", axis, label: variable })[0]);
  const found = [];
  for (const variable of known) {
    if (!variable?.values || variable.label === "trial") continue;
    const [a, b] = [[], []];
    for (const [start, stop] of channel.on.segments(...view)) {
      for (let i = start; i < stop; i++) {
        if ((moving && moving[i] < 0.5) || Number.isNaN(channel.values[i]) || Number.isNaN(variable.values[i])) continue;
        a.push(channel.values[i]);
        b.push(variable.values[i]);
      }
    }
    const result = correlate(Float64Array.from(a), Float64Array.from(b));
    if (result) found.push({ name: variable.label, ...result });
  }
  found.sort((p, q) => Math.abs(q.value) - Math.abs(p.value));
  const best = found.slice(0, Math.max(2, Math.floor(structure.causes.width / 110)));
  structure.causes.names = best.map((one) => one.name);
  structure.causes.found = { head: ["variable", "correlation", "low", "high"], rows: found.map((one) => [one.name, one.value, one.low, one.high]) };
  const x = best.map((_, k) => k);
  const colour = colourOf(channel.model);
  structure.causes.show({
    x,
    lines: [{ label: labelOf(channel.model), colour, values: best.map((one) => one.value), width: 0, points: true }],
    behind: [
      { kind: "rule", y: 0, colour: "muted" },
      { kind: "whiskers", x, low: best.map((one) => one.low), high: best.map((one) => one.high), colour },
    ],
    xRange: [-0.6, best.length - 0.4],
    yRange: [-1.05, 1.05],
  });
}

function buildLadder() {
  const host = document.getElementById("ladder-figures");
  for (const [axis, rungs] of Object.entries(content.ladder)) {
    const values = rungs.flatMap((rung) => [rung.error, rung.floor]).filter((value) => value > 0);
    const logY = values.length > 1 && Math.max(...values) / Math.min(...values) > 10;
    const x = rungs.map((_, k) => k);
    const figure = new Figure(host, {
      title: `held-out error ${axis}`, yLabel: axisOf(axis).unit, height: 210, logY,
      label: `Held-out error of ${axis} by model version, against its noise floor`,
      xTicks: () => ({ splits: x, texts: x.map(labelOf) }),
      table: () => ({ head: ["model", "held-out error", "noise floor"], rows: rungs.map((rung, k) => [content.models[k].name, rung.error, rung.floor]) }),
    });
    figure.show({
      x,
      lines: [
        { label: "held-out error", colour: "blue", values: rungs.map((rung) => rung.error), points: true },
        { label: "noise floor", colour: "vermillion", values: rungs.map((rung) => rung.floor), dash: [4, 3], points: true },
      ],
      xRange: [-0.4, rungs.length - 0.6],
      ...(logY ? {} : { yRange: [0, 1.15 * Math.max(...values, 1e-12)] }),
    });
    ladders.push(figure);
  }
}

/** Every parameter of every version: a dot, and its 95 % interval, on a scale of its own. */
function buildParameterMap() {
  const host = document.getElementById("parameter-map");
  if (!content.parameters.length) return;
  const labels = content.models.map((_, k) => labelOf(k));
  const rows = content.parameters.map(({ name, unit, values }) => ({
    cells: [name, unit || "1", ...values.map((value) => value?.estimate ?? null), ...values.map((value) => value?.sd ?? null)],
    drawn: whiskers(name, values),
    texts: [name, unit || "1", ...values.map((value) => (value ? `${withSd(value.estimate, value.sd)}${value.at_bound ? " *" : ""}` : "–"))],
  }));
  host.append(
    tableOf({
      title: "Parameter map",
      note: "Estimate ± one standard deviation; drawn with the 95 % interval, one row per version, each parameter on its own scale. * At the limit of its range.",
      head: ["Parameter", "Unit", ...labels],
      rows: rows.map((row) => row.cells.slice(0, 2 + labels.length)),
      texts: rows.map((row) => row.texts),
      drawn: { head: "95 % intervals", cells: rows.map((row) => row.drawn) },
      csv: { head: ["parameter", "unit", ...labels, ...labels.map((label) => `sd ${label}`)], rows: rows.map((row) => row.cells) },
    }),
  );
}

function whiskers(name, values) {
  const known = values.map((value, model) => ({ ...value, model })).filter((value) => value.estimate !== undefined);
  const low = Math.min(...known.map((value) => value.estimate - 1.96 * value.sd));
  const high = Math.max(...known.map((value) => value.estimate + 1.96 * value.sd));
  const place = (value) => (high > low ? 4 + (172 * (value - low)) / (high - low) : 90);
  const lines = known.map((value, k) => {
    const y = (18 * (k + 0.5)) / known.length;
    const [from, to, at] = [value.estimate - 1.96 * value.sd, value.estimate + 1.96 * value.sd, value.estimate].map(place);
    const colour = `var(--${colourOf(value.model)})`;
    return `<line x1="${from}" x2="${to}" y1="${y}" y2="${y}" stroke="${colour}" stroke-width="1.6"/><circle cx="${at}" cy="${y}" r="2.4" fill="${colour}"/>`;
  });
  const holder = make("div");
  holder.innerHTML = `<svg class="whisker" viewBox="0 0 180 18" role="img" aria-label="95 % intervals of ${name}">${lines.join("")}</svg>`;
  return holder.firstChild;
}

/** Correlations of the estimates of the newest version shown: a matrix, and its pairs as a table. */
function drawCorrelations() {
  const host = document.getElementById("correlations");
  host.replaceChildren();
  const found = content.correlations.filter((one) => state.models.has(one.model)).at(-1);
  if (!found || found.names.length < 2) return;
  const { names, matrix, blocks, model } = found;
  const pairs = [];
  for (let i = 0; i < names.length; i++) {
    for (let k = i + 1; k < names.length; k++) {
      const value = matrix[i][k];
      if (value === null) continue;
      const bounds = blocks > 3 ? fisher(value, blocks) : { low: null, high: null };
      pairs.push([names[i], names[k], value, bounds.low, bounds.high]);
    }
  }
  pairs.sort((p, q) => Math.abs(q[2]) - Math.abs(p[2]));
  const note = blocks > 3 ? ` Bounds: 95 %, from ${blocks} independent blocks of time (Fisher's z).` : "";
  const cell = (value) => {
    const share = Math.round(70 * Math.min(1, Math.abs(value ?? 0)));
    const colour = value < 0 ? "vermillion" : "blue";
    return make("td", { class: "matrix", style: `background: color-mix(in srgb, var(--${colour}) ${share}%, transparent)` }, value === null ? "–" : value.toFixed(2).replace("-", "−"));
  };
  const body = names.map((name, i) => make("tr", {}, make("th", { scope: "row" }, make("code", {}, name)), ...matrix[i].map(cell)));
  const numbers = names.map((_, k) => make("th", { scope: "col", class: "n", title: names[k] }, String(k + 1)));
  body.forEach((row, k) => row.firstChild.prepend(`${k + 1} `));
  host.append(
    make("div", { class: "tablehead" }, make("h3", {}, `Correlation of the estimates, ${labelOf(model)}`)),
    make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Correlation matrix" }, make("table", {}, make("thead", {}, make("tr", {}, make("th", {}, ""), ...numbers)), make("tbody", {}, ...body))),
    tableOf({ title: `Pairs of estimates, ${labelOf(model)}`, note: `The most correlated first.${note}`, head: ["Parameter", "Parameter", "Correlation", "Low", "High"], rows: pairs }),
  );
}
