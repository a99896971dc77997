// Panels of lines, dots, bars and bands, such as residuals, predicted observations and figures of health.
//
//   const view = new ChartView(element, { testid: "residuals" });
//   view.setFrame(arrayBuffer);              // of zakai.report.charts.Chart(...).frame()
//
// Frame (container: axes.js), header: kind "chart"; across: panels in a row on a wide page; panels: list of
//   {title, label, height, wide (fills the row), link (panels with the same word zoom their horizontal axes together), x, y, series}
//   axis x or y: {title, clock, log, angle, range: [low, high] or null, zero: whether 0 belongs to it}
//   series: {kind, text (of the legend; none without), colour, width, dash, size, shape} and, by kind,
//     "line", "dots", "rings", "area" (down to 0), "bars" (with `width` in units of the axis): names of the arrays x and y;
//     dots with `spread`: an array of half bars; "between": arrays x, low, high; "rows" {low, high}, "row" {at}, "mark" {at}: across
//   colour: "series", "ink", "band", "faint", "truth", "rule", or a number of the palette

import { moment, text, unpack } from "./axes.js";
import { Panel, drawSeries, make } from "./panel.js";

// Okabe and Ito 2008, which colour-blind readers tell apart, lightened on dark.
const PALETTE = { light: ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#1d2430"],
  dark: ["#56b4e9", "#ff9a52", "#2fc89c", "#e7a3c8", "#f0d84a", "#9fd4f7", "#f2f4f7"] };
const POINTS = new Set(["line", "dots", "rings", "area", "bars"]);

export class ChartView {
  constructor(element, options = {}) {
    this.element = element;
    this.options = options;
    this.panels = [];
  }

  /** Show a frame; where it has the same panels as the one before, what the reader sees stays. */
  setFrame(data) {
    const frame = unpack(data), { panels, across = 1 } = frame.header, said = JSON.stringify(panels.map((panel) => [panel.title, panel.y.title]));
    if (said !== this.said) {
      this.destroy();
      this.said = said;
      this.grid = make(this.element, "div", { display: "grid", gap: "4px 24px", gridTemplateColumns: `repeat(auto-fill, minmax(min(100%, max(${across > 2 ? 220 : 280}px, ${Math.floor(100 / across) - 4}%)), 1fr))` });
      this.panels = panels.map((panel, k) => {
        const cell = make(this.grid, "div", { minWidth: "0", gridColumn: panel.wide ? "1 / -1" : "auto" });
        if (panel.title) make(cell, "div", { font: "600 13px/1.4 system-ui, sans-serif", margin: "6px 0 0" }).textContent = panel.title;
        const testid = this.options.testid && (k ? `${this.options.testid}-${k}` : this.options.testid);
        return new ChartPanel(make(cell, "div"), { label: panel.label || panel.title || panel.y.title, height: panel.height || 200, testid, compact: k > 0 || across > 1,
          onViewChange: () => this._link(k) });
      });
    }
    panels.forEach((panel, k) => this.panels[k].setPanel(panel, frame.arrays));
    this.header = frame.header;
  }

  _link(k) {
    const { link } = this.header.panels[k];
    this.panels.forEach((panel, other) => {
      if (link && other !== k && this.header.panels[other].link === link) panel.setView({ x: this.panels[k].view.x, y: panel.view.y });
    });
  }

  destroy() {
    for (const panel of this.panels) panel.destroy();
    this.panels = [];
    this.grid?.remove();
    this.said = null;
  }
}

