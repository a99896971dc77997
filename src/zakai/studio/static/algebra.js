// The estimation algebra: finite dimensional or not, with the certificate.

import { h } from "./dom.js";

const SAID = {
  finite: "The estimation algebra is finite dimensional: an exact filter of finitely many equations exists.",
  infinite: "The estimation algebra is infinite dimensional: no exact filter of finitely many equations comes from it.",
  undecided: "Whether the estimation algebra is finite dimensional was not decided.",
};

export class Algebra {
  constructor(studio) {
    this.studio = studio;
    this.title = "Algebra";
    this.panel = h("div", { class: "panel", "data-testid": "algebra" }, h("p", {}, "…"));
  }

  modelled() { this.seen = null; }

  async open() {
    const { studio } = this, { text } = studio.state;
    if (!studio.model || this.seen === text) return;
    this.seen = text;
    this.panel.replaceChildren(h("p", { class: "small" }, "Computing brackets …"));
    try {
      const found = await studio.ask("algebra", { text }, { quiet: true });
      if (!found) { this.seen = null; return; }
      const facts = [["verdict", found.verdict], ["dimension", found.dimension ?? "–"], ["linear rank", found.rank ?? "–"]];
      this.panel.replaceChildren(h("p", { class: "lead", "data-testid": "verdict" }, found.verdict === "undecided" && found.note ? `Not decided: ${found.note}.` : SAID[found.verdict] ?? found.verdict),
        h("dl", { class: "facts" }, facts.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, String(value))))),
        found.basis.length ? h("p", {}, "Basis: ", h("code", {}, found.basis.join(",  "))) : "",
        ...(found.certificate ? [h("h3", {}, "Certificate"), h("p", {}, found.certificate)] : []), found.note && found.verdict !== "undecided" ? h("p", { class: "small" }, found.note) : "",
        found.parameters ? h("p", { class: "small" }, `For ${found.parameters}.`) : "",
        h("details", {}, h("summary", {}, "The whole analysis"), h("pre", {}, found.page)));
    } catch (error) {
      this.panel.replaceChildren(h("p", { class: "fault" }, error.message));
    }
  }
}
