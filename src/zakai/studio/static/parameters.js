// Sliders that filter again while they are dragged, the fit with intervals, and the profile of one parameter.

import { debounced, h, number, table } from "./dom.js";
import { LinePanel } from "./panels.js";

const STEPS = 400, ROWS = 96, FEWEST = 100, MOST = 160; // of a slider; cells and densities of a picture while one is dragged

export class Parameters {
  constructor(studio) {
    this.studio = studio;
    this.title = "Parameters";
    this.sliders = h("div", { class: "sliders" });
    this.fitted = h("div", { "data-testid": "fit-result" });
    this.drawn = h("div", {});
    this.hint = h("p", { class: "small" }, "While a slider moves, what is seen is filtered coarsely; when it is released, everything with the method's own.");
    this.none = h("p", {}, "The model has no parameters. Name some in [parameters], and use them in the formulas.");
    this.tools = h("div", { class: "row" },
      h("button", { type: "button", "data-testid": "fit", onclick: () => this.fit() }, "Fit"),
      h("label", { class: "small" }, (this.intervals = h("input", { type: "checkbox", "data-testid": "fit-intervals" })), " with 95% intervals"),
      h("span", { class: "grow" }),
      h("label", { class: "small" }, "Profile of ", (this.which = h("select", { "data-testid": "profile-of" }))),
      h("button", { type: "button", "data-testid": "profile", onclick: () => this.profile() }, "Draw"));
    this.panel = h("div", { class: "panel" }, this.none, this.sliders, this.hint, this.tools, this.fitted, this.drawn);
    this.inflight = null;
    this.dragged = false;
    this.settled = debounced(() => this._settle(), 350);
  }

  modelled() {
    const { parameters } = this.studio.model, names = Object.keys(parameters);
    this.none.hidden = names.length > 0;
    this.hint.hidden = this.tools.hidden = names.length === 0;
    this.which.replaceChildren(...names.map((name) => h("option", { value: name }, name)));
    if (this.dragged) return;
    const same = JSON.stringify(names) === JSON.stringify(Object.keys(this.inputs ?? {}));
    if (same) { for (const name of names) this._set(name, parameters[name]); return; }
    this.inputs = {};
    this.sliders.replaceChildren(...names.map((name) => this._slider(name, parameters[name])));
    this.fitted.replaceChildren();
    this.drawn.replaceChildren();
  }

  _slider(name, value) {
    const range = h("input", { type: "range", min: "0", max: String(STEPS), step: "1", "data-testid": `slider-${name}`, "aria-label": name,
      onpointerdown: () => { this.held = true; }, oninput: () => this._drag(name), onchange: () => this._release() });
    const box = h("input", { type: "text", inputMode: "decimal", class: "value", "aria-label": `value of ${name}`, "data-testid": `value-${name}`, onchange: () => {
      const now = Number(box.value.replace("−", "-"));
      if (!Number.isFinite(now)) { this._set(name, this.inputs[name].now); return; }
      this._set(name, now);
      this._release();
    } });
    this.inputs[name] = { range, box, low: 0, high: 1, now: value };
    this._set(name, value, true);
    return h("label", { class: "slider" }, h("span", {}, name), range, box);
  }

  /** Show a value; the range of a slider is around it: from 0 to three times, or of both signs. */
  _set(name, value, fresh = false) {
    const one = this.inputs[name];
    if (fresh || value < one.low || value > one.high) [one.low, one.high] = value > 0 ? [value / 10, 3 * value] : value < 0 ? [3 * value, value / 10] : [-1, 1];
    one.now = value;
    one.range.value = String(Math.round((STEPS * (value - one.low)) / (one.high - one.low)));
    one.box.value = number(value, 4);
  }

  _drag(name) {
    const one = this.inputs[name];
    one.now = Number((one.low + (one.high - one.low) * (Number(one.range.value) / STEPS)).toPrecision(4));
    one.box.value = number(one.now, 4);
    one.range.setAttribute("aria-valuetext", one.box.value);
    this.dragged = true;
    this._wanted(performance.now());
  }

