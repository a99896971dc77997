// The model as a form: a change becomes a change of the text, which stays what counts.

import { field, h } from "./dom.js";

const KINDS = { samples: "samples: z = h + noise at each time", increments: "increments of y over each interval", path: "the path y itself", rates: "increments over their interval" };

export class Form {
  /** `onchange(changes)` receives keys of the model file with new values (texts), or null to remove a key. */
  constructor(parent, onchange) {
    this.parent = parent;
    this.onchange = onchange;
    this.shown = "";
  }

  /** Show the keys of a model file, all numbers as texts; a form that the reader writes in stays. */
  show(keys) {
    if (!keys || this.parent.contains(document.activeElement)) return;
    const said = JSON.stringify(keys);
    if (said === this.shown) return;
    this.shown = said;
    this.keys = keys;
    const list = (key) => (Array.isArray(keys[key]) ? keys[key] : []);
    const state = list("state"), drift = list("drift"), observation = list("observation");
    this.parent.replaceChildren(
      field("Name", this._text(keys.name ?? "", (value) => this.onchange({ name: value }))),
      h("fieldset", {}, h("legend", {}, "State"),
        h("div", { class: "grid three" }, h("small", {}, "name"), h("small", {}, "drift f"), h("small", {}, "diffusion g, by columns"), h("span", {})),
        state.map((name, i) => h("div", { class: "grid three" },
          this._text(name, (value) => this.onchange({ state: replaced(state, i, value) }), `state ${i + 1}`, ["state", i]),
          this._text(drift[i] ?? "", (value) => this.onchange({ drift: replaced(drift, i, value) }), `drift of ${name}`, ["drift", i]),
          this._text(row(keys.diffusion, i, state.length), (value) => this.onchange({ diffusion: withRow(keys.diffusion, i, value, state.length) }), `diffusion of ${name}`, ["diffusion", i]),
          this._remove(`state ${name}`, state.length > 1, () => this.onchange({
            state: without(state, i), drift: without(drift, i), diffusion: Array.isArray(keys.diffusion) ? without(keys.diffusion, i) : undefined, prior: this._prior(i, true),
          })))),
        h("button", { type: "button", class: "quiet", onclick: () => {
          const name = unused(state, "x");
          this.onchange({ state: [...state, name], drift: [...drift, "0"], diffusion: wider(keys.diffusion, state.length), prior: this._prior(state.length, false) });
        } }, "+ state")),
      h("fieldset", {}, h("legend", {}, "Observation"),
        observation.map((formula, j) => h("div", { class: "grid two" },
          this._text(formula, (value) => this.onchange({ observation: replaced(observation, j, value) }), `observation ${j + 1}`, ["observation", j]),
          this._text(row(keys.observation_noise, j, observation.length), (value) => this.onchange({ observation_noise: withRow(keys.observation_noise, j, value, observation.length) }), `noise of observation ${j + 1}`, ["observation_noise", j]),
          this._remove(`observation ${j + 1}`, observation.length > 1, () => this.onchange({ observation: without(observation, j), observation_noise: null })))),
        h("small", {}, "formula h · row of the noise covariance S"),
        h("button", { type: "button", class: "quiet", onclick: () => this.onchange({ observation: [...observation, state[0] ?? "x"], observation_noise: null }) }, "+ observation"),
        field("The record holds", this._select(KINDS, keys.observation_kind, (value) => this.onchange({ observation_kind: value })))),
      h("fieldset", {}, h("legend", {}, "Parameters"),
        Object.entries(keys.parameters ?? {}).map(([name, value]) => h("div", { class: "grid two" },
          this._text(name, (now) => this.onchange({ parameters: renamed(keys.parameters, name, now) }), `name of ${name}`),
          this._text(value, (now) => this.onchange({ parameters: { ...keys.parameters, [name]: now } }), `value of ${name}`, ["parameters", name]),
          this._remove(`parameter ${name}`, true, () => this.onchange({ parameters: dropped(keys.parameters, name) })))),
        h("button", { type: "button", class: "quiet", onclick: () => this.onchange({ parameters: { ...keys.parameters, [unused(Object.keys(keys.parameters ?? {}), "a")]: "1.0" } }) }, "+ parameter")),
      h("fieldset", {}, h("legend", {}, "Prior at the start"),
        (keys.prior?.kind ?? "gaussian") === "gaussian" ? [
          field("Mean", this._text(flat(keys.prior?.mean), (value) => this.onchange({ prior: { kind: "gaussian", mean: parts(value), cov: keys.prior?.cov ?? parts(value).map(() => "1") } }), "mean of the prior", ["prior"])),
          field("Variances", this._text(flat(diagonal(keys.prior?.cov)), (value) => this.onchange({ prior: { kind: "gaussian", mean: keys.prior?.mean ?? parts(value).map(() => "0"), cov: parts(value) } }), "variances of the prior", ["prior"]), "one for each state; covariances are written in the text"),
        ] : h("small", {}, `kind ${keys.prior.kind}: see the text`)),
    );
  }

