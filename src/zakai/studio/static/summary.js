// What the run says of itself: on what grounds the method was taken, and its health figures in words.

import { h, number, table } from "./dom.js";

export class Summary {
  constructor(studio) {
    this.studio = studio;
    this.title = "Health";
    this.panel = h("div", { class: "panel" }, h("p", {}, "Run a filter to see how it went."));
  }

  filtered(found) {
    this.panel.replaceChildren(
      h("p", { class: "lead" }, `${found.method}: ${found.why}.`),
      found.health.length ? table(["figure", "over the record", "bound"], found.health.map(({ name, about, span, bound }) => [
        [h("strong", {}, name), h("br"), h("small", {}, about)], span.replaceAll("-", "−"), bound === null ? "–" : number(bound, 3),
      ].map((cell) => (Array.isArray(cell) ? h("div", {}, cell) : cell))), "health") : h("p", {}, "The method reports no figures: it is exact."),
    );
  }
}
