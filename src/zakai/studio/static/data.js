// The record: simulated, or a CSV whose columns are chosen; what it holds, its gaps and its unit of time.

import { byId, counted, debounced, field, h, number, segments } from "./dom.js";
import { upload } from "./link.js";
import { LinePanel } from "./panels.js";

const LARGEST = 64 << 20;
const LIKELY = /time|date|stamp|^t$/i; // names of a column of times
const UNITS = ["", "ns", "us", "ms", "s", "min", "h", "d"];

export class Data {
  constructor(studio) {
    this.studio = studio;
    this.file = null; // what the file that was dropped holds
    this.wanted = false; // whether the record is to be filtered once it is described
    this.describe = debounced(() => this._describe(), 150);
    this.body = byId("data-body");
    this.facts = h("p", { class: "small", "data-testid": "data-facts" });
    this.fault = h("p", { class: "fault", role: "alert", "data-testid": "data-error", hidden: true });
    this.sketch = h("div", { class: "sketch" });
    this.dropped();
  }

  /** Return how a record is simulated where nothing was said. */
  simulated(text) {
    const samples = /observation_kind\s*=\s*"samples"/.test(text);
    return { kind: "simulate", until: samples ? 20 : 10, step: samples ? 0.1 : 0.02, seed: 1 };
  }

  dropped() {
    const stop = (event) => { event.preventDefault(); document.body.classList.toggle("dropping", event.type === "dragover"); };
    for (const name of ["dragover", "dragleave"]) document.addEventListener(name, stop);
    document.addEventListener("drop", (event) => {
      stop(event);
      const file = event.dataTransfer?.files?.[0];
      if (file) (file.name.endsWith(".toml") ? this.studio.open(file) : this.take(file));
    });
  }

  draw() {
    const { data } = this.studio.state, simulate = data.kind !== "file";
    const kinds = h("div", { class: "segments", role: "group", "aria-label": "Where the record comes from" });
    segments(kinds, [{ value: "simulate", text: "Simulate", testid: "data-simulate" }, { value: "file", text: "File", testid: "data-file" }], data.kind, (kind) => {
      this.studio.state.data = kind === "simulate" ? this.simulated(this.studio.state.text) : this.file ? { kind, ...this.file } : { kind };
      this.draw();
      if (kind === "simulate" || this.file) this.changed();
    });
    this.columns = h("div", {});
    this.body.replaceChildren(kinds, simulate ? this._simulation(data) : this._upload(data), this.fault, this.sketch, this.facts);
    this.facts.textContent = "";
    if (!simulate && data.file) this._columns();
  }

  _simulation(data) {
    const box = (key, label, hint) => field(label, h("input", { type: "number", step: "any", value: String(data[key]), "data-testid": `simulate-${key}`, onchange: ({ target }) => {
      this.studio.state.data = { ...this.studio.state.data, [key]: key === "seed" ? Math.max(0, Math.round(Number(target.value) || 0)) : Number(target.value) };
      this.changed();
    } }), hint);
    const inputs = (this.studio.model?.inputs ?? []).map((name) => field(`input ${name}`, h("input", { type: "number", step: "any", value: String(data.inputs?.[name] ?? 0), onchange: ({ target }) => {
      this.studio.state.data = { ...this.studio.state.data, inputs: { ...data.inputs, [name]: Number(target.value) } };
      this.changed();
    } })));
    this.source = h("p", { class: "small", "data-testid": "record-source" });
    this._source();
    return h("div", {}, h("div", { class: "fields" }, box("until", "Until"), box("step", "Step"), box("seed", "Seed"), inputs), this.source);
  }

  /** The record stays that of the model as it is now, whatever becomes of the model. */
  keep() {
    const { state } = this.studio;
    if (state.data.kind === "file" || state.data.from) return;
    state.data = { ...state.data, from: state.text };
    this._source();
  }

  /** Say which model simulates the record, and offer the other way. */
  _source() {
    const { studio } = this, kept = Boolean(studio.state.data.from);
    const change = () => {
      if (kept) studio.state.data = { ...studio.state.data, from: undefined }; else this.keep();
      this._source();
      if (kept) this.changed(); else studio.remember();
    };
    this.source?.replaceChildren(kept ? "The record is kept while the model changes, to compare. " : "Another model draws another record. ",
      h("button", { type: "button", class: "place", "data-testid": "keep-record", onclick: change }, kept ? "Simulate again" : "Keep this record"));
  }

  _upload(data) {
    const input = h("input", { type: "file", accept: ".csv,.txt,.tsv,text/csv", "data-testid": "record-file", id: "record-file", class: "file", onchange: ({ target }) => target.files[0] && this.take(target.files[0]) });
    return h("div", {}, h("label", { class: "drop", for: "record-file" }, data.name ? h("strong", {}, data.name) : "Drop a CSV file here, or choose one",
      h("small", {}, "a column with the time, others with what was observed; at most 64 MiB and a million rows")), input, this.columns);
  }

