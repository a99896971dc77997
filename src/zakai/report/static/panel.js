// A canvas with two axes that can be read, zoomed and moved by mouse, touch and keyboard. Pictures extend it.
//
// It is styled through the CSSOM alone, so it works under a Content-Security-Policy without inline styles or scripts.

import { angleTicks, dateTicks, logTicks, numberTicks, theme } from "./axes.js";

const HELP = "Drag to move. Wheel with Ctrl, or after a click into the picture, or pinch: zoom; with Shift, or over the vertical axis, " +
  "that axis. Double click: everything. Keys: arrows move the pointer, Shift and arrows the view; + and − zoom, Shift and + or − " +
  "the vertical axis; 0 shows everything; Escape hides the pointer.";
const LEAST = 1e-9; // of the whole range, or of the size of its numbers: the closest zoom
const HIDDEN = { position: "absolute", width: "1px", height: "1px", overflow: "hidden", clipPath: "inset(50%)", whiteSpace: "nowrap" };

let number = 0;

/** Return a new element with styles and attributes, in a parent. */
export function make(parent, name, style = {}, attributes = {}) {
  const element = document.createElement(name);
  Object.assign(element.style, style);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  parent.append(element);
  return element;
}

export class Panel {
  /**
   * @param {HTMLElement} element  where the panel is built; what was in it is replaced
   * @param {object} options
   *   label: what the picture shows, for a screen reader; height: in CSS pixels (360); testid: data-testid of the canvas;
   *   compact: without the buttons; both: whether zooming changes both axes (the horizontal one alone by default);
   *   onViewChange(view): called once a frame after the reader moved or zoomed; view = {x: [from, to], y: [from, to], width, height}
   */
  constructor(element, options = {}) {
    this.options = options;
    this.axes = { x: { title: "", clock: null }, y: { title: "", angle: false, log: false } };
    this.home = this.view = null;
    this.hidden = new Set(); // roles that the legend has switched off
    this.pointers = new Map();
    this.place = null; // of the pointer, in the units of the axes
    this._build(element);
    this._listen();
  }

  /** Show everything after `home` changed; a view that the reader chose stays unless `reset`. */
  setHome(x, y, reset = false) {
    const atHome = !this.view || (this.home && ["x", "y"].every((a) => this.view[a][0] === this.home[a][0] && this.view[a][1] === this.home[a][1]));
    this.home = { x: widened(x), y: widened(y) };
    if (reset || atHome) this.view = copy(this.home);
    this.redraw();
  }

  /** Show a range, as by a gesture but without a call of onViewChange. */
  setView(view) {
    this.view = view ? copy(view) : copy(this.home);
    this.redraw();
  }

  /** Draw with the next frame of the screen. */
  redraw() {
    if (!this.pending) this.pending = requestAnimationFrame(() => { this.pending = 0; this.draw(); });
  }

  /** Remove the panel and its listeners. */
  destroy() {
    cancelAnimationFrame(this.pending);
    this.stop.abort();
    this.sizes.disconnect();
    this.changes.disconnect();
    this.root.remove();
  }

  // What a picture defines: paint(context, place, colours) draws inside of the axes; describe(x, y) returns {x, y, lines: [text]}
  // for the pointer or null; items(colours) returns [{role, text, draw(context, width, height)}] for the legend.
  paint() {}
  describe() { return null; }
  items() { return []; }
  step(x, direction) { return x + (direction * (this.view.x[1] - this.view.x[0])) / 100; } // the next x of the pointer

  px(x) { return this.rect.x + ((x - this.view.x[0]) / (this.view.x[1] - this.view.x[0])) * this.rect.w; }
  py(y) { return this.rect.y + ((this.view.y[1] - y) / (this.view.y[1] - this.view.y[0])) * this.rect.h; }

