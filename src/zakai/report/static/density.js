// A conditional density over time: time to the right, the density as shades, with band, mean, truth and observations.
//
//   import { DensityView } from "./density.js";
//   const view = new DensityView(element, { testid: "density", onViewChange: (seen) => ... });
//   view.setFrame(arrayBuffer);              // of zakai.report.picture.picture_bytes(result, coordinate, ...)
//   view.destroy();
//
// Options: those of Panel (panel.js: label, height, testid) and onViewChange({from, to, low, high, width, height, wanted}): once a
// screen frame after the reader moved or zoomed. `wanted` is {from, to}, the times of a frame that would show more than the view
// holds, or null where it holds all that can be seen. A host answers with picture_bytes(..., window=(from, to)) and setFrame; until
// then, and outside of that frame, the first one (all times) is drawn. Frames of another result or coordinate replace both. Of
// several wishes only the last one counts.
//
// Other members: state() returns what onViewChange receives; setView({x: [from, to], y: [low, high]} or null for all);
// describe(x, y) the text of the pointer; frame.header; redraw().
//
// Frame (container: axes.js), header:
//   kind "density"; key: changes with the result and coordinate; name of the coordinate; clock: null or {origin, unit} in
//   milliseconds since 1970 (UTC); periodic: an angle in (-pi, pi]; given: what the density is conditioned on; levels: [0.025, 0.975];
//   window: [from, to] of this frame; extent: of the record; range: [low, high] of values to show; complete: every time of the
//   window is a column; lines: [{role, text, times, values, dots}] with the names of two arrays each, roles "mean", "band",
//   "truth", "observations", "filtered"
// arrays, C columns of R cells from low to high:
//   times (C) float64; low, high (C) float64: the ends of a column's own window; cells (C, R) uint16: the average density in each
//   cell, 65535 is the column's largest; peak (C) float64: that largest average, a density; mean (C), quantiles (levels, C),
//   truth (C, NaN where unknown) float64. Without `cells` the densities were not kept: the band alone is shaded.

import { firstAtLeast, moment, text, unpack } from "./axes.js";
import { Panel, drawSeries } from "./panel.js";

const TURN = 2 * Math.PI;
const REACH = 3; // of the median distance of columns: how far one is drawn from its time, at most
const FLAT = 0.3; // shade of a band without a density
const STYLES = {
  band: (c) => ({ colour: c.band, width: 0.9 }),
  filtered: (c) => ({ colour: c.faint, width: 1.1, dash: [2, 3] }),
  mean: (c) => ({ colour: c.ink, width: 1.5 }),
  observations: (c) => ({ colour: c.faint, dots: true, size: 2 }),
  truth: (c) => ({ colour: c.truth, width: 1.6, dash: [5, 3] }),
};

export class DensityView extends Panel {
  constructor(element, options = {}) {
    const { onViewChange } = options;
    super(element, { label: "Conditional density over time", ...options, onViewChange: onViewChange && (() => onViewChange(this.state())) });
    this.frame = this.whole = null;
  }

  /** Show a frame; of the same result and coordinate the view stays. */
  setFrame(data) {
    const frame = prepared(unpack(data)), { header } = frame, before = this.frame?.header;
    const whole = header.window[0] <= header.extent[0] && header.window[1] >= header.extent[1];
    if (whole || this.whole?.header.key !== header.key) this.whole = whole ? frame : null;
    this.frame = frame;
    this.axes.x = { title: "time", clock: header.clock };
    this.axes.y = { title: header.name, angle: header.periodic };
    const label = `Density of ${header.name} over time, given ${header.given}`;
    this.root.setAttribute("aria-label", label);
    this.canvas.setAttribute("aria-label", label);
    this.setHome(header.extent, header.range, !before || before.name !== header.name);
  }

  state() {
    const { x, y, width, height } = super.state();
    return { from: x[0], to: x[1], low: y[0], high: y[1], width, height, wanted: this._wanted(x) };
  }