  async take(file) {
    this.fault.hidden = true;
    try {
      const found = await upload(file, LARGEST);
      this.file = { file: found.file, name: file.name };
      this.studio.state.data = { kind: "file", ...this.file };
      this.draw();
      await this._columns(true);
    } catch (error) {
      if (this.studio.state.data.kind !== "file") { this.studio.state.data = { kind: "file" }; this.draw(); }
      this.wrong(error.message);
    }
  }

  /** A file with the true states, which the pictures show; one that is wrong is not kept. */
  async _truth(file) {
    const before = this.studio.state.data;
    try {
      const found = await upload(file, LARGEST);
      this.studio.state.data = { ...before, truth: { file: found.file, name: file.name, of: this.studio.model.state.join() } };
      this.wanted = true;
      if (await this._describe() === false) this.studio.state.data = before; else { this._mapping(); this.studio.remember(); }
    } catch (error) { this.wrong(error.message); }
  }

  wrong(message, said = "has an error") {
    this.fault.textContent = message;
    this.fault.hidden = false;
    this.facts.textContent = "";
    byId("data-said").textContent = said;
    byId("data-said").classList.add("fault");
  }

  async _columns(fresh = false) {
    const { data } = this.studio.state;
    let found;
    try {
      found = await this.studio.ask("columns", data, { quiet: true });
    } catch (error) { this.wrong(error.message); return; }
    if (!found) return;
    this.found = found;
    if (!found.timed) {
      const likely = found.every.find((name) => LIKELY.test(name));
      if (likely) { await this._timed(likely, fresh); return; }
      this.columns.replaceChildren(h("div", { class: "fields" }, this._time()));
      this.wrong("Choose the column of the time.", "columns to choose");
      return;
    }
    if (found.dated && !data.unit) this.studio.state.data = { ...data, unit: found.unit };
    this._mapping();
    this.changed(fresh);
  }

  /** Take another column as the time. */
  async _timed(time, fresh = true) {
    this.studio.state.data = { ...this.studio.state.data, time, columns: undefined, inputs: undefined, unit: undefined, origin: undefined };
    const chosen = document.activeElement?.dataset.testid === "column-time";
    this.columns.replaceChildren(h("div", { class: "fields" }, this._time())); // the other columns are to be matched again
    await this._columns(fresh);
    if (chosen) this.columns.querySelector("[data-testid=column-time]")?.focus();
  }

  _time() {
    const { time } = this.studio.state.data;
    return field("time", h("select", { "data-testid": "column-time", onchange: ({ target }) => this._timed(target.value) },
      time ? null : h("option", { value: "", selected: true }, "choose …"), this.found.every.map((name) => h("option", { value: name, selected: name === time }, name))));
  }

  _mapping() {
    const { found } = this, { model, state: { data } } = this.studio;
    if (!found?.timed || !model || data.kind !== "file") return;
    const names = found.columns.slice(1), [columns, inputs] = matched(names, data, model);
    this.studio.state.data = { ...data, columns, inputs };
    const choose = (what, chosen, key, j) => field(what, h("select", { "data-testid": `column-${what.split(" ").pop()}`, onchange: ({ target }) => {
      const list = [...this.studio.state.data[key]];
      list[j] = target.value;
      this.studio.state.data = { ...this.studio.state.data, [key]: list };
      this.changed();
    } }, chosen ? null : h("option", { value: "", selected: true }, "choose …"), names.map((name) => h("option", { value: name, selected: name === chosen }, name))));
    const truth = [h("label", { class: "drop small", for: "truth-file" }, data.truth ? h("strong", {}, data.truth.name) : "True states, where they are known", h("small", {}, `a CSV with time, ${model.state.join(", ")}`)),
      h("input", { type: "file", accept: ".csv,.txt,.tsv,text/csv", class: "file", id: "truth-file", "data-testid": "truth-file", onchange: ({ target }) => target.files[0] && this._truth(target.files[0]) })];
    const unit = field("Unit of time", h("select", { onchange: ({ target }) => { this.studio.state.data = { ...this.studio.state.data, unit: target.value || undefined }; this.changed(); } },
      UNITS.map((name) => h("option", { value: name, selected: name === (data.unit ?? this.studio.state.data.unit ?? "") }, name || "numbers"))), found.dated ? "of the model; the file has dates" : "");
    const origin = found.dated ? field("t = 0 at", h("input", { type: "text", "data-testid": "record-origin", value: data.origin ?? "", placeholder: "the first date", onchange: ({ target }) => {
      this.studio.state.data = { ...this.studio.state.data, origin: target.value.trim() || undefined };
      this.changed();
    } }), "a date such as 2024-01-31T12:00") : null;
    this.columns.replaceChildren(h("div", { class: "fields" }, data.time ? this._time() : null,
      columns.map((name, j) => choose(`observation ${model.observations[j]}`, name, "columns", j)),
      inputs.map((name, j) => choose(`input ${model.inputs[j]}`, name, "inputs", j)), unit, origin), ...truth,
      h("div", { class: "scroll" }, h("table", { class: "preview" }, h("thead", {}, h("tr", {}, found.columns.map((name) => h("th", {}, name)))),
        h("tbody", {}, found.rows.slice(0, 3).map((row) => h("tr", {}, row.map((cell) => h("td", {}, cell || "–"))))))));
  }