  draw() {
    const width = this.stage.clientWidth, height = this.stage.clientHeight;
    if (!this.view || width < 40 || !this.root.isConnected) return;
    const colours = (this.colours ??= theme(this.root));
    const ratio = Math.min(3, window.devicePixelRatio || 1);
    const context = sized(this.canvas, width, height, ratio);
    context.font = `12px ${colours.font}`;
    const yTicks = this._ticks("y", Math.max(3, Math.floor((height - 50) / 36)));
    const left = Math.min(width / 3, Math.max(34, 12 + Math.max(0, ...yTicks.ticks.map((t) => context.measureText(t.text).width)) + 16));
    this.rect = { x: Math.round(left), y: 8, w: Math.round(width - left - 14), h: Math.round(height - 8 - 42) };
    this.ratio = ratio;
    context.fillStyle = colours.background;
    context.fillRect(0, 0, width, height);
    context.save();
    context.beginPath();
    context.rect(this.rect.x, this.rect.y, this.rect.w, this.rect.h);
    context.clip();
    this.paint(context, this.rect, colours);
    context.restore();
    this._drawAxes(context, yTicks, colours);
    this._drawLegend(colours);
    this._drawPointer();
  }

  _ticks(axis, most) {
    const [low, high] = this.view[axis], { clock, angle, log, title, ticks } = this.axes[axis];
    if (ticks) return { ticks: ticks.filter(({ at }) => at >= low && at <= high), title };
    if (clock) return dateTicks(low, high, most, clock);
    return { ticks: (log ? logTicks : angle ? angleTicks : numberTicks)(low, high, most), title };
  }

