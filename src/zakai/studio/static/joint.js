// The density of two states at a time that a slider chooses.

import { h, number } from "./dom.js";
import { JointPanel } from "./panels.js";

const STEPS = 500;

export class TwoStates {
  constructor(studio) {
    this.studio = studio;
    this.title = "Two states";
    this.across = h("select", { "aria-label": "state to the right", onchange: () => this._ask() });
    this.up = h("select", { "aria-label": "state upwards", onchange: () => this._ask() });
    this.time = h("input", { type: "range", min: "0", max: String(STEPS), value: String(STEPS), "data-testid": "joint-time", "aria-label": "time", oninput: () => this._ask() });
    this.said = h("output", { class: "small" });
    this.place = h("div", { class: "square" });
    this.none = h("p", {}, "The model has one state; its density over time is above.");
    this.tools = h("div", { class: "row" }, this.across, h("span", {}, "and"), this.up);
    this.when = h("label", { class: "slider" }, h("span", {}, "time"), this.time, this.said);
    this.panel = h("div", { class: "panel" }, this.none, this.tools, this.when, this.place);
  }

  filtered(found) {
    const several = found.states.length > 1;
    this.none.hidden = several;
    this.tools.hidden = this.when.hidden = this.place.hidden = !several;
    const chosen = [this.across.value, this.up.value];
    [this.across, this.up].forEach((select, i) => select.replaceChildren(...found.states.map((name, k) =>
      h("option", { value: name, selected: found.states.includes(chosen[i]) && chosen[0] !== chosen[1] ? name === chosen[i] : k === i }, name))));
    this.several = several;
    this.seen = null;
  }

  open() { if (this.several && this.seen !== this.studio.summary && !this.studio.running) { this.seen = this.studio.summary; this._ask(); } }

  async _ask() {
    if (this.inflight) { this.again = true; return; }
    this.inflight = true;
    const { first, last } = this.studio.summary, time = first + ((last - first) * Number(this.time.value)) / STEPS;
    const found = await this.studio.ask("joint", { name: "main", across: this.across.value, up: this.up.value, time });
    this.inflight = false;
    if (found) {
      this.panel2 ??= new JointPanel(this.place, { label: "Density of two states", height: 380, testid: "joint" });
      this.panel2.show({ ...found.arrays, levels: found.levels, names: [this.across.value, this.up.value] });
      this.said.textContent = `t = ${number(found.time, 5)}, correlation ${number(found.correlation, 3)}; lines bound the regions of 50% and 95%`;
    }
    if (this.again) { this.again = false; this._ask(); }
  }
}
