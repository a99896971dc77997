"""Figures 1 to 3: the estimates for one P0, averaged over the paths."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.studies._drawing import new_figure, plain

if TYPE_CHECKING:
    from zakai.studies.chen_luo_yau_2017 import Study

_LINES = {
    "grid-optimal": ("grid-optimal", {"color": "#7aaed4", "linewidth": 4.0}),
    "direct": ("direct method", {"color": "#1d2430", "linewidth": 1.1}),
    "ekf-stable": ("EKF, stable Riccati step", {"color": "#009e73", "linewidth": 1.1}),
    "ekf-euler": ("EKF, explicit Euler", {"color": "#cc79a7", "linewidth": 1.1, "linestyle": (0, (4, 1.5))}),
}


def draw(study: Study, spread: float, number: int) -> Any:
    """Draw the paper's picture (averaged state and estimates) above the averaged squared error, for both observations."""
    figure = new_figure(10.0, 6.4)
    columns = [i for i, setting in enumerate(study.settings) if setting.spread == spread]
    panels = figure.subplots(2, len(columns), sharex=True, sharey="row", squeeze=False)
    for column, index in enumerate(columns):
        above, below = panels[:, column]
        above.set_title(f"$P_0$ = {spread:g} read as {study.settings[index].interpretation}", fontsize=10)
        above.plot(study.times, study.states.mean(axis=0), color="#d55e00", linewidth=1.6, label="state")
        survivors = ~study.diverged[index]
        for name, (label, style) in _LINES.items():
            kept = survivors if name == "ekf-euler" else np.ones(len(survivors), bool)
            means = study.means[name][index][kept]
            if kept.any():
                above.plot(study.times, means.mean(axis=0), label=label, **style)
                below.semilogy(study.times, np.mean((study.states[kept] - means) ** 2, axis=0), **style)
        below.set_title(f"of explicit Euler's {len(survivors)} paths {survivors.sum()} survive", fontsize=9)
        below.set_xlabel("t")
    panels[0, 0].set_ylabel("state and estimates,\naveraged over paths")
    panels[1, 0].set_ylabel("squared error,\naveraged over paths")
    for panel in panels.flat:
        plain(panel)
    handles = {label: line for line, label in zip(*panels[0, 0].get_legend_handles_labels(), strict=True)}
    handles |= {label: line for line, label in zip(*panels[0, -1].get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    figure.suptitle(f"Chen, Luo and Yau 2017, Figure {number}, reproduced", fontsize=11)
    return figure
