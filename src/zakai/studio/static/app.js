// The page: its state, what happens when a part of it changes, and the order in which the studio is asked.

import { decoded, encoded } from "./address.js";
import { Compare } from "./compare.js";
import { Data } from "./data.js";
import { byId, debounced, formulas, h, segments } from "./dom.js";
import { Editor } from "./editor.js";
import { EXAMPLE } from "./example.js";
import { Form } from "./form.js";
import { Link, Superseded } from "./link.js";
import { Stream } from "./stream.js";
import { Method } from "./method.js";
import { Observations, Residuals } from "./observations.js";
import { Parameters } from "./parameters.js";
import { Result } from "./result.js";
import { Summary } from "./summary.js";
import { Takeaway } from "./takeaway.js";
import { TwoStates } from "./joint.js";
import { Algebra } from "./algebra.js";

const SHORT = 700; // milliseconds after which a computation can be cancelled
const OUTDATED = 1000; // milliseconds after which a run ends when another one is wanted
const TYPING = 220, RESTING = 600; // milliseconds without a key before the model is read, and before methods are looked for

class Studio {
  constructor() {
    this.link = new Link();
    this.works = 0; // computations beside a run that take long
    this.state = { text: "", data: null, method: "auto", options: {}, coordinate: null, tab: "parameters", until: null };
    this.model = null; // what the text holds, null while it has an error
    this.summary = null; // of the main result
    this.editor = new Editor(byId("editor"), (text) => this.write(text));
    this.form = new Form(byId("form"), (changes) => this.change(changes));
    this.result = new Result(this);
    this.data = new Data(this);
    this.method = new Method(this);
    this.tabs = new Map([
      ["parameters", new Parameters(this)], ["summary", new Summary(this)], ["observations", new Observations(this)], ["residuals", new Residuals(this)],
      ["joint", new TwoStates(this)], ["compare", new Compare(this)], ["stream", new Stream(this)], ["algebra", new Algebra(this)], ["export", new Takeaway(this)],
    ]);
    this.read = debounced(() => this._read(), TYPING);
    this.rest = debounced(() => this._rested(), RESTING);
    this.remember = debounced(() => this._remember(), 400);
    this._build();
    this.link.onhello = (hello) => this._begin(hello);
    this.link.onlost = (said) => this.say(said, true);
    this.link.onstream = (header) => this.tabs.get("stream").arrived(header);
    this.link.open();
  }

  // What a request needs: the model, the record and the method.
  get request() {
    const { text, data, method, options } = this.state;
    return { text, data, method, options };
  }

  /**
   * Ask the studio; what a newer request has replaced ends silently, an error is said in the line of status unless `quiet`.
   * `work`: this may take long; it can then be cancelled.
   */
  async ask(what, request = {}, more = {}) {
    const end = more.work ? this._working() : null;
    try {
      return await this.link.ask(what, request, more);
    } catch (error) {
      if (error instanceof Superseded) return null;
      if (more.quiet) throw error;
      if (!error.cancelled || this.cancelling) this.say(error.cancelled ? "Cancelled." : error.message, !error.cancelled);
      return null;
    } finally {
      end?.();
    }
  }

  /** A request that may take long has begun: it can be cancelled once it does; what is returned is called at its end. */
  _working() {
    let shown = 0;
    const show = (by) => { shown += by; this.works += by; this._bar(); };
    const timer = setTimeout(() => show(1), SHORT);
    return () => { clearTimeout(timer); if (shown) show(-1); };
  }

  _bar() {
    byId("cancel").hidden = byId("progress").hidden = !this.running && !this.works;
    this.progressed(0, null);
  }

  say(text, wrong = false) {
    const status = byId("status");
    status.textContent = text;
    status.classList.toggle("fault", wrong);
  }

  async _begin(hello) {
    const first = !this.hello;
    this.hello = hello;
    if (!first) { this.say("Connected again."); await this._read(); await this.run(); return; }
    const stored = await decoded(location.hash);
    const given = hello.model ? { text: hello.model, data: this.data.simulated(hello.model) } : EXAMPLE;
    Object.assign(this.state, stored ?? given);
    if (!stored && hello.record) this.state.data = { kind: "file", ...hello.record };
    this.editor.value = this.state.text;
    this.tabs.get("stream").offered(hello.follow);
    this.data.draw();
    this._tab(this.tabs.has(this.state.tab) ? this.state.tab : "parameters");
    this._gallery();
    await this._read();
    await this.run();
  }

