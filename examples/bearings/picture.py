"""Track a ship by its bearing alone, and draw where it is: `python picture.py [bearings.png]`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

import zakai
from zakai.report import save_figure

HERE = Path(__file__).parent
INK, ORANGE, GREY = "#1a1a1a", "#d95f02", "#888888"
SHOWN = (3, 26, 45, 59)  # observations after which the density is drawn
COLOURS = ((0.04, 0.33, 0.62), (0.0, 0.47, 0.37), (0.48, 0.2, 0.58), (0.65, 0.3, 0.0))


def track() -> tuple[Any, Any, Any]:
    """Return the model, a true track, and sixty bearings at irregular times."""
    model = zakai.load_model(HERE / "bearings.toml")
    times = np.cumsum(np.random.default_rng(3).gamma(4, 0.1, 60)).round(2)
    truth, record = zakai.simulate(model, times, seed=2, initial=[10.0, 8.0, -0.35, -0.02])
    return model, truth, record


def draw_map(axes: Any, result: Any, truth: Any, record: Any, shown: Sequence[int]) -> None:
    """Draw the joint density of the two coordinates of the position after some observations."""
    x, y = np.meshgrid(np.linspace(-1, 16, 256), np.linspace(-3, 14, 256))
    places = np.column_stack([x.ravel(), y.ravel()])
    for k, colour in zip(shown, COLOURS, strict=False):
        shade = LinearSegmentedColormap.from_list("density", [(*colour, alpha) for alpha in (0.0, 0.35, 0.65, 0.95)])
        density = np.exp(result.density(k).marginal(["px", "py"]).log_density(places)).reshape(x.shape)
        axes.pcolormesh(x, y, density / density.max(), cmap=shade, vmin=0, vmax=1, shading="auto", rasterized=True)
        ship = truth.values[k, :2]
        axes.plot(*ship, "o", color=ORANGE, markersize=4, zorder=4)
        axes.annotate(f"t = {result.times[k]:.0f}", ship, (3, 8), textcoords="offset points", fontsize=8, color=INK)
        boat = np.array([0.3 * result.times[k], 2 * np.sin(0.25 * result.times[k])])
        angle = record.values[k - 1, 0]
        seen = np.stack([boat, boat + 20 * np.array([np.cos(angle), np.sin(angle)])])
        axes.plot(*seen.T, color=GREY, linewidth=0.6, zorder=1)
        axes.plot(*boat, "^", color=INK, markersize=4)
    t = np.linspace(0, result.times[-1], 200)
    axes.plot(0.3 * t, 2 * np.sin(0.25 * t), color=INK, linewidth=1, label="boat that takes the bearings")
    axes.plot(truth.values[:, 0], truth.values[:, 1], color=ORANGE, linewidth=1.2, linestyle="--", label="true track of the ship")
    axes.set(xlim=(-1, 15.5), ylim=(-3, 13.5), aspect="equal", xlabel="east, km", ylabel="north, km")
    axes.legend(loc="upper left", frameon=False, fontsize=8)


def draw(result: Any, truth: Any, record: Any, shown: Sequence[int] = SHOWN) -> Figure:
    """Draw the map, and the density of one coordinate over time."""
    figure = Figure(figsize=(9, 4.3), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.25])
    draw_map(left, result, truth, record, shown)
    result.plot("px", truth=truth, ax=right)
    right.set(xlabel="time, minutes", ylabel="east, km", ylim=(0, 15))
    handles, labels = right.get_legend_handles_labels()
    right.get_legend().remove()
    right.legend(handles, labels, loc="upper right", frameon=False, fontsize=8)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    return figure


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "out" / "bearings.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    model, truth, record = track()
    result = zakai.filter(model, record, method="tensor-train")
    save_figure(draw(result, truth, record), path, dpi=150)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
