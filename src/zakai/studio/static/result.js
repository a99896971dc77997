// The density over time, with the words about it: the largest part of the page.

import { DensityView } from "./density.js";
import { byId, counted, h, number, segments } from "./dom.js";

const NAMES = { main: "Filtered", smooth: "Smoothed", forecast: "Forecast", stream: "Stream" };

export class Result {
  constructor(studio) {
    this.studio = studio;
    this.name = "main";
    this.available = new Map();
    this.view = new DensityView(byId("picture"), { testid: "density", height: pictureHeight(), onViewChange: (seen) => this._seen(seen) });
    byId("coordinate").addEventListener("change", ({ target }) => {
      studio.state.coordinate = target.value;
      studio.remember();
      this.picture();
    });
    byId("ahead").addEventListener("submit", (event) => {
      event.preventDefault();
      studio.state.until = byId("until").valueAsNumber;
      const { last } = this.available.get("main");
      if (!(studio.state.until > last)) { studio.say(`Forecast: take a time after the end of the record, ${number(last)}.`, true); return; }
      studio.remember();
      this._forecast();
    });
  }

  get states() { return this.available.get(this.name)?.states ?? []; }

  get coordinate() {
    const wanted = this.studio.state.coordinate;
    return this.states.includes(wanted) ? wanted : this.states[0];
  }

  /** A run has ended. */
  async filtered(summary) {
    this.available = new Map([["main", summary]]);
    this.name = "main";
    if (!this.studio.running) this.studio.say("Drawing the density …");
    await this.show();
    if (!this.studio.running) this.studio.say(`Filtered ${counted(summary.observations, "observation")} with ${summary.method}.`);
  }

  /** Another result is there, or another one is to be seen. */
  async show(name = this.name, summary = null) {
    if (summary) this.available.set(name, summary);
    this.name = name;
    const found = this.available.get(name);
    const select = byId("coordinate");
    select.replaceChildren(...found.states.map((state) => h("option", { value: state, selected: state === this.coordinate }, state)));
    byId("coordinate-label").hidden = found.states.length < 2;
    this._buttons();
    byId("ahead").hidden = name !== "forecast";
    if (name === "forecast") byId("until").value = String(Number(found.last.toPrecision(12)));
    this.words(found);
    await this.picture();
  }

  _buttons() {
    const options = ["main", "smooth", "forecast", "stream"].filter((name) => this.available.has(name) || name === "smooth" || name === "forecast")
      .map((name) => ({ value: name, text: NAMES[name], testid: `show-${name}` }));
    segments(byId("shown"), options, this.name, (name) => this._choose(name));
  }

  async _choose(name) {
    if (this.available.has(name)) { await this.show(name); return; }
    const { studio } = this;
    if (name === "smooth") {
      const found = await studio.task("smooth", "Smoothing …", { ...studio.request, name });
      if (!found) return;
      studio.say("Smoothed: each density is given all observations, earlier and later.");
      await this.show(name, found);
    } else await this._forecast();
  }

  /** Forecast to the time that the reader chooses; at first a fifth of the record beyond its end. */
  async _forecast() {
    const { studio } = this, { first, last } = this.available.get("main"), { until } = studio.state;
    const end = Number.isFinite(until) && until > last ? until : last + (last - first) / 5;
    const found = await studio.ask("forecast", { of: "main", until: end, step: (end - last) / 100, name: "forecast" }, { work: true });
    if (!found) return;
    studio.say(`Forecast: ${number(end - last)} beyond the end of the record, without observations.`);
    await this.show("forecast", found);
  }

  /** Ask for what can be seen. */
  async picture(window = {}) {
    const { name, coordinate } = this, columns = Math.round(Math.min(1000, Math.max(200, byId("picture").clientWidth)));
    const found = await this.studio.ask("picture", { name, state: coordinate, columns, ...window }, { channel: "picture", work: true });
    if (!found) return;
    this.view.setFrame(found.arrays.frame);
    byId("picture").dataset.shown = name;
  }

  _seen({ wanted }) {
    if (wanted) this.picture(wanted);
  }

  /** The part that is seen, for a slider. */
  seen() {
    const view = this.view.view && this.view.state();
    return view ? { from: view.from, to: view.to, width: view.width } : { width: 600 };
  }

  words(found) {
    byId("verdict").textContent = found.verdict;
    const ahead = found.kind === "forecast"; // which has neither observations nor a likelihood
    const facts = [
      ahead ? null : ["log-likelihood", number(found.log_likelihood, 7) + (found.log_likelihood_error ? ` ± ${number(found.log_likelihood_error, 2)}` : "")],
      ["method", found.method], [ahead ? "times" : "observations", found.observations.toLocaleString("en")], ["states", String(found.states.length)],
    ].filter(Boolean);
    byId("facts").replaceChildren(...facts.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", { "data-testid": `fact-${name}` }, value))));
    const notes = [...found.warnings, ...(found.notes ?? [])], box = byId("warnings");
    box.hidden = !notes.length;
    box.replaceChildren(...(notes.length ? [h("h3", {}, notes.length === 1 ? "A warning" : "Warnings"), h("ul", {}, notes.map((note) => h("li", {}, note)))] : []));
  }
}

const pictureHeight = () => Math.round(Math.min(520, Math.max(280, 0.46 * window.innerHeight)));