  async _gallery() {
    const found = await this.ask("gallery");
    if (!found) return;
    this.gallery = found.models;
    const select = byId("gallery");
    select.append(h("option", { value: "*" }, "two wells (the example)"), ...found.models.map(({ name, about }) => h("option", { value: name, title: about }, name)));
    select.addEventListener("change", () => {
      const chosen = select.value, model = chosen === "*" ? EXAMPLE : this.gallery.find(({ name }) => name === chosen);
      select.value = "";
      if (model) this.load(model.text, model.data ?? this.data.simulated(model.text));
    });
  }

  /** Take another model, with a record that is simulated for it, and filter. */
  async load(text, data) {
    Object.assign(this.state, { text, data, method: "auto", options: {}, coordinate: null, until: null });
    this.editor.value = text;
    this.data.draw();
    this.method.clear();
    if (await this.read.now()) await this.run();
  }

  /** Take the model of a file of the reader, with the record that is there. */
  async open(file) {
    if (file.size > 1 << 20) { this.say(`${file.name}: is larger than 1 MiB, which no model file is.`, true); return; }
    const text = await file.text();
    await this.load(text, this.state.data.kind === "file" && this.state.data.file ? { ...this.state.data, columns: undefined, inputs: undefined } : this.data.simulated(text));
  }

  /** The text was changed by the reader. */
  write(text) {
    this.state.text = text;
    this.remember();
    this.read();
  }

  /** Other values of parameters are to be filtered with the record that is there. */
  async changeParameters(values) {
    this.data.keep();
    const texts = Object.fromEntries(Object.entries(values).map(([name, value]) => [name, String(value)]));
    if (await this.change({ parameters: texts })) await this.run();
  }

  /** Keys of the model were changed by a form or a slider. */
  async change(changes) {
    const found = await this.ask("write", { text: this.state.text, changes });
    if (!found) return false;
    this.state.text = found.text;
    this.editor.value = found.text;
    this.remember();
    return this.read.now();
  }

  async _read() {
    const text = this.state.text, found = await this.ask("check", { text });
    if (!found || text !== this.state.text) return false;
    const fault = byId("model-error");
    fault.hidden = !found.fault;
    fault.replaceChildren(...(found.fault ? [found.place ? h("button", { type: "button", class: "place", onclick: () => this.editor.reveal() }, `line ${found.place.line}`) : "", found.place ? " " : "", found.fault] : []));
    this.editor.mark(found.place);
    this.form.show(found.form);
    this.form.mark(found.place);
    const before = JSON.stringify(this.model);
    this.model = found.model ?? null;
    byId("run").disabled = !this.model || this.running;
    byId("model-said").textContent = this.model ? "" : "has an error";
    byId("model-said").classList.toggle("fault", !this.model);
    if (!this.model) { this.say("The model has an error; correct it to run.", true); return false; }
    if (byId("status").textContent.startsWith("The model has an error")) this.say("The model is complete; press Run.");
    byId("title").textContent = this.model.name || "untitled model";
    document.title = `${this.model.name || "untitled"} – zakai studio`;
    formulas(byId("equations"), this.model.equations);
    if (JSON.stringify(this.model) !== before) {
      this.data.modelled();
      for (const tab of this.tabs.values()) tab.modelled?.();
      this.rest();
    }
    return true;
  }

  _rested() {
    this.data.describe();
    this.method.look();
    this.tabs.get(this.state.tab).open?.();
  }

  /** Filter the record with the method that is chosen. */
  async run() {
    if (this.running) { this._next(); return; }
    if (!this.model) return;
    if (this.works && !this.tabs.get("compare").kept.length) this.link.drop(); // a run does not wait for what it makes outdated
    if (!this.model.prior) { this.say("The model has no prior: add a table [prior] to filter; it can be analysed without.", true); return; }
    this.begun = { at: performance.now(), asked: JSON.stringify(this.request) };
    const found = await this.task("run", "Filtering …", { ...this.request, name: "main" });
    this.begun = null;
    if (!found) return;
    this.summary = found;
    this.remember();
    await this.result.filtered(found);
    for (const tab of this.tabs.values()) tab.filtered?.(found);
    this.tabs.get(this.state.tab).open?.();
    this.method.look();
  }

