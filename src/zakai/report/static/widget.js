// The widget of a notebook, as anywidget renders it: the density over time of one state of a result, with a choice of the state.
//
// Traits: frame (all times), names, coordinate, height. Messages to Python: {wanted: [from, to]}; its answer has the frame as a
// buffer. While one answer is awaited only the last wish is kept.

import { DensityView } from "./density.js";
import { make } from "./panel.js";

export function render({ model, el }) {
  const choice = make(el, "label", { display: "block", font: "13px system-ui, sans-serif", margin: "0 0 4px" });
  choice.textContent = "State ";
  const select = make(choice, "select", {}, { "data-testid": "coordinate" });
  let awaited = false, next = null;
  const ask = ({ wanted }) => {
    if (!wanted) return;
    if (awaited) { next = wanted; return; }
    awaited = true;
    model.send({ wanted: [wanted.from, wanted.to] });
  };
  const view = new DensityView(make(el, "div"), { testid: "density", height: model.get("height"), onViewChange: ask });
  const whole = () => {
    const names = model.get("names");
    choice.hidden = names.length < 2;
    select.replaceChildren(...names.map((name) => new Option(name, name, false, name === model.get("coordinate"))));
    if (model.get("frame").byteLength) view.setFrame(model.get("frame"));
  };
  const answered = (content, buffers) => {
    awaited = false;
    if (buffers?.length && content.coordinate === model.get("coordinate")) view.setFrame(buffers[0]);
    if (next) { const wanted = next; next = null; ask({ wanted }); }
  };
  select.addEventListener("change", () => {
    model.set("coordinate", select.value);
    model.save_changes();
  });
  model.on("change:frame", whole);
  model.on("msg:custom", answered);
  whole();
  return () => {
    model.off("change:frame", whole);
    model.off("msg:custom", answered);
    view.destroy();
  };
}
