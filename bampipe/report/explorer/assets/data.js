// The channels: unpacked when first shown, and reduced to what the screen can show.

const content = JSON.parse(document.getElementById("content").textContent);
const GAP = 65535;
const BLOCK = 64;

async function inflate(number) {
  const text = document.getElementById(`block-${number}`).textContent;
  const packed = Uint8Array.fromBase64
    ? Uint8Array.fromBase64(text)
    : Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The times of some channels: seconds along the session, trials one behind the other. */
class Grid {
  constructor(described) {
    this.length = described.n;
    this.ends = described.ends;
    this.block = described.block;
  }

  /** Unpack the times once. */
  load() {
    this.loading ??= inflate(this.block).then((bytes) => {
      const n = this.length;
      const x = new Float64Array(n);
      let step = 0;
      let time = 0;
      for (let i = 0; i < n; i++) {
        let code = 0;
        for (let place = 6; place >= 0; place--) code = 256 * code + bytes[place * n + i];
        step += code % 2 ? -(code + 1) / 2 : code / 2;
        time += step;
        x[i] = 1e-6 * time;
      }
      this.x = x;
    });
    return this.loading;
  }

  /** First sample at or after a time. */
  indexOf(time) {
    let low = 0;
    let high = this.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.x[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** The sample nearest to a time. */
  nearest(time) {
    const after = Math.min(this.indexOf(time), this.length - 1);
    return after > 0 && time - this.x[after - 1] < this.x[after] - time ? after - 1 : after;
  }

  /** Stretches of samples from one time to another, each within one trial. */
  segments(from, to) {
    const first = this.indexOf(from);
    const last = this.indexOf(to);
    const found = [];
    let start = 0;
    for (const end of this.ends) {
      const a = Math.max(start, first - 1);
      const b = Math.min(end, last + 1);
      if (b > a && end > first && start < last) found.push([a, b]);
      start = end;
    }
    return found;
  }
}

/** One column of numbers on a grid. */
class Channel {
  constructor(described) {
    Object.assign(this, described);
    this.on = grids[described.grid];
  }

  /** Unpack the values, and the extremes of each block of them, once. */
  load() {
    this.loading ??= Promise.all([inflate(this.block), this.on.load()]).then(([bytes]) => {
      const n = this.on.length;
      const values = new Float32Array(n);
      const twice = this.order === 2;
      let step = 0;
      let code = 0;
      for (let i = 0; i < n; i++) {
        const folded = bytes[i] | (bytes[n + i] << 8);
        const change = (folded >>> 1) ^ -(folded & 1);
        if (twice) step = (step + change) & 0xffff;
        code = (code + (twice ? step : change)) & 0xffff;
        values[i] = code === GAP ? NaN : this.low + this.step * code;
      }
      const count = Math.ceil(n / BLOCK);
      this.lows = new Float32Array(count);
      this.highs = new Float32Array(count);
      for (let block = 0; block < count; block++) {
        let low = Infinity;
        let high = -Infinity;
        for (let i = block * BLOCK; i < Math.min(n, (block + 1) * BLOCK); i++) {
          if (values[i] < low) low = values[i];
          if (values[i] > high) high = values[i];
        }
        this.lows[block] = low;
        this.highs[block] = high;
      }
      this.values = values;
    });
    return this.loading;
  }

  /** Put the two extremes of some samples into `into`, in the order in which they come. */
  extremes(start, stop, into, at) {
    const { values, lows, highs } = this;
    let low = Infinity;
    let high = -Infinity;
    let lowAt = 0;
    let highAt = 0;
    let i = start;
    while (i < stop) {
      if (i % BLOCK === 0 && i + BLOCK <= stop) {
        const block = i / BLOCK;
        if (lows[block] < low) { low = lows[block]; lowAt = i; }
        if (highs[block] > high) { high = highs[block]; highAt = i; }
        i += BLOCK;
      } else {
        const value = values[i];
        if (value < low) { low = value; lowAt = i; }
        if (value > high) { high = value; highAt = i; }
        i++;
      }
    }
    const none = low === Infinity;
    into[at] = none ? null : lowAt <= highAt ? low : high;
    into[at + 1] = none ? null : lowAt <= highAt ? high : low;
  }
}

/**
 * Channels of one grid from one time to another, as columns [x, y, y, …] that `width` pixels can show:
 * every sample where there are few, else (`dense`) the two extremes of each pixel, so that no peak is
 * lost. A null parts trials.
 */
function reduce(grid, shown, from, to, width) {
  const segments = grid.segments(from, to);
  const total = segments.reduce((sum, [a, b]) => sum + b - a, 0);
  const columns = [[], ...shown.map(() => [])];
  const dense = total > 3 * width;
  for (const [a, b] of segments) {
    const at = columns[0].length;
    if (at) {
      columns[0].push(grid.x[a] - 1e-9);
      shown.forEach((_, k) => columns[k + 1].push(null));
    }
    if (!dense) {
      for (let i = a; i < b; i++) columns[0].push(grid.x[i]);
      shown.forEach((channel, k) => {
        for (let i = a; i < b; i++) {
          const value = channel.values[i];
          columns[k + 1].push(Number.isNaN(value) ? null : value);
        }
      });
      continue;
    }
    const buckets = Math.max(1, Math.round((width * (b - a)) / total));
    for (let bucket = 0; bucket < buckets; bucket++) {
      const start = a + Math.floor(((b - a) * bucket) / buckets);
      const stop = a + Math.floor(((b - a) * (bucket + 1)) / buckets);
      if (stop <= start) continue;
      const place = columns[0].length;
      columns[0].push(grid.x[start], grid.x[(start + stop - 1) >> 1] + 1e-9);
      shown.forEach((channel, k) => channel.extremes(start, stop, columns[k + 1], place));
    }
  }
  return { dense, columns };
}

const grids = Object.fromEntries(Object.entries(content.grids).map(([name, one]) => [name, new Grid(one)]));
const channels = content.channels.map((described) => new Channel(described));

/** The channels that have these properties. */
function find(meaning) {
  return channels.filter((one) => Object.entries(meaning).every(([key, value]) => one[key] === value));
}

/** Trial and time within it at a time along the session. */
function placeOf(time) {
  const trial = content.trials.findLast((one) => one.start <= time + 1e-9) ?? content.trials[0];
  return { trial, time: time - trial.offset };
}

/** A number as a reader wants it. */
function withSd(value, sd) {
  if (!(sd > 0) || !Number.isFinite(value)) return format(value);
  const decimals = Math.max(0, 1 - Math.floor(Math.log10(Number(sd.toPrecision(2)))));
  if (decimals > 9) return `${format(value)} ± ${format(sd, 2)}`;
  const shown = value.toFixed(decimals);
  return `${(Number(shown) ? shown : shown.replace("-", "")).replace("-", "−")} ± ${sd.toFixed(decimals)}`;
}

function format(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e6 && size >= 1e-4) return Number(value.toPrecision(digits)).toString().replace("-", "−");
  const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
  const raised = String(Number(exponent)).replace(/./g, (mark) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(mark)]);
  const factor = String(Number(mantissa)).replace("-", "−");
  return factor === "1" ? `10${raised}` : `${factor}·10${raised}`;
}
