// A stream: a file that grows, or standard input; filtered as it arrives.

import { counted, h, number } from "./dom.js";

export class Stream {
  constructor(studio) {
    this.studio = studio;
    this.title = "Stream";
    this.button = h("button", { type: "button", class: "primary", "data-testid": "follow", onclick: () => this.toggle() }, "Follow");
    this.source = h("p", { class: "lead" });
    this.said = h("p", { "data-testid": "stream-said", role: "status" });
    this.estimate = h("dl", { class: "facts" });
    this.faults = h("ul", { class: "notes", hidden: true });
    this.panel = h("div", { class: "panel" }, this.source, h("div", { class: "row" }, this.button), this.said, this.estimate, this.faults);
    this.on = false;
  }

  offered(name) {
    this.button.disabled = !name;
    this.source.textContent = name ? `Filter ${name} as it arrives, one line after the other; the picture above shows the last estimates.`
      : "There is no stream. Start the studio with one: zakai studio MODEL RECORD.csv follows a file that grows, zakai studio MODEL - standard input.";
  }

  toggle() {
    this.on = !this.on;
    this.button.textContent = this.on ? "Stop" : "Follow";
    const { studio } = this, { text, method, options } = studio.state;
    if (!this.on) { studio.link.tell("unfollow"); studio.say("The stream is no longer followed."); return; }
    this.drawn = 0;
    this.said.textContent = "Waiting for lines …";
    studio.link.tell("follow", { text, method, options });
  }

  async arrived(header) {
    const { studio } = this;
    if (header.error) {
      if (!header.cancelled) { this.said.textContent = header.error; studio.say(header.error, true); }
      if (this.on) this.toggle();
      return;
    }
    if (header.do === "stream-begin") return;
    this.faults.hidden = !header.faults.length;
    this.faults.replaceChildren(...header.faults.map((one) => h("li", {}, one)));
    if (header.time === null) return;
    this.said.textContent = `t = ${number(header.time, 8)}`;
    if (this.on) studio.say(`Following: ${counted(header.count, "observation")} filtered.`);
    this.estimate.replaceChildren(...header.states.map((name, i) => h("div", {}, h("dt", {}, name), h("dd", {}, `${number(header.mean[i], 4)}`, h("small", {}, ` ${header.interval[i].map((end) => number(end, 3)).join(" to ")}`)))),
      h("div", {}, h("dt", {}, "log-likelihood"), h("dd", {}, number(header.log_likelihood, 6))));
    const now = performance.now();
    if (now - this.drawn < 250 || this.drawing) return; // four pictures a second
    this.drawing = true;
    this.drawn = now;
    await studio.result.show("stream", { states: header.states, verdict: "", log_likelihood: header.log_likelihood, method: header.method, observations: header.count, warnings: header.warnings, first: header.first, last: header.time });
    this.drawing = false;
  }
}
