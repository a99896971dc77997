"""What `plot` draws: a result over time, a density, the structure of a model, each in one Matplotlib Axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.densities import Density
from zakai.errors import InputError
from zakai.report import _style as style
from zakai.report._extra import plotting
from zakai.report.heatmap import DensityOverTime, circle_line, density_over_time, direct_observations, state_names, true_states

_WIDE, _SQUARE = (8.0, 3.6), (4.6, 4.2)
_POINTS, _ACROSS = 801, 161  # of a curve, and along each axis of a map
_TAIL = 5e-4  # probability beyond either end of an axis
_REGIONS = (0.5, 0.95)  # probabilities of the regions of highest density
_MOST_DOTS = 4000


def axes_or_new(ax: Any, size: tuple[float, float]) -> Any:
    """Return the Axes that were given, or those of a new pyplot figure."""
    if ax is not None:
        if not hasattr(ax, "pcolormesh"):
            raise InputError(f"plot: ax is a {type(ax).__name__}; give a Matplotlib Axes, or leave it out")
        return ax
    return plotting("matplotlib.pyplot").subplots(figsize=size, layout="constrained")[1]


def plot_result(result: Any, state: int | str, truth: Any, start: int | None, stop: int | None, ax: Any) -> Any:
    """Return the Axes with the posterior of one state over time; see `FilterResult.plot`."""
    plotting("matplotlib.colors")
    number = state_number(result, state)
    picture = density_over_time(result, number, true_states(truth, result), start or 0, stop)
    axes = axes_or_new(ax, _WIDE)
    draw_posterior(axes, picture, result, number)
    return axes


def draw_posterior(axes: Any, picture: DensityOverTime, result: Any, number: int) -> None:
    """Draw a heat map of the density, the mean, the 95% band, observations of this state itself, and the truth if known."""
    colours, clock = plotting("matplotlib.colors"), getattr(result, "clock", None)
    when = (lambda times: times) if clock is None else clock.days
    shades = colours.LinearSegmentedColormap.from_list("density", style.DENSITY_COLOURS)
    axes.pcolormesh(
        when(picture.times), picture.grid, picture.relative, cmap=shades, vmin=0, vmax=1, shading="nearest", rasterized=True
    )

    def line(values: np.ndarray, **kind: Any) -> None:
        if not picture.joined:
            axes.plot(when(picture.times), values, **{**kind, "linestyle": "none", "marker": ".", "markersize": 2.5})
            return
        times, values = circle_line(picture.times, values) if picture.periodic else (picture.times, values)
        axes.plot(when(times), values, **kind)

    if picture.joined:
        line(picture.lower, color=style.BAND_COLOUR, linewidth=0.6, label="95% band" if picture.kept else "95% band (Gaussian)")
        line(picture.upper, color=style.BAND_COLOUR, linewidth=0.6)
    line(picture.mean, color=style.INK, linewidth=1.1, label="mean")
    filtered = getattr(result, "filtered", None)
    if filtered is not None:
        line(filtered.mean[picture.index, number], color=style.FAINT, linewidth=0.8, linestyle=":", label="filtered mean")
    observed = direct_observations(result, number, float(picture.times[0]), float(picture.times[-1]))
    if observed is not None and len(observed[0]) <= _MOST_DOTS:
        axes.plot(when(observed[0]), observed[1], ".", color=style.FAINT, markersize=3, label="observations")
    if picture.truth is not None:
        line(picture.truth, color=style.TRUTH_COLOUR, linewidth=1.1, linestyle=(0, (3, 1.5)), label="truth")
    axes.set_ylim(picture.edges[0], picture.edges[-1])
    axes.set_xlim(when(picture.times[0]), when(picture.times[-1]) if len(picture.times) > 1 else None)
    if picture.periodic:
        angle_axis(axes.yaxis, picture.edges)
    if clock is not None:
        axes.xaxis_date()
        axes.xaxis.set_major_formatter(plotting("matplotlib.dates").ConciseDateFormatter(axes.xaxis.get_major_locator()))
    axes.set_xlabel("time" if clock is None else "date")
    axes.set_ylabel(plain(picture.name) + (" (radians)" if picture.periodic else ""))
    shade = [plotting("matplotlib.patches").Patch(color=style.DENSITY_COLOURS[3], label="density / its peak")]
    _legend_below(axes, shade if picture.kept else [])
    axes.spines[["top", "right"]].set_visible(False)


def _legend_below(axes: Any, handles: list[Any]) -> None:
    """Draw the legend below the label of the x-axis, so that a title has its place."""
    below = plotting("matplotlib.transforms").ScaledTranslation(0, -36 / 72, axes.figure.dpi_scale_trans)
    width = axes.get_position().width * axes.figure.get_size_inches()[0]
    axes.legend(
        handles=[*handles, *axes.get_legend_handles_labels()[0]], loc="upper left", bbox_to_anchor=(0, 0),
        bbox_transform=axes.transAxes + below, ncols=6 if width > 6 else 3, frameon=False, borderaxespad=0.0, handlelength=1.4,
        columnspacing=1.2, fontsize=8,
    )  # fmt: skip


def draw_density(density: Density, ax: Any) -> Any:
    """Return the Axes with the density of one coordinate, or the joint density of two."""
    plotting("matplotlib.colors")
    if len(density.names) > 2:
        listed = ", ".join(density.names[:8])
        raise InputError(
            f'plot: {len(density.names)} states; name one or two of {listed}, as in density.plot(["{density.names[0]}"])'
        )
    if len(density.names) == 1:
        return _curve(density, axes_or_new(ax, _WIDE))
    return _regions(density, axes_or_new(ax, _SQUARE))


def _curve(density: Density, axes: Any) -> Any:
    x = axis_of(density, 0, _POINTS)
    values, (low, high) = density.pdf(x[:, None]), density.quantile([0.025, 0.975])[:, 0]
    axes.plot(x, values, color=style.SERIES_COLOUR, linewidth=1.5)
    axes.fill_between(x, values, color=style.DENSITY_COLOURS[1], linewidth=0)
    # A band of an angle may go through +-pi, where `low` exceeds -pi or `high` exceeds pi.
    inside = (x >= low) & (x <= high)
    if density.periodic[0]:
        inside |= (x - 2 * np.pi >= low) | (x + 2 * np.pi <= high)
    axes.fill_between(x, values, where=inside, color=style.DENSITY_COLOURS[3], linewidth=0, label="95% interval")
    axes.axvline(density.mean()[0], color=style.INK, linewidth=1.1, label="mean")
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(x[0], x[-1])
    if density.periodic[0]:
        angle_axis(axes.xaxis, x)
    axes.set_xlabel(plain(density.names[0]) + (" (radians)" if density.periodic[0] else ""))
    axes.set_ylabel("density")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _regions(density: Density, axes: Any) -> Any:
    x, y, values, levels = joint_map(density)
    shades = plotting("matplotlib.colors").LinearSegmentedColormap.from_list("density", style.DENSITY_COLOURS)
    axes.pcolormesh(x, y, values, cmap=shades, vmin=0, shading="nearest", rasterized=True)
    if levels[0] < levels[-1] and levels[-1] < values.max():
        drawn = axes.contour(x, y, values, levels=levels, colors=style.BAND_COLOUR, linewidths=0.9)
        names = {level: f"{region:.0%}" for level, region in zip(levels, _REGIONS[::-1], strict=True)}
        axes.clabel(drawn, fmt=names, fontsize=8)
    mean = density.mean()
    axes.plot(mean[0], mean[1], "+", color=style.INK, markersize=9, label="mean")
    for i, (axis, points, name) in enumerate(zip((axes.xaxis, axes.yaxis), (x, y), density.names, strict=True)):
        axis.set_label_text(plain(name))
        if density.periodic[i]:
            angle_axis(axis, points)
    axes.set_title("regions of highest density", loc="right", fontsize=8, color=style.FAINT)
    return axes


def joint_map(density: Density) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return both axes (a,), (b,), the density (b, a) and the levels that bound the regions of highest density, rising."""
    x, y = axis_of(density, 0, _ACROSS), axis_of(density, 1, _ACROSS)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    values = np.nan_to_num(density.pdf(points))
    order = np.sort(values.ravel())[::-1]
    mass = np.cumsum(order) / max(order.sum(), np.finfo(float).tiny)
    levels = np.array([order[min(int(np.searchsorted(mass, region)), len(order) - 1)] for region in _REGIONS[::-1]])
    return x, y, values, levels


