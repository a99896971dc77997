// Numbers, dates, colours and the binary frames of the pictures. Nothing here touches the document but `theme`.
//
// Binary frame, little endian, written by src/zakai/report/frames.py:
//   bytes 0-3    "ZKF1"
//   bytes 4-7    uint32 N, length of the header
//   N bytes      header: JSON in UTF-8, padded with spaces so that 8 + N is a multiple of 8
//   the rest     arrays; header.arrays = {name: {type, shape, offset}}, offset from the end of the header, a multiple of 8;
//                type is "float64", "float32", "uint16" or "uint8"

const TYPES = { float64: Float64Array, float32: Float32Array, uint16: Uint16Array, uint8: Uint8Array };

/** Return {header, arrays, shapes} of a frame: an ArrayBuffer, or a view of one. Throw an Error for anything else. */
export function unpack(data) {
  let bytes = ArrayBuffer.isView(data) ? new Uint8Array(data.buffer, data.byteOffset, data.byteLength) : new Uint8Array(data);
  if (bytes.byteOffset % 8) bytes = bytes.slice();
  if (bytes.length < 8 || String.fromCharCode(...bytes.subarray(0, 4)) !== "ZKF1") throw new Error("not a frame of zakai");
  const size = new DataView(bytes.buffer, bytes.byteOffset).getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(8, 8 + size)));
  const arrays = {}, shapes = {};
  for (const [name, { type, shape, offset }] of Object.entries(header.arrays)) {
    const count = shape.reduce((a, b) => a * b, 1);
    arrays[name] = new TYPES[type](bytes.buffer, bytes.byteOffset + 8 + size + offset, count);
    shapes[name] = shape;
  }
  return { header, arrays, shapes };
}

/** Return the first position in a rising array with values[position] >= wanted. */
export function firstAtLeast(values, wanted) {
  let low = 0, high = values.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] < wanted) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Return a number with `digits` significant digits and a typographic minus sign. */
export function text(value, digits = 5) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const plain = size === 0 || (size >= 1e-4 && size < 10 ** Math.max(digits, 6));
  return (plain ? String(Number(value.toPrecision(digits))) : value.toExponential(digits - 1).replace(/\.?0+e/, "e")).replace(/-/g, "−");
}

/** Return [{at, text}]: ticks 1, 2 or 5 times a power of ten apart, about `most` of them at most. */
export function numberTicks(low, high, most) {
  const rough = (high - low) / Math.max(1, most);
  if (!(rough > 0) || !Number.isFinite(rough)) return [];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((s) => s * power >= rough * (1 - 1e-9)) * power;
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const far = Math.max(Math.abs(low), Math.abs(high)) >= 1e6 || decimals > 6;
  const ticks = [];
  const significant = Math.ceil(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / step) + 1);
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    const at = k * step;
    ticks.push({ at, text: far ? text(at, Math.min(15, Math.max(2, significant))) : at.toFixed(decimals).replace(/^-/, "−") });
  }
  return ticks;
}

/** Return ticks at multiples of pi / 2, or finer numbers where the range is short. */
export function angleTicks(low, high, most) {
  if (high - low < Math.PI) return numberTicks(low, high, most);
  const names = ["−π", "−π/2", "0", "π/2", "π"];
  return names.map((name, k) => ({ at: (k - 2) * (Math.PI / 2), text: name })).filter(({ at }) => at >= low - 1e-9 && at <= high + 1e-9);
}

/** Return ticks of a logarithmic axis whose range is given in powers of ten; `at` is a power of ten too. */
export function logTicks(low, high, most) {
  const steps = high - low < 3 ? [1, 2, 5] : [1];
  const every = Math.max(1, Math.ceil(((high - low) * steps.length) / Math.max(1, most)));
  const ticks = [];
  for (let power = Math.floor(low); power <= high; power++) {
    if (steps.length === 1 && power % every) continue;
    for (const step of steps) {
      const at = power + Math.log10(step);
      if (at >= low - 1e-9 && at <= high + 1e-9) ticks.push({ at, text: text(step * 10 ** power, 2) });
    }
  }
  return ticks;
}

const SECOND = 1000, MINUTE = 60 * SECOND, HOUR = 60 * MINUTE, DAY = 24 * HOUR, YEAR = 365.25 * DAY;
const STEPS = [1, 2, 5, 10, 20, 50, 100, 200, 500, ...[1, 2, 5, 10, 15, 30].map((s) => s * SECOND),
  ...[1, 2, 5, 10, 15, 30].map((m) => m * MINUTE), ...[1, 2, 3, 6, 12].map((h) => h * HOUR), ...[1, 2, 7, 14].map((d) => d * DAY)];
const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
const two = (n) => String(n).padStart(2, "0");

/** Return milliseconds since 1970 (UTC) of a time of the model; `clock` is {origin: milliseconds, unit: milliseconds}. */
export const milliseconds = (time, clock) => clock.origin + time * clock.unit;

/** Return a time as text: a date in UTC where there is a clock, a number else; `span` is the width of the view. */
export function moment(time, clock, span) {
  if (!clock) return text(time, Math.min(15, Math.max(6, Math.ceil(Math.log10(Math.abs(time) / span + 1)) + 4)));
  const date = new Date(milliseconds(time, clock));
  if (Number.isNaN(date.getTime())) return text(time);
  const iso = date.toISOString(), width = span * clock.unit;
  return iso.slice(0, 10) + (width > 400 * DAY ? "" : " " + iso.slice(11, width > DAY ? 16 : width > 10 * SECOND ? 19 : 23));
}

