// The method: which hold for the model and why others do not, what a run takes, and their options.

import { byId, field, h } from "./dom.js";

const SIGNS = { true: ["✓", "holds"], false: ["✗", "does not hold"], null: ["?", "not decided"] };
const ABOUT = {
  tolerance: "in standard deviations", seed: "of random draws", particles: "a fixed number", most_particles: "at most",
};

const short = (text) => (text.length > 90 ? `${text.slice(0, 88)} …` : text);

export class Method {
  constructor(studio) {
    this.studio = studio;
    this.found = null;
    this.times = {};
    this.body = byId("method-body");
    this.select = h("select", { "data-testid": "method", "aria-label": "Method", onchange: ({ target }) => this._choose(target.value) }, h("option", { value: "auto" }, "auto"));
    this.options = h("div", { class: "fields" });
    this.why = h("p", { class: "small" });
    this.list = h("ul", { class: "methods", "data-testid": "method-list" });
    this.body.append(h("div", { class: "row" }, this.select, h("button", { type: "button", class: "quiet", "data-testid": "measure", onclick: () => this.measure() }, "Expected times")), this.why, this.options,
      h("details", {}, h("summary", {}, "What holds, and why not"), this.list));
  }

  clear() {
    this.seen = "";
    this.times = {};
  }

  /** Ask which methods hold, unless that is known for this text. */
  async look() {
    const { text } = this.studio.state;
    if (!this.studio.model || this.seen === text) { this._options(); return; }
    const found = await this.studio.ask("methods", { text });
    if (!found) return;
    this.seen = text;
    this.found = found;
    this.draw();
  }

  draw() {
    const { found } = this, { method } = this.studio.state;
    if (!found) return;
    const held = found.methods.filter(({ holds }) => holds);
    this.select.replaceChildren(h("option", { value: "auto", selected: method === "auto" }, `auto: ${found.recommended ?? "none holds"}`),
      ...found.methods.map(({ name, holds }) => h("option", { value: name, selected: name === method }, `${SIGNS[holds][0]} ${name}`)));
    byId("method-said").textContent = `${held.length} of ${found.methods.length} hold`;
    this.why.textContent = found.explosion ? `Note: ${found.explosion}.` : found.division ?? (method === "auto" ? "" : found.methods.find(({ name }) => name === method)?.about ?? "");
    this.list.replaceChildren(...found.methods.map((one) => {
      const [sign, said] = SIGNS[one.holds], open = one.conditions.filter(({ holds }) => holds !== true);
      return h("li", {}, h("details", {},
        h("summary", {}, h("span", { class: `sign ${one.holds}`, title: said, "aria-label": said }, sign), h("strong", {}, one.name),
          h("span", { class: "because" }, this.times[one.name] ? ` ${this.times[one.name]}` : open.length ? ` ${short(`${open[0].statement}: ${open[0].evidence}`)}` : "")),
        h("p", { class: "small" }, one.about),
        h("ul", {}, one.conditions.map(({ statement, holds, evidence, source }) => h("li", {}, h("span", { class: `sign ${holds}`, "aria-label": SIGNS[holds][1] }, SIGNS[holds][0]), ` ${statement}`, h("small", {}, ` ${evidence} · ${source}`))))));
    }));
    this._options();
  }

  _options() {
    const { method, options } = this.studio.state;
    const name = method === "auto" ? this.found?.recommended : method, one = this.found?.methods.find((entry) => entry.name === name);
    if (this.options.contains(document.activeElement)) return;
    this.options.replaceChildren(...Object.entries(one?.options ?? {}).map(([key, value]) => field(key, h("input", {
      type: "text", value: options[key] ?? "", placeholder: value === null ? "default" : String(value), "data-testid": `option-${key}`, onchange: ({ target }) => {
        const rest = { ...this.studio.state.options };
        if (target.value.trim()) rest[key] = target.value.trim(); else delete rest[key];
        this.studio.state.options = rest;
        this.studio.remember();
        target.blur();
        this.studio.run();
      },
    }), ABOUT[key])));
  }

  _choose(name) {
    this.studio.state.method = name;
    this.studio.state.options = {};
    this.studio.remember();
    this.draw();
    this.studio.run();
  }

  async measure() {
    const names = (this.found?.methods ?? []).filter(({ holds }) => holds).map(({ name }) => name);
    const { text, data } = this.studio.state;
    this.studio.say("Measuring the methods that hold on the first observations …");
    const found = await this.studio.ask("expected", { text, data, methods: names }, { work: true });
    if (!found) return;
    this.times = found.times;
    this.studio.say("Expected times are in the list of methods.");
    this.draw();
    this.list.parentElement.open = true;
  }
}
