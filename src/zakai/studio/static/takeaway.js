// What the reader takes away: files that hold or compute the same without the studio, and an address that restores the page.

import { byId, h, save } from "./dom.js";

const FILES = [
  ["filter.py", "Python script", "computes the same numbers, with zakai alone", "export-script", "text/x-python"],
  ["model.toml", "Model file", "the text on this page", "export-model", "text/plain"],
  ["record.csv", "Record", "what was filtered, as CSV", "export-record", "text/csv"],
  ["result.nc", "Result, NetCDF", "moments, quantiles, health: zakai.load_result reads it, and xarray", "export-result", "application/x-netcdf"],
  ["result.csv", "Result, CSV", "moments and quantiles", "export-csv", "text/csv"],
  ["report.html", "Report", "one page with all pictures, which needs no network", "export-report", "text/html"],
];

export class Takeaway {
  constructor(studio) {
    this.studio = studio;
    this.title = "Export";
    this.lines = h("pre", { "data-testid": "shell", tabIndex: 0 });
    this.panel = h("div", { class: "panel" },
      h("ul", { class: "files" }, FILES.map(([what, name, about, testid, type]) => h("li", {},
        h("button", { type: "button", "data-testid": testid, onclick: () => this.take(what, type) }, name), h("small", {}, about)))),
      h("h3", {}, "In a shell"), this.lines,
      h("h3", {}, "This page again"), h("p", {}, "The address of this page holds the model, how its record is simulated or which file it is, and the method. After the studio was started again, put what follows # behind the new address."),
      h("button", { type: "button", "data-testid": "copy-address", onclick: () => this.copy() }, "Copy the address"));
  }

  async take(what, type) {
    const { studio } = this;
    studio.say(`Writing ${what} …`);
    const found = await studio.ask("export", { ...studio.request, what, name: "main" }, { work: true });
    if (!found) return;
    save(what, found.arrays.bytes, type);
    studio.say(`${what} is in your downloads.`);
  }

  async open() {
    const found = this.studio.model && (await this.studio.ask("shell", this.studio.request));
    if (found) this.lines.textContent = found.text;
  }

  async copy() {
    await this.studio._remember();
    await navigator.clipboard?.writeText(location.href).then(() => this.studio.say("The address is in the clipboard."), () => this.studio.say("Copy the address from the bar of the browser.", true));
    byId("status").focus?.();
  }
}