/** Return {ticks, title}: ticks at round dates (UTC) and the name of the axis, with the day where ticks are within one. */
export function dateTicks(low, high, most, clock) {
  const first = milliseconds(low, clock), last = milliseconds(high, clock), rough = (last - first) / Math.max(1, most);
  const ticks = [];
  const add = (at, name) => ticks.push({ at: (at - clock.origin) / clock.unit, text: name });
  const step = STEPS.find((s) => s >= rough);
  if (step === undefined) {
    const months = [1, 2, 3, 6].find((m) => (m * YEAR) / 12 >= rough);
    const years = months ? 0 : [1, 2, 5].map((s) => s * 10 ** Math.floor(Math.log10(rough / YEAR))).find((s) => s * YEAR >= rough)
      ?? 10 ** Math.ceil(Math.log10(rough / YEAR));
    const every = months ?? 12 * Math.max(1, Math.round(years));
    const start = new Date(first), months0 = start.getUTCFullYear() * 12 + start.getUTCMonth();
    for (let m = Math.ceil(months0 / every) * every; ; m += every) {
      const at = Date.UTC(0, 0) + (Date.UTC(Math.floor(m / 12), m % 12) - Date.UTC(0, 0));
      if (!(at <= last)) break;
      if (at >= first) add(at, months ? `${MONTHS[m % 12]} ${Math.floor(m / 12)}` : String(Math.floor(m / 12)));
    }
    return { ticks, title: "date (UTC)" };
  }
  for (let at = Math.ceil(first / step) * step; at <= last; at += step) {
    const date = new Date(at), day = `${date.getUTCDate()} ${MONTHS[date.getUTCMonth()]}`;
    const clockText = `${two(date.getUTCHours())}:${two(date.getUTCMinutes())}`;
    if (step >= DAY) add(at, day);
    else if (at % DAY === 0) add(at, day);
    else if (step >= MINUTE) add(at, clockText);
    else add(at, `${clockText}:${two(date.getUTCSeconds())}` + (step < SECOND ? `.${String(date.getUTCMilliseconds()).padStart(3, "0")}` : ""));
  }
  const iso = new Date((first + last) / 2);
  const year = iso.getUTCFullYear();
  return { ticks, title: step >= DAY ? `date (UTC), ${year}` : `time (UTC), ${iso.getUTCDate()} ${MONTHS[iso.getUTCMonth()]} ${year}` };
}

// The lightness changes evenly from the background to the densest colour: the order survives colour blindness and a grey printer,
// and never hides the lines.
const LIGHT = {
  background: "#ffffff", ink: "#1d2430", faint: "#5d6672", rule: "#c9ced5", band: "#2c4d73", truth: "#c24e00", series: "#2f75ad",
  map: ["#ffffff", "#eaf1f8", "#cfe0f0", "#a9cae4", "#7aaed4", "#4b8fc2", "#2f75ad"],
};
const DARK = {
  background: "#14181f", ink: "#f2f4f7", faint: "#a3adba", rule: "#3a434f", band: "#b9d6f2", truth: "#ffa24d", series: "#6cb0e6",
  map: ["#14181f", "#17283a", "#1a3a58", "#1e4f7b", "#24659d", "#2f7dbd", "#4596d8"],
};

const channels = (colour) => {
  const hex = /^#([0-9a-f]{3}|[0-9a-f]{6})$/i.exec(colour.trim());
  if (hex) {
    const six = hex[1].length === 3 ? hex[1].replace(/./g, "$&$&") : hex[1];
    return [0, 2, 4].map((k) => parseInt(six.slice(k, k + 2), 16));
  }
  const rgb = /^rgba?\(([^)]+)\)$/.exec(colour.trim());
  const parts = rgb ? rgb[1].split(/[\s,/]+/).map(Number) : [255, 255, 255];
  return rgb && parts.length > 3 && parts[3] === 0 ? null : parts.slice(0, 3);
};

/**
 * Return the colours of an element. It is dark where the background behind it is; without one, where the reader prefers dark.
 * A page sets its own by CSS variables: --zakai-background, -ink, -faint, -rule, -band, -truth, -series (colours), and -map, a list
 * of colours separated by blanks, from no density to the highest.
 */
export function theme(element) {
  let behind = null;
  for (let node = element; node && !behind; node = node.parentElement) behind = channels(getComputedStyle(node).backgroundColor);
  const own = getComputedStyle(element), read = (name) => own.getPropertyValue(`--zakai-${name}`).trim();
  const given = read("background");
  const shown = (given && channels(given)) || behind;
  const dark = shown ? 0.3 * shown[0] + 0.59 * shown[1] + 0.11 * shown[2] < 128 : matchMedia("(prefers-color-scheme: dark)").matches;
  const found = { dark, font: own.fontFamily || "sans-serif" };
  for (const [name, value] of Object.entries(dark ? DARK : LIGHT)) found[name] = name === "map" ? value : read(name) || value;
  if (shown) found.background = `rgb(${shown.join(",")})`;
  const map = read("map");
  found.map = map ? map.split(/\s+/) : [found.background, ...found.map.slice(1)];
  found.table = table(found.map);
  return found;
}

/** Return 256 opaque colours as the pixels of an image. */
function table(stops) {
  const values = stops.map((stop) => channels(stop) ?? [255, 255, 255]), pixels = new Uint8ClampedArray(4 * 256);
  for (let k = 0; k < 256; k++) {
    const place = (k / 255) * (values.length - 1), i = Math.min(values.length - 2, Math.floor(place)), part = place - i;
    for (let c = 0; c < 3; c++) pixels[4 * k + c] = values[i][c] + part * (values[i + 1][c] - values[i][c]);
    pixels[4 * k + 3] = 255;
  }
  return new Uint32Array(pixels.buffer);
}