class ChartPanel extends Panel {
  setPanel(panel, arrays) {
    this.panel = panel;
    const scaled = (values, log) => (log ? Float64Array.from(values, Math.log10) : values);
    this.series = panel.series.map((one) => {
      const found = { ...one };
      for (const key of ["x", "y", "low", "high", "spread"]) if (typeof one[key] === "string") found[key] = arrays[one[key]];
      if (found.spread) found.ends = [1, -1].map((sign) => found.y.map((value, k) => value + sign * found.spread[k])).map((values) => scaled(values, panel.y.log));
      if (found.x) found.x = scaled(found.x, panel.x.log);
      for (const key of ["y", "low", "high"]) if (found[key]?.length) found[key] = scaled(found[key], panel.y.log);
      for (const key of ["at", "low", "high"]) if (typeof found[key] === "number" && (one.kind === "mark" ? panel.x : panel.y).log) found[key] = Math.log10(found[key]);
      return found;
    });
    this.axes.x = { ...panel.x };
    this.axes.y = { ...panel.y };
    const range = (axis, keys) => {
      const given = panel[axis].range;
      if (given) return panel[axis].log ? given.map(Math.log10) : given;
      let low = panel[axis].zero ? 0 : Infinity, high = panel[axis].zero ? 0 : -Infinity;
      for (const one of this.series) for (const key of keys) {
        for (const value of one[key]?.length ? one[key] : []) if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
        if (one.kind === "area" && axis === "y") low = Math.min(low, 0);
        if (one.kind === "row" && axis === "y" && panel.y.log) [low, high] = [Math.min(low, one.at), Math.max(high, one.at)];
      }
      if (!(low <= high)) return [0, 1];
      const margin = axis === "x" && this.series.every((one) => one.kind !== "bars") && !panel.x.log ? 0.01 * (high - low) : 0.06 * (high - low) || 0.05 * Math.abs(high);
      return [panel[axis].zero && low === 0 ? 0 : low - margin, high + margin];
    };
    this.setHome(range("x", ["x"]), range("y", ["y", "low", "high"]));
  }

  colour(one, colours) {
    return typeof one.colour === "number" ? PALETTE[colours.dark ? "dark" : "light"][one.colour % 7] : colours[one.colour ?? "series"];
  }

  paint(context, place, colours) {
    if (!this.series) return;
    for (const one of this.series) {
      if (one.text && this.hidden.has(one.text)) continue;
      const colour = this.colour(one, colours), { x, y } = one;
      context.fillStyle = context.strokeStyle = colour;
      context.lineWidth = one.width ?? 1.2;
      if (one.kind === "line") drawSeries(context, this, x, y, { colour, width: one.width ?? 1.2, dash: one.dash });
      else if (one.kind === "dots" || one.kind === "rings") this._dots(context, one);
      else if (one.kind === "rows") {
        context.globalAlpha = 0.18;
        context.fillRect(place.x, this.py(one.high), place.w, this.py(one.low) - this.py(one.high));
      } else if (one.kind === "row" || one.kind === "mark") {
        context.setLineDash(one.dash ?? []);
        context.beginPath();
        if (one.kind === "row") { context.moveTo(place.x, this.py(one.at)); context.lineTo(place.x + place.w, this.py(one.at)); }
        else { context.moveTo(this.px(one.at), place.y); context.lineTo(this.px(one.at), place.y + place.h); }
        context.stroke();
      } else if (one.kind === "bars") {
        context.globalAlpha = 0.8;
        const zero = this.py(Math.max(this.view.y[0], Math.min(0, this.view.y[1]))), width = Math.max(1, this.px(one.width) - this.px(0));
        x.forEach((at, k) => context.fillRect(this.px(at) - width / 2, Math.min(zero, this.py(y[k])), width, Math.abs(zero - this.py(y[k]))));
      } else {
        const low = one.kind === "between" ? one.low : new Float64Array(x.length), high = one.kind === "between" ? one.high : y;
        context.globalAlpha = 0.22;
        context.beginPath();
        x.forEach((at, k) => context.lineTo(this.px(at), this.py(high[k])));
        for (let k = x.length - 1; k >= 0; k--) context.lineTo(this.px(x[k]), this.py(low[k]));
        context.fill();
        context.globalAlpha = 1;
        if (one.kind === "area") drawSeries(context, this, x, y, { colour, width: one.width ?? 1.6 });
      }
      context.globalAlpha = 1;
      context.setLineDash([]);
    }
  }

