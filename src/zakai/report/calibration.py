"""The section on calibration: residuals of a result as pictures and tests, with bounds that hold if the model is true.

References:
    Diebold, Gunther and Tay 1998, Evaluating density forecasts.
    Ljung and Box 1978, On a measure of lack of fit in time series models.
"""

from __future__ import annotations

import warnings
from html import escape
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.report.charts import Chart, axis, time_axis
from zakai.report.scripts import framed

_ROWS = 200  # of the end of a record, of which the residuals are computed
_BINS, _LAGS, _MOST_COORDINATES = 10, 20, 4
_TESTED_LAGS = 10  # of the test of autocorrelation, or a fifth of the residuals
_CLIP = 1e-9  # a residual nearer to 0 or 1 is drawn as this
_SMALL, _WEAK = 0.01, 0.05  # p-values below which a test speaks against the model, and does so weakly
_FAR, _MOST_FAR = 4.0, 0.1  # deviations of an outlier, of which a true model has one in 16,000, and the largest share of them


class Calibration(NamedTuple):
    """Residuals u of one observed coordinate, with their times, normal scores z, autocorrelations r of z, and p-values.

    `uniformity`: of the Kolmogorov-Smirnov test of u; `variance`: of the sum of z^2, which is chi-squared; `independence`: of
    the Ljung-Box test of r.
    """

    times: np.ndarray
    u: np.ndarray
    scores: np.ndarray
    autocorrelation: np.ndarray
    uniformity: float
    variance: float
    independence: float

    def verdicts(self) -> list[tuple[str, str, str, bool]]:
        """Return for each test its name, its p-value, what that says, and whether it speaks against the model."""
        power = float(np.mean(self.scores**2))
        tests = [
            ("Uniform (Kolmogorov-Smirnov)", "uniformity", "the model has a bias or a noise of the wrong size or law"),
            (
                f"Mean square of the normal scores: {power:.3g}, expected 1 (chi-squared)",
                "variance",
                "the model's noise is too small, or it has a bias" if power > 1 else "the model's noise is too large",
            ),
            ("No autocorrelation (Ljung-Box)", "independence", "the model's dynamics are wrong"),
        ]
        return [(name, _p_value(getattr(self, key)), *self._reading(key, said)) for name, key, said in tests]

    def _reading(self, key: str, said: str) -> tuple[str, bool]:
        p, far = getattr(self, key), np.abs(self.scores) > _FAR
        if p >= _WEAK:
            return "consistent with the model", False
        count = int(far.sum())
        if 0 < count <= _MOST_FAR * len(far) and len(far) - count >= 3:
            rest = calibration_of(self.times[~far], self.u[~far])
            if getattr(rest, key) >= _WEAK:
                what = "one outlier" if count == 1 else f"{count} outliers"
                return f"{what} beyond {_FAR:g} deviations; the others are consistent with the model", True
        return (said, True) if p < _SMALL else (f"weak evidence that {said}", True)

    def table(self) -> str:
        """Return the tests as a table, with what a small p-value says."""
        cells = "".join(
            f'<tr><td>{name}</td><td class="number">{p}</td><td class="{"fails" if fails else "open"}">{said}</td></tr>'
            for name, p, said, fails in self.verdicts()
        )
        return f"<table><thead><tr><th>Test</th><th>p-value</th><th>Reading</th></tr></thead><tbody>{cells}</tbody></table>"


def _p_value(p: float) -> str:
    return "below 0.0001" if p < 1e-4 else f"{p:.2g}"


