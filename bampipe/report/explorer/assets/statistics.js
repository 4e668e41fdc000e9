// Spectrum and correlation of the samples in view.

/** Fast Fourier transform in place; the length is a power of two. */
function transform(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let length = 2; length <= n; length <<= 1) {
    const half = length >> 1;
    for (let k = 0; k < half; k++) {
      const angle = (-2 * Math.PI * k) / length;
      const c = Math.cos(angle);
      const s = Math.sin(angle);
      for (let i = k; i < n; i += length) {
        const a = re[i + half] * c - im[i + half] * s;
        const b = re[i + half] * s + im[i + half] * c;
        re[i + half] = re[i] - a;
        im[i + half] = im[i] - b;
        re[i] += a;
        im[i] += b;
      }
    }
  }
}

/** Samples of a channel in view, one array per trial, gaps closed. */
function pieces(channel, from, to) {
  return channel.on
    .segments(from, to)
    .map(([a, b]) => Float64Array.from(channel.values.subarray(a, b)).filter((v) => !Number.isNaN(v)))
    .filter((piece) => piece.length > 15);
}

/** One-sided power density by Welch's method (Hann windows, half overlapped), unit²/Hz. */
function spectrum(parts, rate) {
  const longest = Math.max(0, ...parts.map((part) => part.length));
  const size = 2 ** Math.floor(Math.log2(Math.min(longest, Math.max(64, 8 * rate))));
  if (size < 16) return { frequency: [], density: [] };
  const window = Float64Array.from({ length: size }, (_, i) => 0.5 - 0.5 * Math.cos((2 * Math.PI * i) / size));
  const power = window.reduce((sum, w) => sum + w * w, 0);
  const density = new Float64Array(size / 2);
  let count = 0;
  for (const part of parts) {
    for (let start = 0; start + size <= part.length; start += size / 2) {
      const piece = part.subarray(start, start + size);
      const mean = piece.reduce((sum, v) => sum + v, 0) / size;
      const re = piece.map((v, i) => (v - mean) * window[i]);
      const im = new Float64Array(size);
      transform(re, im);
      for (let k = 1; k < size / 2; k++) density[k] += (2 * (re[k] ** 2 + im[k] ** 2)) / (power * rate);
      count++;
    }
  }
  const frequency = Array.from({ length: size / 2 - 1 }, (_, k) => ((k + 1) * rate) / size);
  return { frequency, density: frequency.map((_, k) => density[k + 1] / Math.max(count, 1)) };
}

/** Autocorrelation over lags 0 … most, over all parts. */
function autocorrelation(parts, most) {
  const n = parts.reduce((sum, part) => sum + part.length, 0);
  const mean = parts.reduce((sum, part) => sum + part.reduce((s, v) => s + v, 0), 0) / n;
  const sums = new Float64Array(most + 1);
  for (const part of parts) {
    for (let lag = 0; lag <= Math.min(most, part.length - 1); lag++) {
      let sum = 0;
      for (let i = lag; i < part.length; i++) sum += (part[i] - mean) * (part[i - lag] - mean);
      sums[lag] += sum;
    }
  }
  return { n, values: Array.from(sums, (sum) => (sums[0] > 0 ? sum / sums[0] : 0)) };
}

/** Half width of the 95 % bound of each lag, were the correlation zero from it on (Bartlett). */
function bartlett(values, n) {
  let sum = 0;
  return values.map((value, lag) => {
    const half = lag ? 1.96 * Math.sqrt((1 + 2 * sum) / n) : 0;
    if (lag) sum += value * value;
    return half;
  });
}

/**
 * Correlation of two columns with its 95 % interval (Fisher's z); samples that follow from each
 * other count less: n / (1 + 2 Σ r_a r_b), the sum over lags.
 */
function correlate(a, b) {
  const n = a.length;
  if (n < 16) return null;
  const meanOf = (v) => v.reduce((sum, x) => sum + x, 0) / n;
  const ma = meanOf(a);
  const mb = meanOf(b);
  let ab = 0;
  let aa = 0;
  let bb = 0;
  for (let i = 0; i < n; i++) {
    ab += (a[i] - ma) * (b[i] - mb);
    aa += (a[i] - ma) ** 2;
    bb += (b[i] - mb) ** 2;
  }
  if (!(aa > 0) || !(bb > 0)) return null;
  const most = Math.min(200, n >> 2);
  const ra = autocorrelation([a], most).values;
  const rb = autocorrelation([b], most).values;
  let sum = 0;
  for (let lag = 1; lag <= most; lag++) sum += ra[lag] * rb[lag];
  const independent = Math.max(4, Math.min(n, n / Math.max(1 + 2 * sum, 1)));
  const value = ab / Math.sqrt(aa * bb);
  return { value, ...fisher(value, independent) };
}

/** 95 % interval of a correlation from so many independent samples. */
function fisher(value, independent) {
  const held = Math.max(-0.999999, Math.min(0.999999, value));
  const half = 1.96 / Math.sqrt(Math.max(independent - 3, 1));
  return { low: Math.tanh(Math.atanh(held) - half), high: Math.tanh(Math.atanh(held) + half) };
}
