// The joint density of two states at several times, with a slider of times, the regions of highest density, mean and truth.
//
//   const view = new PlaneView(element, { testid: "plane", onTimeChange: (index) => ... });
//   view.setFrame(arrayBuffer);              // of zakai.report.plane.plane_bytes(result, ("x", "y"), index)
//   view.show(2);                            // time number 2 of the frame
//
// Frame (container: axes.js), header: kind "plane"; names [x, y]; periodic [bool, bool]; clock as in density.js; range {x, y};
// probabilities of the regions, such as [0.5, 0.95].
// Arrays for T times and N x N values each: times (T); index (T) positions in the result; origin (T, 2) and basis (T, 2, 2):
// value [j, i] is at origin + basis (i, j); values (T, N, N) uint16, 65535 the largest, whose density is peak (T);
// levels (T, regions): densities at the borders of the regions, relative to the peak; mean (T, 2); truth (T, 2), NaN where unknown.

import { moment, text, unpack } from "./axes.js";
import { Panel, make } from "./panel.js";

const TURN = 2 * Math.PI;

export class PlaneView extends Panel {
  constructor(element, options = {}) {
    super(element, { label: "Joint density of two states", height: 420, both: true, ...options });
    const row = make(this.root, "label", { display: "flex", gap: "10px", alignItems: "center", flexWrap: "wrap" });
    this.when = make(row, "span", { minWidth: "9rem", fontVariantNumeric: "tabular-nums" });
    this.slider = make(row, "input", { flex: "1 1 10rem" }, { type: "range", min: "0", step: "1", "aria-label": "Time", ...(options.testid ? { "data-testid": `${options.testid}-time` } : {}) });
    this.slider.addEventListener("input", () => {
      this.show(Number(this.slider.value));
      options.onTimeChange?.(this.frame.arrays.index[this.at]);
    }, { signal: this.stop.signal });
    this.row = row;
    this.frame = null;
  }

  setFrame(data) {
    const frame = unpack(data), { header } = frame, before = this.frame?.header;
    this.frame = frame;
    this.size = frame.shapes.values[1];
    const count = frame.arrays.times.length;
    this.slider.max = String(count - 1);
    this.slider.disabled = count < 2;
    this.slider.style.display = count < 2 ? "none" : "";
    ["x", "y"].forEach((axis, k) => (this.axes[axis] = { title: header.names[k], angle: header.periodic[k] }));
    const label = `Joint density of ${header.names.join(" and ")}`;
    this.root.setAttribute("aria-label", label);
    this.canvas.setAttribute("aria-label", label);
    this.setHome(header.range.x, header.range.y, !before || before.names.join() !== header.names.join());
    this.show(before ? Math.min(this.at, count - 1) : count - 1);
  }

  /** Show time number k of the frame. */
  show(k) {
    const { times } = this.frame.arrays, span = times[times.length - 1] - times[0] || 1;
    this.at = k;
    this.slider.value = String(k);
    const when = this.frame.header.clock ? moment(times[k], this.frame.header.clock, span) : `t = ${moment(times[k], null, span)}`;
    this.when.textContent = when;
    this.slider.setAttribute("aria-valuetext", when);
    const { x, y } = this.frame.header.range;
    this.setHome(this._reaching(x, 0), this._reaching(y, 1));
  }

  /** Return the range of an axis, widened where the window of the shown time goes beyond it. */
  _reaching([low, high], axis) {
    const { origin, basis } = this.frame.arrays, [a, b] = basis.subarray(4 * this.at + 2 * axis), half = 0.5 * (this.size - 1);
    const middle = origin[2 * this.at + axis] + (a + b) * half, reach = 0.8 * Math.hypot(a, b) * half;
    return this.frame.header.periodic[axis] || !Number.isFinite(middle + reach) ? [low, high] : [Math.min(low, middle - reach), Math.max(high, middle + reach)];
  }

  /** Return what places index coordinates of the shown time, and back. */
  _map() {
    const { origin, basis } = this.frame.arrays, k = this.at, [a, b, c, d] = basis.subarray(4 * k, 4 * k + 4);
    const det = a * d - b * c, [ox, oy] = origin.subarray(2 * k, 2 * k + 2);
    return {
      out: (i, j) => [ox + a * i + b * j, oy + c * i + d * j],
      back: (x, y) => [(d * (x - ox) - b * (y - oy)) / det, (a * (y - oy) - c * (x - ox)) / det],
      steps: { x: [d / det, -c / det], y: [-b / det, a / det] },
    };
  }

  /** Return the value at index coordinates, 0 to 1, linear between points. */
  _value(i, j) {
    const n = this.size, left = Math.floor(i), low = Math.floor(j);
    if (!(left >= 0 && low >= 0 && left < n - 1 && low < n - 1)) return 0;
    const values = this.frame.arrays.values, at = this.at * n * n + low * n + left, p = i - left, q = j - low;
    return ((1 - q) * ((1 - p) * values[at] + p * values[at + 1]) + q * ((1 - p) * values[at + n] + p * values[at + n + 1])) / 65535;
  }

  _turns() {
    const { periodic } = this.frame.header, turns = periodic.map((angle) => (angle ? [-TURN, 0, TURN] : [0]));
    return turns[0].flatMap((x) => turns[1].map((y) => [x, y]));
  }