  _dots(context, one) {
    const size = one.size ?? (one.x.length > 500 ? 1.5 : 2.2);
    one.x.forEach((value, k) => {
      const x = this.px(value), y = this.py(one.y[k]);
      if (!Number.isFinite(y)) return;
      if (one.ends) {
        context.beginPath();
        context.moveTo(x, this.py(one.ends[0][k]));
        context.lineTo(x, Math.min(this.py(one.ends[1][k]) || 1e6, 1e6));
        context.stroke();
      }
      marker(context, x, y, one.kind === "rings" ? 6 : size, one.shape ?? 0);
      if (one.kind === "rings") { context.lineWidth = 2; context.stroke(); } else context.fill();
    });
  }

  items(colours) {
    return (this.series ?? []).filter((one, k, all) => one.text && all.findIndex((other) => other.text === one.text) === k).map((one) => ({
      role: one.text, text: one.text, draw: (context, w, h) => {
        context.strokeStyle = context.fillStyle = this.colour(one, colours);
        context.lineWidth = Math.max(1.5, one.width ?? 1.2);
        context.setLineDash(one.dash ?? []);
        if (["rows", "between", "bars", "area"].includes(one.kind)) { context.globalAlpha = one.kind === "bars" ? 0.8 : 0.25; context.fillRect(2, 1, w - 4, h - 2); return; }
        context.beginPath();
        if (one.kind === "dots" || one.kind === "rings") { marker(context, w / 2, h / 2, one.kind === "rings" || one.shape ? 5 : 2.6, one.shape ?? 0); }
        else { context.moveTo(0, h / 2); context.lineTo(w, h / 2); }
        if (one.kind === "dots") context.fill(); else context.stroke();
      },
    }));
  }

  /** Return the nearest point, and the values of the other series at the same place. */
  describe(x, y) {
    let best = null, least = Infinity;
    const shown = (this.series ?? []).filter((one) => POINTS.has(one.kind) && !this.hidden.has(one.text));
    for (const one of shown) for (let k = 0; k < one.x.length; k++) {
      const distance = Math.abs(this.px(one.x[k]) - this.px(x)) + 0.2 * Math.abs(this.py(one.y[k]) - this.py(y));
      if (distance < least) [best, least] = [{ one, k }, distance];
    }
    if (!best) return null;
    const at = best.one.x[best.k], value = (number, axis) => text(axis.log ? 10 ** number : number);
    const { x: xAxis, y: yAxis } = this.panel;
    const lines = [xAxis.clock ? moment(at, xAxis.clock, this.view.x[1] - this.view.x[0]) : `${xAxis.title || "x"} ${value(at, xAxis)}`];
    for (const one of shown) {
      const k = one === best.one ? best.k : one.x.indexOf(at);
      if (k >= 0 && lines.length < 9) lines.push(`${one.text || yAxis.title || "value"} ${value(one.y[k], yAxis)}`);
    }
    return { x: at, y: best.one.y[best.k], lines };
  }
}

function marker(context, x, y, size, shape) {
  context.beginPath();
  if (shape === 0) context.arc(x, y, size, 0, 7);
  else if (shape === 1) context.rect(x - size * 0.9, y - size * 0.9, size * 1.8, size * 1.8);
  else if (shape === 5 || shape === 6) {
    const t = size * 0.35, angle = shape === 6 ? Math.PI / 4 : 0, points = [[-t, -size], [t, -size], [t, -t], [size, -t], [size, t], [t, t], [t, size], [-t, size], [-t, t], [-size, t], [-size, -t], [-t, -t]];
    for (const [a, b] of points) context.lineTo(x + a * Math.cos(angle) - b * Math.sin(angle), y + a * Math.sin(angle) + b * Math.cos(angle));
    context.closePath();
  } else {
    const corners = { 2: [-1.571, 0.524, 2.618], 3: [0, 1.571, 3.142, 4.712], 4: [1.571, 3.665, 5.76] }[shape];
    for (const angle of corners) context.lineTo(x + 1.3 * size * Math.cos(angle), y + 1.3 * size * Math.sin(angle));
    context.closePath();
  }
}