def axis_of(density: Density, coordinate: int, count: int) -> np.ndarray:
    """Return points of one coordinate that hold nearly all of its mass: the circle for an angle that is spread."""
    low, high = density.quantile([_TAIL, 1 - _TAIL])[:, coordinate]
    margin = 0.08 * (high - low)
    low, high = low - margin, high + margin
    if density.periodic[coordinate] and not (-np.pi <= low and high <= np.pi and high - low < np.pi):
        low, high = -np.pi, np.pi
    return np.linspace(low, high, count)


def draw_structure(analysis: Any, ax: Any) -> Any:
    """Return the Axes with a table of which state enters which equation, linearly or not."""
    import sympy as sp

    plotting("matplotlib.colors")
    model = analysis.model
    rows = [*model.drift, *model.observation]
    table = np.zeros((len(rows), model.n))
    for i, formula in enumerate(rows):
        free = formula.free_symbols
        for j, symbol in enumerate(model.x):
            if symbol in free:
                derivative = sp.diff(formula, symbol)
                table[i, j] = 2.0 if derivative.free_symbols & set(model.x) else 1.0
    axes = axes_or_new(ax, (min(9.0, 4.4 + 0.4 * model.n), min(9.0, 1.8 + 0.38 * len(rows))))
    colours = plotting("matplotlib.colors").ListedColormap(["#ffffff", style.DENSITY_COLOURS[3], style.SERIES_COLOUR])
    axes.imshow(table, cmap=colours, vmin=0, vmax=2, aspect="auto", interpolation="nearest")
    axes.axhline(model.n - 0.5, color=style.INK, linewidth=0.8)
    names = [f"d{name}/dt" for name in model.state] + ["h" if model.m == 1 else f"h{j + 1}" for j in range(model.m)]
    if max(len(rows), model.n) <= 40:
        axes.set_xticks(range(model.n), [plain(name) for name in model.state])
        axes.set_yticks(range(len(rows)), [plain(name) for name in names])
    axes.set_xlabel("state")
    handles = [
        plotting("matplotlib.patches").Patch(color=colours(k), label=label) for k, label in ((1, "linear"), (2, "nonlinear"))
    ]
    axes.legend(handles=handles, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, borderaxespad=0.2, fontsize=9)
    axes.set_title(f"method: {analysis.recommended or 'none'}", loc="right", fontsize=8, color=style.FAINT)
    return axes


def angle_axis(axis: Any, points: np.ndarray) -> None:
    """Mark the multiples of pi / 2 where the whole circle is drawn."""
    if points[-1] - points[0] < 6.28:
        return
    axis.set_ticks(np.pi * np.array([-1, -0.5, 0, 0.5, 1]), ["−π", "−π/2", "0", "π/2", "π"])


def state_number(result: Any, state: int | str) -> int:
    """Return the number of a state that is given by name or number; InputError for an unknown one."""
    names = state_names(result)
    if isinstance(state, str):
        if state not in names:
            raise InputError(f"state '{state}' is not in the model; its states are {', '.join(names)}")
        return names.index(state)
    if not 0 <= state < len(names):
        raise InputError(f"state {state} is not in the model; numbers run from 0 to {len(names) - 1}")
    return int(state)


def plain(text: str) -> str:
    """Return text that Matplotlib does not read as a formula."""
    return text.replace("$", r"\$")