  /** Mark the field of an error. */
  mark(place) {
    for (const input of this.parent.querySelectorAll("[data-place]")) {
      const [key, index] = JSON.parse(input.dataset.place);
      const wrong = place?.key?.[0] === key && (index === undefined || index === place.entry?.[0] || index === place.key[1]);
      input.setAttribute("aria-invalid", String(Boolean(wrong)));
    }
  }

  _prior(i, remove) {
    const { prior } = this.keys;
    if (prior?.kind !== "gaussian" || !Array.isArray(prior.mean)) return undefined;
    const variances = diagonal(prior.cov);
    return { kind: "gaussian", mean: remove ? without(prior.mean, i) : [...prior.mean, "0"], cov: remove ? without(variances, i) : [...variances, "1"] };
  }

  _text(value, change, label, place) {
    return h("input", { type: "text", value: String(value), spellcheck: false, "aria-label": label, "data-place": place ? JSON.stringify(place) : undefined,
      onchange: ({ target }) => { target.blur(); this.shown = ""; change(target.value); } });
  }

  _select(options, chosen, change) {
    return h("select", { "aria-label": "kind of observation", onchange: ({ target }) => { target.blur(); change(target.value); } },
      chosen ? null : h("option", { value: "", selected: true }, "choose …"),
      Object.entries(options).map(([value, text]) => h("option", { value, selected: value === chosen }, text)));
  }

  _remove(what, may, call) {
    return h("button", { type: "button", class: "quiet remove", disabled: !may, "aria-label": `Remove ${what}`, title: `Remove ${what}`,
      onclick: ({ currentTarget }) => { currentTarget.blur(); call(); } }, "×");
  }
}

const replaced = (list, i, value) => list.map((old, k) => (k === i ? value : old));
const without = (list, i) => list.filter((_, k) => k !== i);
const parts = (text) => text.split(/[,;]/).map((part) => part.trim()).filter(Boolean);
const flat = (list) => (Array.isArray(list) ? list.join(", ") : "");
const diagonal = (cov) => (Array.isArray(cov) ? cov.map((row, i) => (Array.isArray(row) ? row[i] : row)) : []);
const identity = (size) => Array.from({ length: size }, (_, i) => Array.from({ length: size }, (_, j) => (i === j ? "1" : "0")));
const row = (matrix, i, size) => (Array.isArray(matrix) ? matrix[i] ?? [] : identity(size)[i]).join(", ");
const withRow = (matrix, i, value, size) => replaced(Array.isArray(matrix) ? matrix : identity(size), i, parts(value));
const wider = (matrix, size) => Array.isArray(matrix) ? [...matrix.map((r) => [...r, "0"]), [...matrix[0].map(() => "0"), "1"]] : undefined;
const renamed = (values, old, now) => Object.fromEntries(Object.entries(values).map(([name, value]) => [name === old ? now : name, value]));
const dropped = (values, name) => { const rest = Object.fromEntries(Object.entries(values).filter(([key]) => key !== name)); return Object.keys(rest).length ? rest : null; };
function unused(names, letter) {
  if (!names.includes(letter)) return letter;
  for (let k = 2; ; k++) if (!names.includes(`${letter}${k}`)) return `${letter}${k}`;
}
