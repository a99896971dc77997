// Results side by side: methods, models or parameters for the same record, with the difference of their log-likelihoods.

import { DensityView } from "./density.js";
import { h, number, table } from "./dom.js";

const NAMES = ["kept1", "kept2", "kept3", "kept4"], MOST = NAMES.length;

export class Compare {
  constructor(studio) {
    this.studio = studio;
    this.title = "Compare";
    this.kept = []; // {name, label, summary}
    this.number = 0;
    this.label = h("input", { type: "text", placeholder: "a name for this result", "aria-label": "name", "data-testid": "keep-name" });
    this.rows = h("div", { "data-testid": "compare-table" });
    this.pictures = h("div", { class: "pair" });
    this.panel = h("div", { class: "panel" },
      h("p", { class: "lead" }, "Keep a result, change the method, the model or a parameter, run, and keep the next one: both for the same record."),
      h("div", { class: "row" }, this.label, h("button", { type: "button", "data-testid": "keep", onclick: () => this.keep() }, "Keep this result")), this.rows, this.pictures);
  }

  filtered(found) {
    const values = Object.entries(this.studio.model.parameters).slice(0, 6).map(([name, value]) => `${name} = ${number(value, 3)}`).join(", ");
    this.label.value = [found.method, values].filter(Boolean).join(", ");
  }

  async keep() {
    const { studio } = this;
    if (!studio.summary) { studio.say("Run a filter first.", true); return; }
    const kept = this.kept.slice(1 - MOST), name = NAMES.find((one) => !kept.some((other) => other.name === one));
    const label = this._unused(this.label.value.trim() || `result ${++this.number}`);
    const found = await studio.ask("keep", { of: "main", name });
    if (!found) return;
    studio.data.keep(); // only results for one record can be compared
    studio.say(`Kept as “${label}”.`);
    this.kept = [...kept, { name, label, summary: found }];
    await this.draw();
  }

  _unused(label) {
    for (let k = 1; ; k++) {
      const name = k === 1 ? label : `${label} (${k})`;
      if (!this.kept.some((one) => one.label === name)) return name;
    }
  }

  async draw() {
    const { studio, kept } = this;
    this.rows.replaceChildren();
    if (kept.length > 1) {
      try {
        const found = await studio.ask("compare", { names: kept.map(({ name }) => name), labels: Object.fromEntries(kept.map(({ name, label }) => [name, label])) }, { quiet: true });
        if (found) this.rows.replaceChildren(table(["", "method", "log-likelihood", "difference", "warnings"], found.rows.map((row) => [row.name, row.method, number(row.log_likelihood, 7), number(row.difference, 4), String(row.warnings)]), "numbers"));
      } catch (error) { this.rows.replaceChildren(h("p", { class: "fault" }, error.message)); }
    }
    this.pictures.replaceChildren(...kept.map((one) => (one.figure ??= h("figure", {}, (one.place = h("div", {})), h("figcaption", {}, h("strong", {}, one.label), ` log-likelihood ${number(one.summary.log_likelihood, 6)} `,
      h("button", { type: "button", class: "quiet", onclick: () => { this.kept = this.kept.filter((other) => other !== one); this.draw(); } }, "remove"))))));
    for (const one of kept) {
      if (one.view) continue;
      one.view = new DensityView(one.place, { label: one.label, height: 240 });
      const state = one.summary.states.includes(studio.result.coordinate) ? studio.result.coordinate : one.summary.states[0];
      const found = await studio.ask("picture", { name: one.name, state, columns: 400 }, { channel: `picture-${one.name}` });
      if (found) one.view.setFrame(found.arrays.frame);
    }
  }
}