  _wanted([from, to]) {
    if (!this.frame) return null;
    const { header, arrays } = this.frame, { window: seen, extent, complete } = header, around = (to - from) / 2;
    const wanted = { from: Math.max(extent[0], from - around), to: Math.min(extent[1], to + around) };
    if (!(seen[0] <= from && seen[1] >= to)) return this._holds(this.whole, from, to) ? null : wanted;
    if (complete) return null;
    // A frame of `wanted` has all its columns there: is that twice as fine as this one?
    const here = firstAtLeast(arrays.times, wanted.to) - firstAtLeast(arrays.times, wanted.from);
    return here * 2 < arrays.times.length ? wanted : null;
  }

  _holds(frame, from, to) {
    return Boolean(frame?.header.complete && frame.header.window[0] <= from && frame.header.window[1] >= to);
  }

  paint(context, place, colours) {
    if (!this.frame) return;
    if (!this.hidden.has("density")) this._shade(context, place, colours);
    const fewer = this.whole && this.whole !== this.frame ? [this.whole, this.frame] : [this.frame];
    for (const frame of fewer) {
      context.save();
      if (fewer.length > 1) { // each frame where it is the finer one
        const [from, to] = this.frame.header.window, inner = new Path2D();
        inner.rect(this.px(from), place.y, this.px(to) - this.px(from), place.h);
        if (frame !== this.frame) inner.rect(place.x, place.y, place.w, place.h);
        context.clip(inner, "evenodd");
      }
      for (const line of frame.header.lines) {
        if (this.hidden.has(line.role)) continue;
        const style = STYLES[line.role](colours), values = frame.arrays[line.values];
        const dots = Boolean(style.dots || line.dots);
        // Lines of more points than pixels would hide the density.
        const crowd = (values.length / place.w) * Math.min(1, (this.view.x[1] - this.view.x[0]) / (frame.header.window[1] - frame.header.window[0] || 1));
        context.globalAlpha = dots ? 1 : Math.min(1, Math.max(line.role === "band" ? 0.35 : 0.7, 0.8 / crowd));
        const dash = crowd > 0.5 ? [] : style.dash; // dashes of a crowded line are not seen, and slow
        drawSeries(context, this, frame.arrays[line.times], values, { ...style, dash, dots, size: values.length > 500 ? 1.4 : 2 });
      }
      context.restore();
    }
  }

  _shade(context, place, colours) {
    const ratio = this.ratio, across = Math.round(place.w * ratio), down = Math.round(place.h * ratio);
    if (this.image?.width !== across || this.image?.height !== down) this.image = context.createImageData(across, down);
    const pixels = new Uint32Array(this.image.data.buffer);
    pixels.fill(colours.table[0]);
    if (this.whole && this.whole !== this.frame) shade(pixels, across, down, this.view, this.whole, colours.table);
    shade(pixels, across, down, this.view, this.frame, colours.table);
    context.putImageData(this.image, Math.round(place.x * ratio), Math.round(place.y * ratio));
  }

  items(colours) {
    if (!this.frame) return [];
    const { header, arrays } = this.frame, found = [];
    const gradient = (context, w, h) => colours.map.forEach((colour, k, all) => {
      context.fillStyle = colour;
      context.fillRect((k * w) / all.length, 0, w / all.length + 1, h);
    });
    found.push({ role: "density", text: arrays.cells ? "density / its peak" : "95% band of a Gaussian", draw: gradient });
    for (const { role, text: said } of header.lines) {
      if (found.some((item) => item.role === role)) continue;
      const { colour, width = 1, dash = [], dots } = STYLES[role](colours);
      found.push({ role, text: said, draw: (context, w, h) => {
        context.strokeStyle = context.fillStyle = colour;
        context.lineWidth = Math.max(1.3, width);
        context.setLineDash(dash);
        context.beginPath();
        if (dots) context.arc(w / 2, h / 2, 2.5, 0, 7);
        else { context.moveTo(0, h / 2); context.lineTo(w, h / 2); }
        if (dots) context.fill(); else context.stroke();
      } });
    }
    return found;
  }

