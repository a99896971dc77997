// The smaller pictures: lines and bands over time, and a histogram.

import { moment, text } from "./axes.js";
import { Panel, drawSeries } from "./panel.js";

/** Lines, dots and bands: show({x: {title, clock}, y: {title}, series: [{role, text, x, y, lower, upper, dots, dash, colour}], marks}). */
export class LinePanel extends Panel {
  show({ x = {}, y = {}, series, range, marks = [] }) {
    this.series = series;
    this.marks = marks;
    this.axes = { x: { title: "time", ...x }, y: { title: "", ...y } };
    const across = ends(series.map((one) => one.x)), up = range ?? ends(series.flatMap((one) => [one.y, one.lower, one.upper].filter(Boolean)));
    const margin = 0.06 * (up[1] - up[0]);
    this.setHome(across, range ?? [up[0] - margin, up[1] + margin], true);
  }

  paint(context, place, colours) {
    for (const one of this.series ?? []) {
      if (this.hidden.has(one.role)) continue;
      const colour = colours[one.colour ?? "series"] ?? colours.series;
      if (one.lower) {
        context.fillStyle = colour;
        context.globalAlpha = 0.16;
        context.beginPath();
        one.x.forEach((at, k) => context.lineTo(this.px(at), this.py(one.upper[k])));
        for (let k = one.x.length - 1; k >= 0; k--) context.lineTo(this.px(one.x[k]), this.py(one.lower[k]));
        context.fill();
        context.globalAlpha = 1;
      }
      if (one.y) drawSeries(context, this, one.x, one.y, { colour, dots: one.dots, dash: one.dash ?? [], width: one.width ?? 1.4, size: one.x.length > 500 ? 1.3 : 2 });
    }
    for (const { y, x, dash = [4, 3] } of this.marks ?? []) {
      context.strokeStyle = colours.faint;
      context.lineWidth = 1;
      context.setLineDash(dash);
      context.beginPath();
      if (y !== undefined) { context.moveTo(place.x, this.py(y)); context.lineTo(place.x + place.w, this.py(y)); }
      else { context.moveTo(this.px(x), place.y); context.lineTo(this.px(x), place.y + place.h); }
      context.stroke();
      context.setLineDash([]);
    }
  }

  items(colours) {
    const named = (this.series ?? []).filter((one) => one.text);
    return named.length < 2 ? [] : named.map((one) => ({ role: one.role, text: one.text, draw: (context, w, height) => {
      const colour = colours[one.colour ?? "series"] ?? colours.series;
      context.fillStyle = context.strokeStyle = colour;
      if (one.lower) { context.globalAlpha = 0.3; context.fillRect(0, 1, w, height - 2); context.globalAlpha = 1; }
      context.lineWidth = 1.5;
      context.setLineDash(one.dash ?? []);
      context.beginPath();
      if (one.dots) { context.arc(w / 2, height / 2, 2.5, 0, 7); context.fill(); }
      else if (one.y) { context.moveTo(0, height / 2); context.lineTo(w, height / 2); context.stroke(); }
    } }));
  }

  describe(x, y) {
    const lines = [];
    let nearest = x;
    for (const one of this.series ?? []) {
      if (!one.y || this.hidden.has(one.role) || !one.x.length) continue;
      let k = 0;
      for (let i = 1; i < one.x.length; i++) if (Math.abs(one.x[i] - x) < Math.abs(one.x[k] - x)) k = i;
      nearest = one.x[k];
      lines.push(`${one.text || this.axes.y.title} ${text(one.y[k])}`);
    }
    const { clock, title } = this.axes.x, when = clock ? moment(nearest, clock, this.view.x[1] - this.view.x[0]) : `${title || "x"} ${text(nearest)}`;
    return lines.length ? { x: nearest, y, lines: [when, ...lines] } : null;
  }
}

/** Bars of equal width over an interval: show({heights, low, high, band: [low, high], title, label}). */
export class BarPanel extends Panel {
  show({ heights, low = 0, high = 1, band = null, level = null, x = {}, y = {}, range = null }) {
    Object.assign(this, { heights, low, high, band, level });
    this.axes = { x: { title: "", ...x }, y: { title: "", ...y } };
    const all = [0, ...heights, ...(band ?? [])];
    this.setHome([low, high], range ?? [Math.min(...all) * 1.1, Math.max(...all) * 1.12 || 1], true);
  }

  paint(context, place, colours) {
    const width = (this.high - this.low) / this.heights.length;
    context.fillStyle = colours.series;
    context.globalAlpha = 0.75;
    this.heights.forEach((height, k) => {
      const from = this.px(this.low + (k + 0.06) * width), to = this.px(this.low + (k + 0.94) * width), zero = this.py(0), top = this.py(height);
      context.fillRect(from, Math.min(zero, top), to - from, Math.abs(zero - top));
    });
    context.globalAlpha = 1;
    context.strokeStyle = colours.ink;
    for (const [at, dash] of [...(this.band ?? []).map((level) => [level, [4, 3]]), ...(this.level === null ? [] : [[this.level, []]])]) {
      context.setLineDash(dash);
      context.beginPath();
      context.moveTo(place.x, this.py(at));
      context.lineTo(place.x + place.w, this.py(at));
      context.stroke();
    }
    context.setLineDash([]);
  }

  describe(x, y) {
    const width = (this.high - this.low) / this.heights.length, k = Math.floor((x - this.low) / width);
    if (k < 0 || k >= this.heights.length) return null;
    return { x, y, lines: [`${text(this.low + k * width, 3)} to ${text(this.low + (k + 1) * width, 3)}`, text(this.heights[k], 4)] };
  }
}

function ends(lists) {
  let low = Infinity, high = -Infinity;
  for (const list of lists) for (const value of list) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low <= high ? [low, high] : [0, 1];
}