  _drawAxes(context, yTicks, colours) {
    const { x, y, w, h } = this.rect, xTicks = this._ticks("x", Math.max(3, Math.floor(w / 75)));
    context.strokeStyle = colours.rule;
    context.fillStyle = colours.faint;
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(x - 0.5, y);
    context.lineTo(x - 0.5, y + h + 0.5);
    context.lineTo(x + w, y + h + 0.5);
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const tick of xTicks.ticks) {
      const at = Math.round(this.px(tick.at)) - 0.5, half = context.measureText(tick.text).width / 2;
      context.moveTo(at, y + h);
      context.lineTo(at, y + h + 5);
      context.fillText(tick.text, Math.min(at, x + w + 13 - half), y + h + 7);
    }
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const tick of yTicks.ticks) {
      const at = Math.round(this.py(tick.at)) - 0.5;
      context.moveTo(x - 5, at);
      context.lineTo(x, at);
      context.fillText(tick.text, x - 8, at);
    }
    context.stroke();
    context.fillStyle = colours.ink;
    context.textBaseline = "bottom";
    context.fillText(xTicks.title, x + w, y + h + 41);
    context.save();
    context.translate(2, y + h / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.textBaseline = "top";
    context.fillText(yTicks.title, 0, 0, h);
    context.restore();
  }

  _drawLegend(colours) {
    const items = this.items(colours), said = JSON.stringify([items.map((item) => [item.role, item.text]), [...this.hidden], colours.ink, colours.map]);
    this.root.style.color = colours.ink;
    for (const button of this.buttons) Object.assign(button.style, { color: colours.ink, borderColor: colours.rule });
    Object.assign(this.tip.style, { background: colours.background, color: colours.ink, borderColor: colours.rule });
    if (said === this.said) return;
    this.said = said;
    const focused = document.activeElement?.dataset?.role;
    this.legend.replaceChildren();
    for (const item of items) {
      const on = !this.hidden.has(item.role);
      const button = make(this.legend, "button", { ...BUTTON, border: "0", opacity: on ? "1" : ".45", color: colours.ink, padding: "0 4px" },
        { type: "button", "aria-pressed": String(on), title: on ? "hide" : "show", "data-role": item.role });
      const swatch = make(button, "canvas", { width: "24px", height: "12px", marginRight: "6px", verticalAlign: "-1px" }, { "aria-hidden": "true" });
      item.draw(sized(swatch, 24, 12, this.ratio), 24, 12);
      button.append(item.text);
      button.addEventListener("click", () => {
        if (!this.hidden.delete(item.role)) this.hidden.add(item.role);
        this.redraw();
      });
      if (focused === item.role) button.focus();
    }
  }

  _drawPointer() {
    const width = this.stage.clientWidth, context = sized(this.overlay, width, this.stage.clientHeight, this.ratio);
    const found = this.place && this.describe(this.place.x, this.place.y);
    this.tip.hidden = !found;
    if (!found) return;
    const { x, y, w, h } = this.rect, at = [this.px(found.x), this.py(found.y)];
    if (at[0] < x - 1 || at[0] > x + w + 1 || at[1] < y - 1 || at[1] > y + h + 1) {
      this.tip.hidden = true;
      return;
    }
    context.strokeStyle = this.colours.faint;
    context.setLineDash([3, 3]);
    context.beginPath();
    context.moveTo(at[0], y);
    context.lineTo(at[0], y + h);
    context.moveTo(x, at[1]);
    context.lineTo(x + w, at[1]);
    context.stroke();
    this.tip.replaceChildren(...found.lines.map((line) => Object.assign(document.createElement("div"), { textContent: line })));
    const across = this.tip.offsetWidth, down = this.tip.offsetHeight;
    const beside = at[0] + 14 + across <= width ? at[0] + 14 : Math.max(0, at[0] - 14 - across);
    Object.assign(this.tip.style, { left: `${beside}px`, top: `${Math.max(0, Math.min(at[1] - down - 8, y + h - down))}px` });
    if (this.byKey) this.spoken.textContent = found.lines.join(", ");
  }

  // Gestures -----------------------------------------------------------------------------------------------------------------

  /** Zoom an axis about a place in its units; below 1 the factor shows less. */
  zoom(axis, factor, about) {
    const [low, high] = this.view[axis], home = this.home[axis], size = home[1] - home[0];
    const least = LEAST * Math.max(size, Math.abs(about));
    const width = Math.min(Math.max((high - low) * factor, least), axis === "x" ? size : 20 * size);
    const from = about - ((about - low) / (high - low)) * width;
    this._show(axis, from, from + width);
  }

  /** Move an axis by a part of what is seen. */
  pan(axis, part) {
    const [low, high] = this.view[axis], by = part * (high - low);
    this._show(axis, low + by, high + by);
  }

  _show(axis, from, to) {
    const home = this.home[axis], width = to - from;
    if (axis === "x") from = Math.min(Math.max(from, home[0]), Math.max(home[0], home[1] - width)); // no view beyond the record
    else from = Math.min(Math.max(from, home[0] - width), home[1]);
    this.view[axis] = [from, from + width];
    this._changed();
  }

  reset() {
    this.view = copy(this.home);
    this._changed();
  }

  _changed() {
    this.redraw();
    if (this.announced || !this.options.onViewChange) return;
    this.announced = requestAnimationFrame(() => {
      this.announced = 0;
      this.options.onViewChange(this.state());
    });
  }

  /** Return what is seen, as onViewChange receives it. */
  state() {
    return { ...copy(this.view), width: this.rect?.w ?? 0, height: this.rect?.h ?? 0 };
  }

  _at(event) {
    const box = this.canvas.getBoundingClientRect(), { x, y, w, h } = this.rect;
    const part = [(event.clientX - box.left - x) / w, (event.clientY - box.top - y) / h];
    const value = (axis, share) => this.view[axis][0] + share * (this.view[axis][1] - this.view[axis][0]);
    return { x: value("x", part[0]), y: value("y", 1 - part[1]), part };
  }

  _point(place, byKey = false) {
    this.place = place;
    this.byKey = byKey;
    if (!this.pointing) this.pointing = requestAnimationFrame(() => { this.pointing = 0; if (this.rect) this._drawPointer(); });
  }

  _listen() {
    this.stop = new AbortController();
    const on = (target, name, call, more = {}) => target.addEventListener(name, call, { signal: this.stop.signal, ...more });
    on(this.canvas, "pointerdown", (event) => {
      if (event.button || !this.rect) return;
      this.canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, event);
      this.moved = 0;
    });
    on(this.canvas, "pointermove", (event) => this._move(event));
    for (const name of ["pointerup", "pointercancel"]) on(this.canvas, name, (event) => {
      this.pointers.delete(event.pointerId);
      if (name === "pointerup" && event.pointerType === "touch" && this.moved < 6) this._point(this._at(event));
    });
    on(this.canvas, "pointerleave", () => { if (!this.byKey && !this.pointers.size) this._point(null); });
    on(this.canvas, "dblclick", () => this.reset());
    on(this.canvas, "wheel", (event) => {
      const pinch = event.ctrlKey || event.metaKey;
      if (!this.rect || !(pinch || document.activeElement === this.canvas)) return; // the page scrolls
      event.preventDefault();
      const at = this._at(event), delta = (event.deltaY || event.deltaX) * (event.deltaMode === 1 ? 20 : 1);
      const factor = Math.exp(Math.max(-0.7, Math.min(0.7, delta * (pinch && Math.abs(delta) < 40 ? 0.01 : 0.002))));
      const vertical = event.shiftKey || at.part[0] < 0;
      if (this.options.both || !vertical) this.zoom("x", factor, at.x);
      if (this.options.both || vertical) this.zoom("y", factor, at.y);
    }, { passive: false });
    on(this.canvas, "keydown", (event) => this._key(event));
    on(this.canvas, "blur", () => { if (this.byKey) this._point(null); });
    this.sizes = new ResizeObserver(() => this.redraw());
    this.sizes.observe(this.stage);
    const recolour = () => { this.colours = null; this.redraw(); };
    on(matchMedia("(prefers-color-scheme: dark)"), "change", recolour);
    on(window, "beforeprint", () => { this.colours = null; this.draw(); });
    this.changes = new MutationObserver(recolour);
    for (const one of [document.documentElement, document.body]) {
      this.changes.observe(one, { attributes: true, attributeFilter: ["class", "style", "data-theme", "data-print", "data-jp-theme-light"] });
    }
  }

  _move(event) {
    if (!this.rect) return;
    const before = this.pointers.get(event.pointerId);
    if (!before) {
      if (event.pointerType !== "touch") this._point(this._at(event));
      return;
    }
    const { w, h } = this.rect, across = event.clientX - before.clientX, down = event.clientY - before.clientY;
    this.moved += Math.abs(across) + Math.abs(down);
    if (this.pointers.size === 2) {
      const other = [...this.pointers.values()].find((one) => one.pointerId !== event.pointerId);
      const distance = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      const middle = this._at({ clientX: (event.clientX + other.clientX) / 2, clientY: (event.clientY + other.clientY) / 2 });
      const factor = Math.max(0.2, Math.min(5, distance(before) / Math.max(8, distance(event))));
      this.zoom("x", factor, middle.x);
      if (this.options.both) this.zoom("y", factor, middle.y);
    } else {
      this.pan("x", -across / w);
      if (event.pointerType !== "touch") this.pan("y", down / h);
      this._point(event.pointerType === "touch" ? null : this._at(event));
    }
    this.pointers.set(event.pointerId, event);
  }

  _key(event) {
    if (!this.rect || event.ctrlKey || event.metaKey || event.altKey) return;
    const arrow = { ArrowLeft: ["x", -1], ArrowRight: ["x", 1], ArrowDown: ["y", -1], ArrowUp: ["y", 1] }[event.key];
    const middle = (axis) => (this.view[axis][0] + this.view[axis][1]) / 2;
    if (arrow && event.shiftKey) this.pan(arrow[0], arrow[1] * 0.15);
    else if (arrow) this._step(...arrow);
    else if (["+", "=", "-", "_", "−", "*"].includes(event.key)) {
      const factor = ["+", "=", "*"].includes(event.key) ? 0.7 : 1 / 0.7;
      const axes = this.options.both ? ["x", "y"] : [event.shiftKey && event.key !== "=" && event.code !== "NumpadAdd" ? "y" : "x"];
      for (const axis of axes) this.zoom(axis, factor, this.place && this.byKey ? this.place[axis] : middle(axis));
    } else if (event.key === "0" || event.key === "Home") this.reset();
    else if (event.key === "Escape") this._point(null);
    else return;
    event.preventDefault();
  }

  _step(axis, direction) {
    const inside = (name, value) => Math.min(Math.max(value, this.view[name][0]), this.view[name][1]);
    const place = this.place ?? { x: (this.view.x[0] + this.view.x[1]) / 2, y: (this.view.y[0] + this.view.y[1]) / 2 };
    const moved = axis === "x" ? this.step(place.x, direction) : place.y + (direction * (this.view.y[1] - this.view.y[0])) / 40;
    this._point({ ...place, [axis]: inside(axis, moved) }, true);
  }

  // Document -----------------------------------------------------------------------------------------------------------------

  _build(element) {
    const id = `zakai-help-${++number}`, { label = "Picture", height = 360, testid } = this.options;
    element.replaceChildren();
    this.root = make(element, "div", { font: "13px/1.4 system-ui, -apple-system, 'Segoe UI', Roboto, Arial, sans-serif", position: "relative" },
      { role: "group", "aria-label": label });
    const bar = make(this.root, "div", { display: "flex", flexWrap: "wrap", alignItems: "center", gap: "2px 10px", minHeight: this.options.compact ? "0" : "30px" });
    this.legend = make(bar, "div", { display: "flex", flexWrap: "wrap", gap: "0 10px", flex: "1 1 12rem" }, { role: "group", "aria-label": "Legend" });
    const tools = make(bar, "div", { display: this.options.compact ? "none" : "flex", gap: "4px", marginLeft: "auto" });
    this.stage = make(this.root, "div", { position: "relative", height: `${height}px`, width: "100%" });
    this.canvas = make(this.stage, "canvas", { position: "absolute", inset: "0", width: "100%", height: "100%", touchAction: "pan-y", cursor: "crosshair" },
      { tabindex: "0", role: "img", "aria-label": label, "aria-describedby": id, ...(testid ? { "data-testid": testid } : {}) });
    this.overlay = make(this.stage, "canvas", { position: "absolute", inset: "0", width: "100%", height: "100%", pointerEvents: "none" }, { "aria-hidden": "true" });
    this.tip = make(this.stage, "div", { position: "absolute", pointerEvents: "none", padding: "4px 8px", border: "1px solid", borderRadius: "4px",
      fontSize: "12px", whiteSpace: "nowrap", fontVariantNumeric: "tabular-nums", boxShadow: "0 1px 4px rgb(0 0 0 / .25)" }, testid ? { "data-testid": `${testid}-hover` } : {});
    this.tip.hidden = true;
    this.spoken = make(this.root, "div", HIDDEN, { role: "status" });
    const help = make(this.root, "p", { margin: "4px 0", fontSize: "12px", maxWidth: "44rem" }, { id });
    help.textContent = HELP;
    help.hidden = true;
    const tool = (name, said, call) => {
      const button = make(tools, "button", BUTTON, { type: "button", "aria-label": said, title: said });
      button.textContent = name;
      button.addEventListener("click", call);
      return button;
    };
    const middle = (axis) => (this.view[axis][0] + this.view[axis][1]) / 2;
    const zoom = (factor) => { for (const axis of this.options.both ? ["x", "y"] : ["x"]) this.zoom(axis, factor, middle(axis)); };
    this.buttons = [
      tool("−", "Zoom out", () => this.view && zoom(2)),
      tool("+", "Zoom in", () => this.view && zoom(0.5)),
      tool("All", "Show everything", () => this.view && this.reset()),
      tool("?", "Mouse and keys", (event) => { help.hidden = !help.hidden; event.currentTarget.setAttribute("aria-expanded", String(!help.hidden)); }),
    ];
  }
}