  _finest(x) {
    const [from, to] = this.frame.header.window;
    return x >= from && x <= to ? this.frame : this.whole;
  }

  step(x, direction) {
    const frame = this._finest(x);
    if (!frame) return super.step(x, direction);
    const { times } = frame.arrays, next = columnAt(frame, x) + direction;
    return times[Math.min(times.length - 1, Math.max(0, next))];
  }

  describe(x, y) {
    const frame = this.frame && this._finest(x);
    if (!frame) return null;
    const { header, arrays } = frame, k = columnAt(frame, x), count = arrays.times.length;
    const lines = [header.clock ? moment(arrays.times[k], header.clock, this.view.x[1] - this.view.x[0])
      : `t = ${moment(arrays.times[k], null, this.view.x[1] - this.view.x[0])}`, `${header.name} = ${text(y)}`];
    if (arrays.cells) {
      lines.push(`density ${text(densityAt(frame, k, y), 4)}`);
      if (!header.periodic) lines.push(`P(${header.name} ≤ ${text(y, 4)}) = ${text(massBelow(frame, k, y), 4)}`);
    }
    lines.push(`mean ${text(arrays.mean[k])}`);
    const share = Math.round(100 * (header.levels[1] - header.levels[0]));
    lines.push(`${share}% band ${text(arrays.quantiles[k])} to ${text(arrays.quantiles[count + k])}`);
    if (arrays.truth && !Number.isNaN(arrays.truth[k])) lines.push(`truth ${text(arrays.truth[k])}`);
    return { x: arrays.times[k], y, lines };
  }
}

/** Add the borders between columns, and the sums of the cells. */
function prepared(frame) {
  const { arrays, shapes } = frame, { times, cells } = arrays, count = times.length;
  const borders = (frame.borders = new Float64Array(count + 1));
  for (let k = 1; k < count; k++) borders[k] = (times[k - 1] + times[k]) / 2;
  borders[0] = count > 1 ? times[0] - (borders[1] - times[0]) : times[0] - 0.5;
  borders[count] = count > 1 ? times[count - 1] + (times[count - 1] - borders[count - 1]) : times[0] + 0.5;
  const distances = Float64Array.from({ length: count - 1 }, (_, k) => times[k + 1] - times[k]).sort();
  frame.reach = count > 1 ? REACH * distances[(count - 1) >> 1] : Infinity;
  if (!cells) return frame;
  const rows = (frame.rows = shapes.cells[1]), sums = (frame.sums = new Float32Array(count * (rows + 1)));
  for (let k = 0; k < count; k++) {
    let total = 0;
    for (let r = 0; r < rows; r++) {
      total += cells[k * rows + r] / 65535;
      sums[k * (rows + 1) + r + 1] = total;
    }
  }
  return frame;
}

function columnAt(frame, x) {
  return Math.min(frame.arrays.times.length - 1, Math.max(0, firstAtLeast(frame.borders, x) - 1));
}

/** Return the density of column k at a value: linear between the middles of cells; on a circle the sum over turns. */
function densityAt(frame, k, value) {
  const { low, high, cells, peak } = frame.arrays, rows = frame.rows;
  let total = 0;
  for (const turn of frame.header.periodic ? [-TURN, 0, TURN] : [0]) {
    const place = ((value + turn - low[k]) / (high[k] - low[k])) * rows - 0.5, i = Math.floor(place), part = place - i;
    const cell = (j) => (j >= 0 && j < rows ? cells[k * rows + j] : 0);
    total += (1 - part) * cell(i) + part * cell(i + 1);
  }
  return (total / 65535) * peak[k];
}