  paint(context, place, colours) {
    if (!this.frame) return;
    const ratio = this.ratio, across = Math.round(place.w * ratio), down = Math.round(place.h * ratio), map = this._map();
    if (!this.hidden.has("density")) {
      if (this.image?.width !== across || this.image?.height !== down) this.image = context.createImageData(across, down);
      const pixels = new Uint32Array(this.image.data.buffer), { x: vx, y: vy } = this.view;
      const dx = (vx[1] - vx[0]) / across, dy = (vy[1] - vy[0]) / down;
      pixels.fill(colours.table[0]);
      for (const [tx, ty] of this._turns()) {
        for (let row = 0; row < down; row++) {
          let [i, j] = map.back(vx[0] + 0.5 * dx + tx, vy[1] - (row + 0.5) * dy + ty);
          for (let column = 0; column < across; column++, i += dx * map.steps.x[0], j += dx * map.steps.x[1]) {
            if (i < 0 || j < 0 || i >= this.size - 1 || j >= this.size - 1) continue;
            const shade = (255 * this._value(i, j) + 0.5) | 0;
            if (shade) pixels[row * across + column] = colours.table[shade];
          }
        }
      }
      context.putImageData(this.image, Math.round(place.x * ratio), Math.round(place.y * ratio));
    }
    if (!this.hidden.has("regions")) this._contours(context, colours, map);
    const { mean, truth } = this.frame.arrays, k = 2 * this.at;
    if (!this.hidden.has("mean")) cross(context, this.px(mean[k]), this.py(mean[k + 1]), colours.ink, 0);
    if (truth && !this.hidden.has("truth") && !Number.isNaN(truth[k] + truth[k + 1])) {
      cross(context, this.px(truth[k]), this.py(truth[k + 1]), colours.truth, Math.PI / 4);
    }
  }

  /** Draw the borders of the regions by marching squares. */
  _contours(context, colours, map) {
    const n = this.size, { levels, values } = this.frame.arrays, count = this.frame.header.probabilities.length, offset = this.at * n * n;
    context.strokeStyle = colours.band;
    for (const [tx, ty] of this._turns()) for (let r = 0; r < count; r++) {
      const level = levels[this.at * count + r] * 65535;
      context.lineWidth = r ? 1.4 : 0.9;
      context.beginPath();
      for (let j = 0; j < n - 1; j++) for (let i = 0; i < n - 1; i++) {
        const at = offset + j * n + i, corners = [values[at], values[at + 1], values[at + n + 1], values[at + n]];
        const places = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]], ends = [];
        for (let e = 0; e < 4; e++) {
          const one = corners[e], two = corners[(e + 1) % 4];
          if (one > level === two > level) continue;
          const part = (level - one) / (two - one), a = places[e], b = places[(e + 1) % 4];
          ends.push(map.out(a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])));
        }
        for (let e = 0; e + 1 < ends.length; e += 2) {
          context.moveTo(this.px(ends[e][0] - tx), this.py(ends[e][1] - ty));
          context.lineTo(this.px(ends[e + 1][0] - tx), this.py(ends[e + 1][1] - ty));
        }
      }
      context.stroke();
    }
  }

  items(colours) {
    if (!this.frame) return [];
    const { probabilities } = this.frame.header;
    const found = [
      { role: "density", text: "density / its peak", draw: (context, w, h) => colours.map.forEach((colour, k, all) => {
        context.fillStyle = colour;
        context.fillRect((k * w) / all.length, 0, w / all.length + 1, h);
      }) },
      { role: "regions", text: `regions of ${probabilities.map((p) => `${Math.round(100 * p)}%`).join(" and ")}`, draw: (context, w, h) => {
        context.strokeStyle = colours.band;
        context.beginPath();
        context.ellipse(w / 2, h / 2, 9, 4.5, 0, 0, 7);
        context.stroke();
      } },
      { role: "mean", text: "mean", draw: (context, w, h) => cross(context, w / 2, h / 2, colours.ink, 0) },
    ];
    if (this.frame.arrays.truth) found.push({ role: "truth", text: "truth", draw: (context, w, h) => cross(context, w / 2, h / 2, colours.truth, Math.PI / 4) });
    return found;
  }

  describe(x, y) {
    if (!this.frame) return null;
    const { names } = this.frame.header, { peak, mean } = this.frame.arrays, map = this._map();
    const value = this._turns().reduce((total, [tx, ty]) => total + this._value(...map.back(x + tx, y + ty)), 0);
    return { x, y, lines: [
      `${names[0]} = ${text(x)}`, `${names[1]} = ${text(y)}`, `density ${text(value * peak[this.at], 4)}`,
      `mean ${text(mean[2 * this.at])}, ${text(mean[2 * this.at + 1])}`,
    ] };
  }
}

function cross(context, x, y, colour, turn) {
  context.save();
  context.translate(x, y);
  context.rotate(turn);
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  for (const [dx, dy] of [[5, 0], [0, 5]]) {
    context.moveTo(-dx, -dy);
    context.lineTo(dx, dy);
  }
  context.stroke();
  context.restore();
}
