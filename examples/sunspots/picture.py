"""Draw the Sun's signed field and the observations: `python picture.py [sunspots.png]`."""

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
YEARS = 1750, 1850
INK, FAINT, ORANGE = "#1d2430", "#6b7480", "#d95f02"
BLUES = "#ffffff", "#eaf1f8", "#cfe0f0", "#a9cae4", "#7aaed4", "#4b8fc2", "#2f75ad"
CELLS = 121


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "out" / "sunspots.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    model = zakai.load_model(HERE / "sunspots.toml")
    record = zakai.read_record(HERE / "observations.csv", model)
    result = zakai.filter(model, record, "yau-yau")
    extended = zakai.filter(model, record, "extended-kalman-bucy")
    amplitude = float(model.parameters["A"])

    # Of B = A sin(phi): the mean, and the mass in cells of the field.
    edges = np.linspace(-1.1, 1.1, CELLS + 1) * amplitude
    shade, mean = np.zeros((CELLS, len(record.times))), np.empty(len(record.times))
    fine = np.linspace(-0.5, 0.5, 41)[:-1]
    for k in range(len(record.times)):
        density = result.density(k + 1)
        phi, weights = density.points.ravel(), density.weights.ravel()
        mean[k] = amplitude * (weights @ np.sin(phi))
        # The mass of a cell of phi, spread over the cell.
        spread = amplitude * np.sin(phi[:, None] + (phi[1] - phi[0]) * fine)
        shade[:, k] = np.histogram(spread.ravel(), edges, weights=np.repeat(weights, len(fine)))[0]
    years = (record.times >= YEARS[0]) & (record.times <= YEARS[1])
    times = record.times[years]

    figure = Figure(figsize=(9, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.1, 1))
    colours = LinearSegmentedColormap.from_list("density", BLUES)
    relative = shade[:, years] / shade[:, years].max(axis=0)
    above.pcolormesh(times, 0.5 * (edges[1:] + edges[:-1]), np.sqrt(relative), cmap=colours, shading="nearest", rasterized=True)
    above.axhline(0, color=FAINT, linewidth=0.6)
    above.plot(times, mean[years], color=INK, linewidth=1.4, label="its mean")
    above.plot(times, amplitude * np.sin(extended.mean[1:, 0])[years], color=ORANGE, linewidth=1.4, linestyle=(0, (4, 1.5)),
               label="extended Kalman-Bucy")  # fmt: skip
    above.set_ylabel("field B (root of a\nsunspot number)")
    above.set_title("shade: root of the density of B, relative to its peak in each year", loc="right", fontsize=8, color=FAINT)
    above.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, borderaxespad=0.2)
    below.bar(times, record.values[years, 0] ** 2 - 10, width=0.8, color="#7f8c99")
    below.set_ylabel("sunspot number")
    below.set_xlabel("year")
    below.set_xlim(YEARS)
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, dpi=160)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