  get values() { return Object.fromEntries(Object.entries(this.inputs).map(([name, one]) => [name, one.now])); }

  /** Ask for a picture with the values that are wanted now; while one is computed, only the last wish is kept. */
  async _wanted(since) {
    const { studio } = this;
    if (studio.running || !studio.summary || studio.result.name !== "main") return;
    if (this.inflight) { this.next = since; return; }
    this.inflight = true;
    const { from, to, width } = studio.result.seen(), columns = Math.round(Math.min(MOST, Math.max(FEWEST, width / 5)));
    const found = await studio.ask("slide", { ...studio.request, name: "main", values: this.values, state: studio.result.coordinate, from, to, columns, rows: ROWS });
    this.inflight = false;
    if (found && this.dragged) { // an answer after the release is late
      studio.result.view.setFrame(found.arrays.frame);
      requestAnimationFrame(() => performance.measure("slide", { start: since, end: performance.now() }));
      studio.say(found.log_likelihood === null ? `${this._said()}: what is seen, roughly` : `${this._said()}: log-likelihood about ${number(found.log_likelihood, 5)}`);
    }
    const next = this.next;
    this.next = null;
    if (next && this.dragged) this._wanted(next);
  }

  _said() { return Object.entries(this.values).map(([name, value]) => `${name} = ${number(value, 4)}`).join(", "); }

  /** The pointer has let go; keys are waited for, since each of them is a change. */
  _release() {
    if (this.held) this.settled.now(); else this.settled();
    this.held = false;
  }

  async _settle() {
    const { parameters } = this.studio.model, { values } = this;
    this.dragged = false;
    this.next = null;
    if (Object.keys(values).every((name) => values[name] === parameters[name])) return;
    await this.studio.changeParameters(values);
  }

  async fit() {
    const { studio } = this;
    const found = await studio.task("fit", "Fitting …", { ...studio.request, intervals: this.intervals.checked });
    if (!found) return;
    studio.say(`Fitted: ${found.message}.`);
    const rows = Object.entries(found.estimates).map(([name, value]) => [name, number(value, 6), number(found.errors[name], 2),
      found.intervals ? found.intervals[name].map((end) => (end === null ? "∞" : number(end, 4))).join(" to ") : "–"]);
    this.fitted.replaceChildren(h("h3", {}, "Maximum likelihood"), table(["parameter", "estimate", "standard error", "95% interval"], rows, "numbers"),
      h("p", { class: "small" }, `Log-likelihood ${number(found.log_likelihood, 7)} by ${found.method}; ${found.message}.`),
      found.warnings.length ? h("ul", { class: "notes" }, found.warnings.map((one) => h("li", {}, one))) : "",
      h("button", { type: "button", "data-testid": "take-fit", onclick: () => studio.changeParameters({ ...studio.model.parameters, ...found.estimates }) }, "Take these values"));
  }

  async profile() {
    const { studio } = this, parameter = this.which.value, one = this.inputs[parameter];
    const found = await studio.task("profile", `Profile of ${parameter} …`, { ...studio.request, parameter, low: one.low, high: one.high, count: 15 });
    if (!found) return;
    studio.say(`The log-likelihood for values of ${parameter}, the others as they are.`);
    const { values, log_likelihood: heights } = found.arrays, best = Math.max(...heights.filter(Number.isFinite));
    const place = h("div", {});
    this.drawn.replaceChildren(h("h3", {}, `Log-likelihood along ${parameter}`), place, h("p", { class: "small" }, "The dashed line is 1.92 below the highest value: what is above it is the 95% interval where the other parameters are known."));
    const shown = heights.map((value) => (value < best - 20 ? NaN : value));
    this.profiled = new LinePanel(place, { label: `Log-likelihood along ${parameter}`, height: 260 });
    this.profiled.show({ x: { title: parameter }, y: { title: "log-likelihood" },
      series: [{ role: "l", text: "log-likelihood", x: values, y: shown }, { role: "d", text: "", x: values, y: shown, dots: true }], marks: [{ y: best - 1.92 }, { x: one.now, dash: [2, 2] }] });
  }
}