  /** The model is another one: other observations and inputs. */
  modelled() {
    const { data } = this.studio.state, { model } = this.studio;
    if (data.truth && model && data.truth.of !== model.state.join()) this.studio.state.data = { ...data, truth: undefined };
    if (data.kind === "file") this._mapping();
    else if (!this.body.contains(document.activeElement)) this.draw();
  }

  /** Another record: describe it and filter it. */
  async changed(run = true) {
    this.studio.remember();
    this.wanted ||= run;
    await this._describe();
  }

  /** Say what the record holds, and filter it if that is wanted; null where a newer description does both. */
  async _describe() {
    const done = await this._described();
    if (done && this.wanted) this.studio.run();
    if (done !== null) this.wanted = false;
    return done;
  }

  async _described() {
    const { studio } = this, { text, data } = studio.state;
    if (!studio.model || (data.kind === "file" && !data.file)) return false;
    if (data.kind === "file" && data.columns && data.inputs) {
      const open = [...studio.model.observations, ...studio.model.inputs].filter((_, k) => ![...data.columns, ...data.inputs][k]);
      if (open.length) { this.wrong(`Choose the column of ${open.join(", ")}.`, "columns to choose"); return false; }
    }
    let found;
    try {
      found = await studio.ask("describe", { text, data }, { quiet: true });
    } catch (error) { this.wrong(error.message); return false; }
    if (!found) return null;
    this.fault.hidden = true;
    byId("data-said").classList.remove("fault");
    byId("data-said").textContent = `${found.name}, ${counted(found.rows, "row")}`;
    const missing = found.names.map((name, j) => [name, found.missing[j]]).filter(([, count]) => count);
    const unit = found.unit ? ` ${found.unit}` : "";
    this.facts.textContent = [
      `${counted(found.rows, "row")}, times ${number(found.first, 6)} to ${number(found.last, 6)}${unit}`,
      found.irregular ? `irregular: one every ${number(found.step, 3)}${unit} at the median, the longest interval is ${number(found.longest, 3)}${unit}, after ${number(found.longest_from, 6)}` : found.step ? `one every ${number(found.step, 3)}${unit}` : "",
      missing.length ? `missing: ${missing.map(([name, count]) => `${name} in ${counted(count, "row")}`).join(", ")}` : "no missing values",
      found.origin ? `t = 0 at ${found.origin.replace("T", " ")}` : "",
    ].filter(Boolean).join(" · ");
    this._sketch(found);
    return true;
  }

  _sketch({ arrays, names, kind, clock }) {
    const { times, values } = arrays, m = names.length;
    if (!this.panel) this.panel = new LinePanel(this.sketch, { label: "The record", height: 130, compact: true });
    if (!this.sketch.isConnected) return;
    const colours = ["series", "truth", "band", "faint"];
    const series = names.slice(0, 4).map((name, j) => ({ role: `y${j}`, text: name, x: times, y: Float32Array.from({ length: times.length }, (_, k) => values[k * m + j]), dots: true, colour: colours[j] }));
    this.panel.show({ x: { title: "", clock }, y: { title: m === 1 ? names[0] : kind }, series });
  }
}

/**
 * Return the columns of the observations and of the inputs: those that were chosen, else those of their names, else the others in
 * their order where there are as many as are needed. An empty name is to be chosen by the reader.
 */
function matched(names, data, model) {
  const wanted = [...model.observations, ...model.inputs], m = model.observations.length;
  const chosen = data.columns?.length === m && data.inputs?.length === model.inputs.length ? [...data.columns, ...data.inputs] : [];
  const found = wanted.map((name, k) => (names.includes(chosen[k]) && chosen[k]) || (names.includes(name) ? name : ""));
  const free = names.filter((name) => !found.includes(name)), rest = [...free], open = found.filter((name) => !name).length;
  const full = found.map((name) => name || (open === free.length ? rest.shift() : ""));
  return [full.slice(0, m), full.slice(m)];
}
