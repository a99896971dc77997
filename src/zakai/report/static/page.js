// Builds every picture of a page that holds its frames: an element with data-zakai="density", "plane" or "chart" and data-frame="ID"
// for each, and the frame, deflated and in base64, as the text of the element ID.

import { DensityView } from "./density.js";
import { PlaneView } from "./plane.js";
import { ChartView } from "./chart.js";

const VIEWS = { density: DensityView, plane: PlaneView, chart: ChartView };

// A dark page is printed light; the panels draw themselves again at the same event, after this.
addEventListener("beforeprint", () => { document.documentElement.dataset.print = ""; });
addEventListener("afterprint", () => { delete document.documentElement.dataset.print; });

async function frame(id) {
  const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

for (const element of document.querySelectorAll("[data-zakai]")) {
  const { zakai, frame: id, height } = element.dataset;
  frame(id).then((data) => new VIEWS[zakai](element, { testid: id, ...(height ? { height: Number(height) } : {}) }).setFrame(data));
}