const BUTTON = { background: "none", border: "1px solid", borderRadius: "4px", font: "inherit", minWidth: "28px", minHeight: "28px", padding: "0 7px", cursor: "pointer" };

const copy = (view) => ({ x: [...view.x], y: [...view.y] });

function widened([low, high]) {
  if (high > low) return [low, high];
  const by = Math.max(0.5, Math.abs(low) * 1e-3);
  return [low - by, low + by];
}

/** Return the context of a canvas of a size in CSS pixels, empty, scaled to the pixels of the screen. */
export function sized(canvas, width, height, ratio) {
  const across = Math.round(width * ratio), down = Math.round(height * ratio);
  if (canvas.width !== across || canvas.height !== down) [canvas.width, canvas.height] = [across, down];
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, across, down);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return context;
}

/** Draw a line through the points (x, y) that can be seen, broken where y is not a number; or dots. `x` rises. */
export function drawSeries(context, panel, x, y, { colour, width = 1.2, dash = [], dots = false, size = 2 }) {
  let first = 0, last = x.length;
  while (first < last - 1 && x[first + 1] < panel.view.x[0]) first++;
  while (last > first + 1 && x[last - 2] > panel.view.x[1]) last--;
  context.strokeStyle = context.fillStyle = colour;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.beginPath();
  let down = false;
  for (let k = first; k < last; k++) {
    if (Number.isNaN(y[k])) { down = false; continue; }
    const at = panel.px(x[k]), to = panel.py(y[k]);
    if (dots) { context.moveTo(at + size, to); context.arc(at, to, size, 0, 7); }
    else if (down) context.lineTo(at, to);
    else context.moveTo(at, to);
    down = true;
  }
  if (dots) context.fill(); else context.stroke();
  context.setLineDash([]);
}