def calibration_of(times: np.ndarray, u: np.ndarray) -> Calibration:
    """Return the figures of the residuals (K,) of one coordinate; NaN where nothing was observed."""
    from scipy.special import chdtr, chdtrc, ndtri

    rows = np.flatnonzero(np.isfinite(u))
    count = len(rows)
    scores = ndtri(np.clip(u, _CLIP, 1 - _CLIP))
    centred = np.where(np.isfinite(scores), scores - np.nanmean(scores), 0.0)
    variance = float(centred @ centred)
    lags = range(1, min(_LAGS, count - 1) + 1)
    found = np.array([float(centred[lag:] @ centred[:-lag]) / variance if variance > 0 else 0.0 for lag in lags])
    tested = min(_TESTED_LAGS, max(1, count // 5))
    portmanteau = count * (count + 2) * float(np.sum(found[:tested] ** 2 / (count - np.arange(1, tested + 1))))
    power = float(scores[rows] @ scores[rows])
    return Calibration(
        times[rows],
        u[rows],
        scores[rows],
        found,
        _uniformity(u[rows]),
        float(min(1.0, 2.0 * min(chdtr(count, power), chdtrc(count, power)))),
        float(chdtrc(tested, portmanteau)),
    )


def _uniformity(u: np.ndarray) -> float:
    """Return the p-value of the Kolmogorov-Smirnov test, by Stephens' approximation: within .03 for ten residuals, .01 for 200.

    SciPy's test is in a module that takes as long to import as the rest of a report to draw.

    References:
        M. A. Stephens, "EDF statistics for goodness of fit and some comparisons", J. Am. Stat. Assoc. 69 (1974).
    """
    from scipy.special import kolmogorov

    count = len(u)
    steps = np.arange(count + 1) / count
    distance = max(float(np.max(steps[1:] - np.sort(u))), float(np.max(np.sort(u) - steps[:-1])))
    return float(kolmogorov((np.sqrt(count) + 0.12 + 0.11 / np.sqrt(count)) * distance))


def section(result: Any) -> str:
    """Return the section: PIT histogram, normal scores over time, and autocorrelation of each observed coordinate."""
    from zakai.diagnostics.residuals import residuals

    count = len(result.times) - 1
    if getattr(result, "origin", None) is None or result.record is None or count == 0:
        return "<p>The result does not hold its filter and its record. Filter the record again to have residuals.</p>"
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            u = residuals(result, first=max(0, count - _ROWS))
    except InputError as error:
        return f"<p>There are no residuals: {escape(str(error))}.</p>"
    parts = [
        "<p>A residual is the probability, given all earlier observations, of an observation at most as large as the one that "
        "came. If the model is true, residuals are uniform on 0 to 1 and independent: the histogram is flat, the normal scores "
        "look like standard normal numbers, and their autocorrelations are zero. The bands hold 95% of the values of a true "
        "model. A U-shaped histogram shows that the noise of the model is too small, a hump that it is too large, a slope a "
        "bias; autocorrelation shows that the dynamics are wrong, unless outliers make it.</p>"
    ]
    used = f" of the last {_ROWS:,} of {count:,} observations" if count > _ROWS else ""
    parts += [f"<p><strong>{escape(str(one.message))}.</strong></p>" for one in caught]
    columns = [j for j in range(u.shape[1]) if np.isfinite(u[:, j]).sum() >= 3]
    if not columns:
        return "".join(parts) + "<p>Fewer than three observations have a residual.</p>"
    if len(columns) > _MOST_COORDINATES:
        parts.append(f"<p>The first {_MOST_COORDINATES} of {len(columns)} observed coordinates are drawn.</p>")
    times = np.asarray(result.times, dtype=float)[1:]
    for j in columns[:_MOST_COORDINATES]:
        found = calibration_of(times, u[:, j])
        title = f"<h3>Observation {j + 1}</h3>" if u.shape[1] > 1 else ""
        figure = framed("chart", calibration_frame(found, getattr(result, "clock", None)), f"calibration-{j}")
        parts.append(f"{title}<p>{len(found.u):,} residuals{used}.</p>{found.table()}{figure}")
    return "".join(parts)


def calibration_frame(found: Calibration, clock: Any = None) -> bytes:
    """Return the three panels for one observed coordinate."""
    from scipy.special import bdtr

    count = len(found.u)
    heights = np.histogram(found.u, _BINS, (0.0, 1.0))[0] * _BINS / count
    middles = (np.arange(_BINS) + 0.5) / _BINS
    low, high = np.searchsorted(bdtr(np.arange(count), count, 1.0 / _BINS), [0.025, 0.975]) * _BINS / count
    chart = Chart(across=2)
    top = 1.1 * max(float(high), float(heights.max()))
    panel = chart.panel("residuals", axis("probability", 0, 1), axis("density", 0, top), height=230)
    panel.add("bars", middles, heights, width=0.92 / _BINS).add("rows", low=low, high=high, colour="band")
    for level, line in (
        (low, {"dash": [3, 3], "colour": "band"}),
        (1.0, {"colour": "ink"}),
        (high, {"dash": [3, 3], "colour": "band"}),
    ):
        panel.add("row", at=float(level), **line)
    lags, bound = np.arange(1, len(found.autocorrelation) + 1), 1.96 / np.sqrt(count)
    size = max(0.3, 1.2 * bound, 1.1 * float(np.abs(found.autocorrelation).max(initial=0.0)))
    panel = chart.panel(
        "autocorrelation of the normal scores", axis("lag (observations)", 0, len(lags) + 1), axis("", -size, size), height=230
    )
    panel.add("rows", low=-bound, high=bound, colour="band").add("bars", lags, found.autocorrelation, width=0.3)
    panel.add("row", at=0.0, colour="ink")
    size = max(3.5, 1.1 * float(np.abs(found.scores).max()))
    panel = chart.panel("normal scores over time", time_axis(clock), axis("deviations", -size, size), wide=True, height=210)
    panel.add("rows", low=-1.96, high=1.96, colour="band").add("dots", found.times, found.scores)
    return chart.frame()
