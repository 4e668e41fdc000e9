// A figure: uPlot for lines, axes and cursor; bands, dots and spans behind them; CSV and SVG of it.

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const SERIES = ["blue", "vermillion", "green", "purple", "orange", "sky"];

/** An element with attributes and children. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== false && value !== null) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

/** Hand the user a file. */
function download(name, type, text) {
  const link = make("a", { href: URL.createObjectURL(new Blob([text], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const fileName = (title, ending) => `${content.session.replaceAll(" ", "-")}-${title.toLowerCase().replace(/[^a-z0-9]+/g, "-")}.${ending}`;
const csvCell = (value) => {
  const text = value === null || value === undefined || Number.isNaN(value) ? "" : String(value);
  return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
};
const csvOf = (head, rows) => [head, ...rows].map((row) => row.map(csvCell).join(",")).join("\n") + "\n";

/** Draws on a canvas. */
class CanvasPen {
  constructor(context, ratio) {
    this.context = context;
    this.ratio = ratio;
  }

  path(points, { stroke = "", width = 1, dash = [], fill = "", alpha = 1 }) {
    const { context, ratio } = this;
    context.globalAlpha = alpha;
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x * ratio, y * ratio);
    if (fill) {
      context.fillStyle = fill;
      context.fill();
    }
    if (stroke) {
      context.strokeStyle = stroke;
      context.lineWidth = width * ratio;
      context.setLineDash(dash.map((part) => part * ratio));
      context.stroke();
      context.setLineDash([]);
    }
    context.globalAlpha = 1;
  }

  dots(points, radius, fill, alpha) {
    const { context, ratio } = this;
    context.globalAlpha = alpha;
    context.fillStyle = fill;
    const size = 2 * radius * ratio;
    for (const [x, y] of points) context.fillRect(x * ratio - size / 2, y * ratio - size / 2, size, size);
    context.globalAlpha = 1;
  }
}

/** Writes SVG. */
class SvgPen {
  parts = [];

  path(points, { stroke = "none", width = 1, dash = [], fill = "none", alpha = 1 }) {
    if (!points.length) return;
    const line = points.map(([x, y]) => `${x.toFixed(2)} ${y.toFixed(2)}`).join("L");
    const look = `fill="${fill || "none"}" stroke="${stroke || "none"}" stroke-width="${width}" opacity="${alpha}"`;
    this.parts.push(`<path d="M${line}" ${look}${dash.length ? ` stroke-dasharray="${dash.join(" ")}"` : ""}/>`);
  }

  dots(points, radius, fill, alpha) {
    for (const [x, y] of points) {
      this.parts.push(`<circle cx="${x.toFixed(2)}" cy="${y.toFixed(2)}" r="${radius}" fill="${fill}" opacity="${alpha}"/>`);
    }
  }

  text(x, y, text, { anchor = "middle", size = 11, turn = 0, weight = 400, fill = "#000" } = {}) {
    const safe = String(text).replace(/[&<>]/g, (mark) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[mark]);
    const turned = turn ? ` transform="rotate(${turn} ${x} ${y})"` : "";
    this.parts.push(
      `<text x="${x}" y="${y}" text-anchor="${anchor}" font-size="${size}" font-weight="${weight}" fill="${fill}"${turned}>${safe}</text>`,
    );
  }
}

/**
 * Draw the two extremes of each pixel as an upright bar that touches its neighbour: rectangles take a
 * fraction of the time of one long zigzag.
 */
function paintBars(plot, k) {
  const { ctx } = plot;
  const [xs, ys] = [plot.data[0], plot.data[k]];
  const { stroke, width } = plot.series[k];
  const thick = width * uPlot.pxRatio;
  let before = null;
  ctx.save();
  ctx.beginPath();
  ctx.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
  ctx.clip();
  ctx.fillStyle = stroke(plot, k);
  for (let i = 0; i < ys.length; i += 2) {
    if (ys[i] === null) {
      before = null;
      i -= 1;
      continue;
    }
    const x = Math.round(plot.valToPos(xs[i], "x", true));
    const [a, b] = [plot.valToPos(ys[i], "y", true), plot.valToPos(ys[i + 1], "y", true)];
    let [top, bottom] = a < b ? [a, b] : [b, a];
    const from = before ? before.x : x;
    if (before) [top, bottom] = [Math.min(top, before.bottom), Math.max(bottom, before.top)];
    const spare = Math.max(0, thick - (bottom - top)) / 2;
    ctx.fillRect(from, top - spare, Math.max(1, x - from), bottom - top + 2 * spare);
    before = { x, top: Math.min(a, b), bottom: Math.max(a, b) };
  }
  ctx.restore();
}

class Figure {
  /**
   * @param host where it goes
   * @param options title; xLabel, yLabel; height; logX, logY; xTicks(min, max) → {splits, texts} or
   *   null for uPlot's own; select(x0, x1, y0, y1) after a drag; rectangle: the drag has two sides;
   *   hover(x, y) or (null); reset() on a double click; table() → {head, rows} for CSV; sync: key of
   *   plots that share a cursor; yWidth: room left of the vertical axis, pixels; label: text for screen readers; keys(event)
   */
  constructor(host, options) {
    this.options = { height: 190, logX: false, logY: false, ...options };
    this.key = make("ul", { class: "key" });
    this.canvas = make("div", {
      class: "canvas",
      tabindex: options.keys ? "0" : null,
      role: options.keys ? "application" : "img",
      "aria-label": options.label ?? options.title,
    });
    const tools = make(
      "span",
      { class: "tools" },
      make("button", { type: "button", "aria-label": `${options.title}: CSV`, onclick: () => this.saveCsv() }, "CSV"),
      make("button", { type: "button", "aria-label": `${options.title}: SVG`, onclick: () => this.saveSvg() }, "SVG"),
    );
    this.root = make("figure", { class: "plot" }, make("figcaption", {}, options.title, this.key, tools), this.canvas);
    if (options.keys) this.canvas.addEventListener("keydown", options.keys);
    host.append(this.root);
    this.resizing = new ResizeObserver(() => this.fit());
    this.resizing.observe(this.canvas);
  }

  get width() {
    return Math.max(120, this.canvas.clientWidth);
  }

  /**
   * Draw {x, lines: [{label, colour, values, width, dash, points}], behind: [overlay], xRange, yRange,
   * dense: whether the values are extremes by pixel}.
   */
  show(shown) {
    const before = this.shape;
    this.shown = shown;
    this.shape = shown.lines.map((line) => [line.label, line.colour, line.dash, line.points].join()).join(";");
    const data = [shown.x, ...shown.lines.map((line) => line.values)];
    if (this.plot && before === this.shape) {
      this.plot.batch(() => {
        this.plot.setData(data, false);
        this.plot.setScale("x", { min: shown.xRange[0], max: shown.xRange[1] });
      });
      return;
    }
    this.plot?.destroy();
    this.plot = new uPlot(this.plotOptions(), data, this.canvas);
    this.drawKey();
  }

  fit() {
    const { plot, width } = this;
    if (plot && Math.abs(plot.width - width) > 0.5) {
      plot.setSize({ width, height: this.options.height });
      this.options.resized?.();
    }
  }

  /** Draw again in the colours of the page as they now are. */
  repaint() {
    this.plot?.redraw(false, true);
  }

  destroy() {
    this.resizing.disconnect();
    this.plot?.destroy();
    this.root.remove();
  }

  plotOptions() {
    const { options, shown } = this;
    const font = "11px system-ui, sans-serif";
    const axis = (which, label, more) => ({
      stroke: () => css("muted"),
      grid: { stroke: () => css("grid"), width: 1 },
      ticks: { stroke: () => css("line"), width: 1, size: 4 },
      font,
      labelFont: font,
      label,
      labelSize: 16,
      ...more,
      values: (_, splits) => {
        const known = which === "x" && this.ticked ? this.ticked.texts : null;
        const texts = known ?? splits.map((value) => this.tickText(which, value));
        this[`${which}Marks`] = { splits, texts };
        return texts;
      },
    });
    const ticks = options.xTicks && {
      splits: (_, __, min, max) => {
        this.ticked = options.xTicks(min, max, this.width);
        return this.ticked.splits;
      },
    };
    return {
      width: this.width,
      height: options.height,
      padding: [8, 12, 0, 0],
      legend: { show: false },
      cursor: {
        y: Boolean(options.rectangle),
        points: { show: false },
        drag: { x: Boolean(options.select), y: Boolean(options.rectangle), setScale: false, uni: 12 },
        bind: { dblclick: () => () => options.reset?.() },
        ...(options.sync ? { sync: { key: options.sync, scales: ["x", null] } } : {}),
      },
      scales: {
        x: { time: false, distr: options.logX ? 3 : 1, range: (_, min, max) => this.shown.xRange ?? [min, max] },
        y: { distr: options.logY ? 3 : 1, range: (_, min, max) => this.yRange(min, max) },
      },
      axes: [
        axis("x", options.xLabel, { size: (_, texts) => 9 + 17 * Math.max(1, ...(texts ?? []).map((text) => String(text ?? "").split("\n").length)), space: 60, ...ticks }),
        axis("y", options.yLabel, { size: (_, texts) => options.yWidth ?? 14 + 6.5 * Math.max(3, ...(texts ?? []).map((text) => String(text ?? "").length)), space: 26 }),
      ],
      series: [
        {},
        ...shown.lines.map((line) => ({
          label: line.label,
          stroke: () => css(line.colour),
          fill: undefined,
          width: line.width ?? 1.2,
          dash: line.dash,
          paths: (plot, k, from, to) => (this.shown.dense ? null : uPlot.paths.linear()(plot, k, from, to)),
          points: line.points ? { show: true, size: 7, fill: () => css(line.colour) } : { show: false },
        })),
      ],
      hooks: {
        drawAxes: [(plot) => this.paintBehind(new CanvasPen(plot.ctx, uPlot.pxRatio))],
        drawSeries: [(plot, k) => this.shown.dense && k && paintBars(plot, k)],
        setSelect: [(plot) => this.selected(plot)],
        setCursor: [(plot) => this.hovered(plot)],
      },
    };
  }

  tickText(which, value) {
    if (value === null) return null;
    const log = which === "x" ? this.options.logX : this.options.logY;
    if (!log) return format(value, 6);
    // uPlot sets a tick at the edge, too: only 1, 2 and 5 of a decade get their number.
    const [first, ...others] = value.toExponential(5);
    const plain = Number(others.join("").split("e")[0]) === 0;
    return plain && (first === "1" || (this.narrow(which) && "25".includes(first))) ? format(value, 3) : "";
  }

  /** Whether a logarithmic range holds less than two decades, so that ticks within a decade need numbers. */
  narrow(which) {
    const scale = this.plot?.scales[which];
    return !scale?.min || scale.max / scale.min < 100;
  }

  yRange(min, max) {
    if (this.shown.yRange) return this.shown.yRange;
    if (min === null || min === undefined) return [0, 1];
    if (this.options.logY) return [min / 1.3, max * 1.3];
    const margin = 0.06 * (max - min) || 0.1 * Math.abs(max) || 1;
    return [min - margin, max + margin];
  }

  drawKey() {
    const overlays = (this.shown.behind ?? []).filter((one) => one.label);
    this.values = this.shown.lines.map(() => make("span", { class: "value" }));
    const swatch = (one) =>
      make("span", { class: one.dash ? "swatch dashed" : "swatch", style: `border-color: var(--${one.colour})` });
    this.key.replaceChildren(
      ...this.shown.lines.map((line, k) => make("li", {}, swatch(line), ` ${line.label}`, this.values[k])),
      ...overlays.map((one) => make("li", {}, swatch(one), ` ${one.label}`)),
    );
  }

  /** Say in the key what each line is at the cursor. */
  read(texts) {
    this.values?.forEach((place, k) => (place.textContent = texts?.[k] ?? ""));
  }

  selected(plot) {
    const { left, top, width, height } = plot.select;
    if (width < 3 && height < 3) return;
    const x = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    const full = !this.options.rectangle || height < 3;
    const y = full ? [-Infinity, Infinity] : [plot.posToVal(top + height, "y"), plot.posToVal(top, "y")];
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    const wide = width < 3 ? [-Infinity, Infinity] : x;
    this.options.select?.(...wide, ...y);
  }

  hovered(plot) {
    const { left, top } = plot.cursor;
    if (this.silent) return;
    if (left === null || left === undefined || left < 0) this.options.hover?.(null);
    else this.options.hover?.(plot.posToVal(left, "x"), plot.posToVal(top, "y"));
  }

  /** Put the cross hair at a value of x, or take it off. */
  pointAt(x) {
    if (!this.plot) return;
    this.silent = true;
    const left = x === null ? -10 : this.plot.valToPos(x, "x");
    this.plot.setCursor({ left, top: x === null ? -10 : 0 }, false);
    this.silent = false;
  }

  /** Put a ring at a point, or take it off. */
  ringAt(x, y) {
    this.ring ??= make("div", { class: "here", hidden: true });
    if (!this.plot) return;
    if (this.ring.parentNode !== this.plot.over) this.plot.over.append(this.ring);
    const left = x === null ? NaN : this.plot.valToPos(x, "x");
    const top = x === null ? NaN : this.plot.valToPos(y, "y");
    const inside = left >= 0 && top >= 0 && left <= this.plot.over.clientWidth && top <= this.plot.over.clientHeight;
    this.ring.hidden = !inside;
    if (inside) Object.assign(this.ring.style, { left: `${left}px`, top: `${top}px` });
  }

  /** The plotting area, CSS pixels. */
  area() {
    const { left, top, width, height } = this.plot.bbox;
    const ratio = uPlot.pxRatio;
    return { left: left / ratio, top: top / ratio, width: width / ratio, height: height / ratio };
  }

  paintBehind(pen) {
    const { plot } = this;
    const area = this.area();
    const right = area.left + area.width;
    const bottom = area.top + area.height;
    const X = (v) => area.left + plot.valToPos(v, "x");
    const Y = (v) => area.top + plot.valToPos(v, "y");
    const clip = (v, low, high) => Math.min(high, Math.max(low, v));
    if (pen.context) {
      pen.context.save();
      pen.context.beginPath();
      pen.context.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
      pen.context.clip();
    }
    for (const one of this.shown.behind ?? []) {
      const colour = css(one.colour);
      const alpha = one.alpha ?? 1;
      if (one.kind === "spans") {
        const { min, max } = plot.scales.x;
        let reached = -1;
        for (const [from, to] of one.values) {
          if (to < min || from > max) continue;
          const start = Math.max(clip(X(from), area.left, right), reached);
          const end = clip(Math.max(X(to), start + 1), area.left, right);
          if (end <= start) continue;
          reached = end;
          pen.path([[start, area.top], [end, area.top], [end, bottom], [start, bottom]], { fill: colour, alpha });
        }
      } else if (one.kind === "band") {
        const there = one.x.map((x, i) => [X(x), Y(one.high[i])]);
        const back = one.x.map((x, i) => [X(x), Y(one.low[i])]).reverse();
        pen.path([...there, ...back], { fill: colour, alpha });
      } else if (one.kind === "curve") {
        pen.path(one.x.map((x, i) => [X(x), Y(one.y[i])]), { stroke: colour, width: one.width ?? 1.6, dash: one.dash ?? [] });
      } else if (one.kind === "dots") {
        pen.dots(one.points.map(([x, y]) => [X(x), Y(y)]), one.radius ?? 1.2, colour, alpha);
      } else if (one.kind === "whiskers") {
        one.x.forEach((x, i) => pen.path([[X(x), Y(one.low[i])], [X(x), Y(one.high[i])]], { stroke: colour, width: 1.4 }));
      } else if (one.kind === "rule") {
        const along = one.y !== undefined ? [[area.left, Y(one.y)], [right, Y(one.y)]] : [[X(one.x), area.top], [X(one.x), bottom]];
        pen.path(along, { stroke: colour, width: one.width ?? 1, dash: one.dash ?? [], alpha });
      }
    }
    pen.context?.restore();
  }

  /** The figure as shown, as SVG text. */
  svg() {
    const { plot, shown, options } = this;
    const { left, top, width, height } = this.area();
    const pen = new SvgPen();
    const [full, ink, muted] = [this.options.height + 44, css("ink"), css("muted")];
    this.xMarks.splits.forEach((value, k) => {
      const x = left + plot.valToPos(value, "x");
      pen.path([[x, top], [x, top + height]], { stroke: css("grid") });
      pen.text(x, top + height + 15, this.xMarks.texts[k] ?? "", { fill: muted });
    });
    this.yMarks.splits.forEach((value, k) => {
      const y = top + plot.valToPos(value, "y");
      pen.path([[left, y], [left + width, y]], { stroke: css("grid") });
      pen.text(left - 6, y + 4, this.yMarks.texts[k] ?? "", { anchor: "end", fill: muted });
    });
    pen.text(left + width / 2, top + height + 31, options.xLabel ?? "", { fill: muted });
    pen.text(11, top + height / 2, options.yLabel ?? "", { turn: -90, fill: muted });
    pen.parts.push(`<g clip-path="url(#area)">`);
    this.paintBehind(pen);
    for (const line of shown.lines) {
      let run = [];
      const flush = () => {
        if (line.points) pen.dots(run, 3.2, css(line.colour), 1);
        if (run.length > 1) pen.path(run, { stroke: css(line.colour), width: line.width ?? 1.2, dash: line.dash ?? [] });
        run = [];
      };
      line.values.forEach((value, i) => {
        if (value === null || !Number.isFinite(value)) flush();
        else run.push([left + plot.valToPos(shown.x[i], "x"), top + plot.valToPos(value, "y")]);
      });
      flush();
    }
    pen.parts.push("</g>");
    let place = left;
    for (const line of [...shown.lines, ...(shown.behind ?? []).filter((one) => one.label)]) {
      pen.path([[place, full - 26], [place + 20, full - 26]], { stroke: css(line.colour), width: 2.5, dash: line.dash ?? [] });
      pen.text(place + 25, full - 22, line.label, { anchor: "start", fill: ink });
      place += 45 + 6.2 * line.label.length;
    }
    pen.text(left, full - 5, options.title, { anchor: "start", weight: 700, fill: ink });
    return (
      `<svg xmlns="http://www.w3.org/2000/svg" width="${plot.width}" height="${full}" viewBox="0 0 ${plot.width} ${full}" ` +
      `font-family="system-ui, sans-serif"><rect width="100%" height="100%" fill="${css("paper")}"/>` +
      `<defs><clipPath id="area"><rect x="${left}" y="${top}" width="${width}" height="${height}"/></clipPath></defs>` +
      `${pen.parts.join("\n")}</svg>\n`
    );
  }

  saveSvg() {
    if (this.plot) download(fileName(this.options.title, "svg"), "image/svg+xml", this.svg());
  }

  saveCsv() {
    if (!this.plot) return;
    const { head, rows } = this.options.table?.() ?? {
      head: [this.options.xLabel ?? "x", ...this.shown.lines.map((line) => line.label)],
      rows: Array.from(this.shown.x, (x, i) => [x, ...this.shown.lines.map((line) => line.values[i])]),
    };
    download(fileName(this.options.title, "csv"), "text/csv", csvOf(head, rows));
  }
}