function massBelow(frame, k, value) {
  const { low, high } = frame.arrays, rows = frame.rows, offset = k * (rows + 1);
  return sumTo(frame.sums, offset, rows, ((value - low[k]) / (high[k] - low[k])) * rows) / frame.sums[offset + rows];
}

function sumTo(sums, offset, rows, place) {
  if (place <= 0) return 0;
  if (place >= rows) return sums[offset + rows];
  const i = Math.floor(place);
  return sums[offset + i] + (place - i) * (sums[offset + i + 1] - sums[offset + i]);
}

/** Shade the pixels that a frame covers. */
function shade(pixels, across, down, view, frame, table) {
  const { times } = frame.arrays, { borders } = frame, [from, to] = view.x, width = (to - from) / across;
  const shades = new Float32Array(down), colours = new Uint32Array(down), [begin, end] = frame.header.window;
  let drawn = [-1, -1];
  for (let x = 0; x < across; x++) {
    const left = from + x * width, middle = left + width / 2;
    if (middle < Math.min(begin, borders[0]) || middle > Math.max(end, borders[borders.length - 1])) continue;
    // The columns whose times are in this pixel, or the one that is nearest.
    let first = firstAtLeast(times, left), last = firstAtLeast(times, left + width) - 1;
    if (last < first) {
      first = last = columnAt(frame, middle);
      if (Math.abs(times[first] - middle) > frame.reach) continue; // in a gap of the record no density is known
    }
    if (first !== drawn[0] || last !== drawn[1]) {
      shades.fill(0);
      for (let k = first; k <= last; k++) addColumn(shades, down, view.y, frame, k);
      const scale = 255 / (last - first + 1);
      for (let y = 0; y < down; y++) colours[y] = table[Math.min(255, (scale * shades[y] + 0.5) | 0)];
      drawn = [first, last];
    }
    for (let y = 0, at = x; y < down; y++, at += across) pixels[at] = colours[y];
  }
}

/**
 * Add column k to shades (down): its average density in each pixel, relative to the smaller one of its peak and of the density
 * that has all of its mass in one pixel. So a column that is narrower than a pixel is seen, at any zoom.
 */
function addColumn(shades, down, [bottom, top], frame, k) {
  const { low, high, cells, peak, quantiles, times } = frame.arrays, pixel = (top - bottom) / down, { rows, sums } = frame;
  const turns = frame.header.periodic ? [-TURN, 0, TURN] : [0];
  for (const turn of turns) {
    let begin = cells ? low[k] + turn : quantiles[k] + turn, end = cells ? high[k] + turn : quantiles[times.length + k] + turn;
    if (!cells && end < begin) end += TURN; // a band across the cut of the circle
    if (!(end >= bottom && begin <= top)) continue;
    const first = Math.max(0, Math.floor((top - end) / pixel)), last = Math.min(down - 1, Math.floor((top - begin) / pixel));
    if (!cells) {
      for (let y = first; y <= last; y++) shades[y] += FLAT;
      continue;
    }
    const cell = (end - begin) / rows, offset = k * (rows + 1);
    if (pixel <= cell) {
      for (let y = first; y <= last; y++) {
        const place = (top - (y + 0.5) * pixel - begin) / cell - 0.5, i = Math.floor(place), part = place - i;
        const below = i >= 0 && i < rows ? cells[k * rows + i] : 0, above = i >= -1 && i < rows - 1 ? cells[k * rows + i + 1] : 0;
        shades[y] += ((1 - part) * below + part * above) / 65535;
      }
      continue;
    }
    const scale = (cell / pixel) * Math.max(1, pixel * peak[k]);
    let above = sumTo(sums, offset, rows, (top - first * pixel - begin) / cell);
    for (let y = first; y <= last; y++) {
      const below = sumTo(sums, offset, rows, (top - (y + 1) * pixel - begin) / cell);
      shades[y] += scale * (above - below);
      above = below;
    }
  }
}
