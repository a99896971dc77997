"""Draw where the cyclist may be, and where the cyclist is: `python picture.py [cycling.png]`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

import zakai
from zakai.report import save_figure

HERE = Path(__file__).parent
LAP = 20.231  # kilometres
TIMES = 12, 30, 32, 36  # observations whose densities are drawn
FAINT, ORANGE, BLUE = "#6b7480", "#d95f02", "#2f75ad"
BLUES = "#ffffff", "#eaf1f8", "#cfe0f0", "#a9cae4", "#7aaed4", "#4b8fc2", "#2f75ad"


def kilometres(phi: np.ndarray) -> np.ndarray:
    return (phi + np.pi) * LAP / (2 * np.pi)


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "out" / "cycling.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    model = zakai.load_model(HERE / "cycling.toml")
    record = zakai.read_record(HERE / "observations.csv", model)
    truth = kilometres(np.loadtxt(HERE / "truth.csv", delimiter=",", skiprows=1)[:, 1])
    table = model.tables["altitude"]
    result = zakai.filter(model, record)
    edges = np.linspace(-np.pi, np.pi, 513)
    places = kilometres(0.5 * (edges[1:] + edges[:-1]))
    shade = np.empty((len(places), len(record.times)))
    for k in range(len(record.times)):
        density = result.density(k + 1).marginal(["phi"])
        phi = density.points.ravel()
        fine = phi[:, None] + (phi[1] - phi[0]) * (np.arange(16) / 16 - 15 / 32)
        wrapped = np.pi - np.mod(np.pi - fine, 2 * np.pi)
        shade[:, k] = np.histogram(wrapped, edges, weights=np.repeat(density.weights.ravel()[:, None] / 16, 16, axis=1))[0]
    minutes = record.times / 60

    figure = Figure(figsize=(9, 7.2), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 5, height_ratios=(1.25, 1))
    above, side = figure.add_subplot(grid[0, :4]), figure.add_subplot(grid[0, 4])
    colours = LinearSegmentedColormap.from_list("density", BLUES)
    above.pcolormesh(minutes, places, np.sqrt(shade / shade.max(axis=0)), cmap=colours, shading="nearest", rasterized=True)
    above.plot(minutes, truth, color=ORANGE, linewidth=1.4, linestyle=(0, (4, 1.5)), label="true position (GPS)")
    above.set(xlabel="minutes", ylabel="kilometres along the loop", ylim=(0, LAP))
    above.legend(loc="upper left", frameon=False)
    above.set_title("shade: root of the density, relative to its peak at each time", loc="right", fontsize=8, color=FAINT)
    side.plot(table(np.linspace(-np.pi, np.pi, 513)), np.linspace(0, LAP, 513), color=FAINT, linewidth=1.2)
    side.set(xlabel="altitude (m)", ylim=(0, LAP))
    side.tick_params(labelleft=False)
    last = None
    for panel, k in enumerate(TIMES):
        axes = figure.add_subplot(grid[1, panel], sharex=last)
        axes.fill_between(places, shade[:, k] / (places[1] - places[0]), color=BLUE, linewidth=0)
        axes.axvline(truth[k], color=ORANGE, linestyle=(0, (4, 1.5)), linewidth=1.4)
        axes.set_title(f"{minutes[k]:.0f} min", fontsize=9)
        axes.set(xlabel="kilometres", xlim=(0, LAP), ylim=(0, None))
        if panel == 0:
            axes.set_ylabel("density (1/km)")
        axes.spines[["top", "right"]].set_visible(False)
        last = axes
    for axes in (above, side):
        axes.spines[["top", "right"]].set_visible(False)
    height = figure.add_subplot(grid[1, 4])
    height.plot(minutes, record.values[:, 0], ".", color=FAINT, markersize=3)
    height.set(xlabel="minutes", ylabel="observed altitude (m)")
    height.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, dpi=160)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