  /** Something else is to be filtered: what runs ends where it takes long, unless results are kept, which its process holds. */
  _next() {
    if (this.begun?.asked === JSON.stringify(this.request)) return;
    this.again = true;
    if (!this.begun) this.say(`${this.said} The filter runs after it; Cancel ends it.`);
    if (this.begun && performance.now() - this.begun.at > OUTDATED && !this.tabs.get("compare").kept.length) this.link.tell("cancel");
  }

  /** Ask for a task that the page is busy with. There is one at a time: another one has to wait, and the status says so. */
  async task(what, said, request) {
    if (this.running) { this.say(`${this.said} It has not ended; press Cancel to end it.`); return null; }
    this.busy(true, said);
    const found = await this.ask(what, request, { progress: (done, total) => this.progressed(done, total), said: (text) => this.say(`${said} ${text}`) });
    this.busy(false);
    return found;
  }

  busy(on, said = "") {
    this.running = on;
    this.said = said;
    byId("run").disabled = on || !this.model;
    this._bar();
    document.body.classList.toggle("busy", on);
    if (on) { this.cancelling = false; this.say(said); }
    if (!on && this.again) { this.again = false; setTimeout(() => this.run()); } // what was wanted meanwhile
  }

  progressed(done, total) {
    const bar = byId("progress");
    bar.classList.toggle("open", !total);
    if (total) {
      const share = Math.round((100 * done) / total);
      bar.setAttribute("aria-valuenow", share);
      bar.firstElementChild.style.width = `${share}%`;
      bar.title = `${done.toLocaleString("en")} of ${total.toLocaleString("en")}`;
    } else { bar.removeAttribute("aria-valuenow"); bar.title = ""; }
  }

  async _remember() {
    const kept = await encoded(this.state);
    history.replaceState(null, "", `${location.pathname}${location.search}#${kept}`); // "#" alone would follow <base>
  }

  _tab(name) {
    this.state.tab = name;
    for (const [key, tab] of this.tabs) {
      tab.panel.hidden = key !== name;
      const button = byId(`tab-${key}`);
      button.setAttribute("aria-selected", String(key === name));
      button.tabIndex = key === name ? 0 : -1;
    }
    clearTimeout(this.opening); // one who passes by on the way to another part does not wait for this one
    this.opening = setTimeout(() => this.tabs.get(name).open?.(), 200);
    this.remember();
  }

  _build() {
    const list = byId("tabs"), names = [...this.tabs.keys()];
    for (const [key, tab] of this.tabs) {
      list.append(h("button", { type: "button", role: "tab", id: `tab-${key}`, "data-testid": `tab-${key}`, "aria-controls": `panel-${key}`, onclick: () => this._tab(key) }, tab.title));
      Object.assign(tab.panel, { id: `panel-${key}`, tabIndex: 0 });
      tab.panel.setAttribute("role", "tabpanel");
      tab.panel.setAttribute("aria-labelledby", `tab-${key}`);
      byId("tab-panels").append(tab.panel);
    }
    list.addEventListener("keydown", (event) => {
      const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!by) return;
      event.preventDefault();
      const next = names[(names.indexOf(this.state.tab) + by + names.length) % names.length];
      this._tab(next);
      byId(`tab-${next}`).focus();
    });
    const views = (chosen) => segments(byId("model-views"), [{ value: "text", text: "Text", testid: "view-text" }, { value: "form", text: "Form", testid: "view-form" }], chosen, (value) => {
      byId("editor").hidden = value !== "text";
      byId("form").hidden = value !== "form";
      views(value);
    });
    views("text");
    byId("run").addEventListener("click", () => this.run());
    byId("cancel").addEventListener("click", () => { this.cancelling = true; this.link.tell("cancel"); this.say("Cancelling …"); });
    document.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) { event.preventDefault(); this.read.now(); this.run(); }
    });
    byId("model-file").addEventListener("change", ({ target }) => { if (target.files[0]) this.open(target.files[0]); target.value = ""; });
    byId("skip").addEventListener("click", () => byId("stage").focus());
    byId("theme").addEventListener("click", () => {
      const root = document.documentElement, dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
      root.dataset.theme = dark ? "light" : "dark";
    });
  }
}

window.addEventListener("unhandledrejection", (event) => {
  byId("status").textContent = "Something in this page failed; reload it. The address keeps the model, the record and the method.";
  byId("status").classList.add("fault");
  console.error(event.reason);
});
window.studio = new Studio();
