// The density of two states, at a time that a slider chooses.

import { h } from "./dom.js";
import { PlaneView } from "./plane.js";

export class TwoStates {
  constructor(studio) {
    this.studio = studio;
    this.title = "Two states";
    this.across = h("select", { "aria-label": "state to the right", "data-testid": "across", onchange: () => this._ask() });
    this.up = h("select", { "aria-label": "state upwards", "data-testid": "up", onchange: () => this._ask() });
    this.place = h("div", { class: "square" });
    this.none = h("p", {}, "The model has one state; its density over time is above.");
    this.fault = h("p", { class: "fault", hidden: true });
    this.tools = h("div", { class: "row" }, this.across, h("span", {}, "and"), this.up);
    this.panel = h("div", { class: "panel" }, this.none, this.tools, this.fault, this.place);
  }

  filtered(found) {
    const { states } = found, several = states.length > 1, chosen = [this.across.value, this.up.value];
    const kept = chosen.every((name) => states.includes(name)) && chosen[0] !== chosen[1];
    this.none.hidden = several;
    this.tools.hidden = this.place.hidden = !several;
    [this.across, this.up].forEach((select, i) => select.replaceChildren(...states.map((name, k) => h("option", { value: name, selected: kept ? name === chosen[i] : k === i }, name))));
    this.several = several;
    this.seen = null;
  }

  open() {
    const { summary, running } = this.studio;
    if (!this.several || this.seen === summary || running) return;
    this.seen = summary;
    this._ask();
  }

  async _ask() {
    try {
      const found = await this.studio.ask("joint", { name: "main", across: this.across.value, up: this.up.value }, { quiet: true, work: true });
      if (!found) { this.seen = null; return; }
      this.fault.hidden = true;
      this.view ??= new PlaneView(this.place, { testid: "joint" });
      this.view.setFrame(found.arrays.frame);
    } catch (error) {
      this.fault.textContent = error.cancelled ? "Cancelled; press Run to compute again." : error.message;
      this.fault.hidden = false;
    }
  }
}
