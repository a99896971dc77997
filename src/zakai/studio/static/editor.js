// The text of the model: a textarea over a coloured copy of itself, with numbers of lines and the place of an error.

import { h } from "./dom.js";

const TOKENS = /("""[^]*?"""|"(?:\\.|[^"\\\n])*"?|'[^'\n]*'?)|(#[^\n]*)|(^[ \t]*\[[^\]\n]*\])|(^[ \t]*[\w.-]+(?=[ \t]*=))/gm;

export class Editor {
  constructor(parent, onchange) {
    this.text = h("textarea", {
      "data-testid": "model-text", spellcheck: false, autocomplete: "off", autocapitalize: "off", wrap: "off",
      "aria-label": "Model file (TOML)", "aria-describedby": "model-error", rows: 4,
    });
    this.copy = h("pre", { class: "copy", "aria-hidden": "true" });
    this.lines = h("pre", { class: "lines", "aria-hidden": "true" });
    this.box = h("div", { class: "editor" }, this.lines, h("div", { class: "code" }, this.copy, this.text));
    parent.append(this.box);
    this.place = null;
    this.text.addEventListener("input", () => { this.place = null; this.draw(); onchange(this.text.value); });
    this.text.addEventListener("scroll", () => this._follow());
    this.text.addEventListener("keydown", (event) => this._key(event));
  }

  get value() { return this.text.value; }

  set value(text) {
    if (this.text.value === text) return;
    this.text.value = text;
    this.place = null;
    this.draw();
  }

  /** Show the place of an error ({start, stop, line}), or none. */
  mark(place) {
    this.place = place;
    this.text.setAttribute("aria-invalid", String(Boolean(place)));
    this.draw();
  }

  /** Move the cursor to the place of the error. */
  reveal() {
    if (!this.place) return;
    this.text.focus();
    this.text.setSelectionRange(this.place.start, this.place.stop);
  }

  draw() {
    const text = this.text.value, nodes = [];
    const add = (from, to, name) => {
      if (to <= from) return;
      const cut = this.place ? [this.place.start, this.place.stop].filter((at) => at > from && at < to) : [];
      let begin = from;
      for (const end of [...cut, to]) {
        const wrong = this.place && begin >= this.place.start && end <= this.place.stop;
        nodes.push(name || wrong ? h("span", { class: `${name ?? ""}${wrong ? " wrong" : ""}` }, text.slice(begin, end)) : text.slice(begin, end));
        begin = end;
      }
    };
    let at = 0;
    for (const found of text.matchAll(TOKENS)) {
      add(at, found.index, null);
      const name = found[1] !== undefined ? "string" : found[2] !== undefined ? "comment" : found[3] !== undefined ? "table" : "key";
      add(found.index, found.index + found[0].length, name);
      at = found.index + found[0].length;
    }
    add(at, text.length, null);
    this.copy.replaceChildren(...nodes, "\n");
    const count = text.split("\n").length;
    this.lines.replaceChildren(...Array.from({ length: count }, (_, k) => h("span", { class: this.place?.line === k + 1 ? "wrong" : "" }, `${k + 1}\n`)));
    this.text.rows = Math.min(24, Math.max(6, count));
    this._follow();
  }

  _follow() {
    this.copy.scrollTop = this.lines.scrollTop = this.text.scrollTop;
    this.copy.scrollLeft = this.text.scrollLeft;
  }

  _key(event) {
    // Tab stays the key that leaves a field; Ctrl and ] indents.
    if (event.key === "]" && (event.ctrlKey || event.metaKey)) {
      event.preventDefault();
      this.text.setRangeText("    ", this.text.selectionStart, this.text.selectionEnd, "end");
      this.text.dispatchEvent(new Event("input"));
    }
  }
}
