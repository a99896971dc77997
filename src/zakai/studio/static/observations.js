// Observations against what was predicted of them one step ahead, and residuals.

import { h, number, table } from "./dom.js";
import { BarPanel, LinePanel } from "./panels.js";

class Lazy {
  constructor(studio, title, what) {
    Object.assign(this, { studio, title, what, seen: null });
    this.panel = h("div", { class: "panel" }, h("p", {}, "Run a filter first."));
  }

  filtered() { this.seen = null; }

  /** Ask when the part is opened. */
  async open() {
    const { studio } = this;
    if (!studio.summary || this.seen === studio.summary || studio.running) return;
    this.seen = studio.summary;
    const now = "Computing the laws of the observations …", line = h("p", { class: "small" }, now);
    this.panel.replaceChildren(line);
    try {
      const found = await studio.ask(this.what, { name: "main" }, { quiet: true, work: true, progress: (done, total) => studio.progressed(done, total),
        said: (text) => { line.textContent = `${now} ${text}`; } });
      if (found) this.draw(found); else this.seen = null;
    } catch (error) {
      this.panel.replaceChildren(h("p", { class: error.cancelled ? "small" : "fault" }, error.cancelled ? "Cancelled; press Run to compute again." : error.message));
      if (error.cancelled) studio.say("Cancelled.");
    }
  }
}

const left = (count) => (count ? h("p", { class: "small" }, `The last rows of the record; the ${count.toLocaleString("en")} before them are left out.`) : "");
const part = (array, j, m) => Float32Array.from({ length: array.length / m }, (_, k) => array[k * m + j]);

export class Observations extends Lazy {
  constructor(studio) { super(studio, "Observations", "predicted"); }

  draw({ arrays, names, outside, before, rates, clock }) {
    const m = names.length;
    this.panel.replaceChildren(
      h("p", { class: "lead" }, `${outside === null ? "–" : `${number(100 * outside, 2)}%`} of the observations lie outside of the 95% band that was predicted from those before them; 5% would if the model is true.`),
      rates ? h("p", { class: "small" }, "Increments are shown over the length of their interval.") : "", left(before));
    names.slice(0, 6).forEach((name, j) => {
      const place = h("div", {});
      this.panel.append(h("h3", {}, name), place);
      const x = arrays.times;
      new LinePanel(place, { label: `Observation ${name} and its prediction`, height: 260, testid: `observed-${name}` }).show({ x: { clock }, y: { title: name }, series: [
        { role: "band", text: "95% predicted", x, lower: part(arrays.lower, j, m), upper: part(arrays.upper, j, m), colour: "series" },
        { role: "mean", text: "predicted mean", x, y: part(arrays.mean, j, m), colour: "ink" },
        { role: "seen", text: "observed", x, y: part(arrays.values, j, m), dots: true, colour: "truth" },
      ] });
    });
  }
}

export class Residuals extends Lazy {
  constructor(studio) { super(studio, "Residuals", "residuals"); }

  draw({ observations, arrays, before, notes, clock }) {
    this.panel.replaceChildren(h("p", { class: "lead" }, "If the model is true, the histogram is flat, the normal scores look like standard normal numbers, and nothing is correlated."),
      h("p", { class: "small" }, "A U shape: noise that is too small. A hump: too large. A slope: a bias. Correlation: wrong dynamics, unless outliers make it."), left(before),
      notes?.length ? h("ul", { class: "notes" }, notes.map((one) => h("li", {}, one))) : "");
    observations.slice(0, 6).forEach((one, j) => {
      const histogram = h("div", {}), scores = h("div", {}), lags = h("div", {});
      this.panel.append(h("h3", {}, one.name), h("div", { class: "pair" }, h("figure", {}, histogram, h("figcaption", {}, "probability integral transforms")), h("figure", {}, lags, h("figcaption", {}, "autocorrelation of the normal scores"))),
        h("figure", {}, scores, h("figcaption", {}, "normal scores over time")),
        table(["test", "p-value", "reading"], one.verdicts.map(([name, p, said]) => [name, p, said])));
      new BarPanel(histogram, { label: `Histogram of ${one.name}`, height: 190, compact: true, testid: `pit-${one.name}` }).show({ heights: one.heights, band: one.band, level: 1, x: { title: "probability" }, y: { title: "density" } });
      const count = one.autocorrelation.length, bound = 1.96 / Math.sqrt(one.count), most = Math.max(0.3, ...one.autocorrelation.map(Math.abs));
      new BarPanel(lags, { label: "Autocorrelation", height: 190, compact: true }).show({ heights: one.autocorrelation, low: 0.5, high: count + 0.5, band: [-bound, bound], level: 0, x: { title: "lag" }, y: { title: "correlation" }, range: [-1.1 * most, 1.1 * most] });
      new LinePanel(scores, { label: "Normal scores over time", height: 180 }).show({ x: { clock }, y: { title: "deviations" }, series: [{ role: "scores", text: "normal score", x: arrays[`times${j}`], y: arrays[`scores${j}`], dots: true }], marks: [{ y: -1.96 }, { y: 1.96 }, { y: 0, dash: [] }] });
    });
  }
}
