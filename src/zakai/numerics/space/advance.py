"""The Kolmogorov forward equation over an interval: the lengths of the substeps follow from their errors and the work.

Short intervals whose error is known to be small from earlier ones are taken in single substeps.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space.field import (
    NOTHING,
    Field,
    Report,
    positive,
)
from zakai.numerics.space.splitting import Potential
from zakai.numerics.space.step import Stepper

Array = NDArray[Any]
MOST_PARTS, MOST_WORK = 512, 2**22  # substeps of an interval, and substeps times points
BALANCED = 0.5  # of the error that the grid makes, below which shorter substeps do not make that in time
CHECKED = 64  # intervals after which the error of single substeps is measured again
WORTH, SMALL = 1.5, 0.05  # least order in its length of a small error of a substep for which shorter ones are tried
VANISHED = Report(1.0, 0.0, 1.0, 1.0, 0.0)
UNALIKE = 4.0  # times the error of a single substep that was measured on another density, which may have another shape
_EXTRAPOLATED = 1.0  # the error that extrapolation leaves, as a multiple of difference^(5/3)


class Control(NamedTuple):
    """The error of a substep as it was measured last.

    `rate` is the error of a substep of length one (it grows as the cube), from substeps of length `measured`, `age` intervals
    ago, on a `fixed` grid or on grids that follow the mass.
    """

    rate: float
    measured: float
    age: int
    fixed: bool = False

    def known(self, tau: float, allowed: float) -> bool:
        """Return whether the error of a substep of length tau is known well enough: the larger it is, the sooner it expires."""
        error = self.rate * tau**3
        fresh = np.isfinite(error) and self.age * (1 + 4 * error / allowed) < CHECKED
        return bool(fresh and tau <= 2 * self.measured)

    def parts(self, tau: float, allowed: float) -> tuple[int, int]:
        """Return how many substeps keep an interval's error in time, if known: single ones, and extrapolated ones."""
        singles = max(1, math.ceil(math.sqrt(self.rate * tau**3 / allowed)))
        return singles, max(1, math.ceil((self.extrapolated(tau) / allowed) ** 0.25))

    def extrapolated(self, tau: float) -> float:
        """Return the error that extrapolation leaves of a substep of length tau."""
        return float(_EXTRAPOLATED * (0.75 * min(self.rate * tau**3, 1.0)) ** (5 / 3))


def _vanished(field: Field) -> bool:
    """Return whether nothing is left of a density, as where the grid that its tails need does not resolve it."""
    return not 0.0 < field.values.real.max() < np.inf


def advance(
    stepper: Stepper,
    field: Field,
    t0: float,
    tau: float,
    potential: Potential | None,
    control: Control,
    allowed: float,
    least: int = 1,
) -> tuple[Field, Report, Control]:
    """Return the density after the interval from t0 of length tau, with an error of the splitting of about `allowed`.

    `least` is the number of substeps that resolve the coefficients' variation in time.
    """
    if tau <= 0:
        return field, NOTHING, control
    known = not control.fixed and control.known(tau, allowed)
    error = control.rate * tau**3 if known else np.inf
    singles = np.ceil(np.sqrt(UNALIKE * error / allowed)) if np.isfinite(error) else np.inf
    doubles = max(1.0, np.ceil((control.extrapolated(tau) / allowed) ** 0.25)) if known else 1.0
    singles, doubles = max(singles, 2.0 * least if least > 1 else 1.0), max(doubles, least)
    if singles < 2 * doubles and stepper.limit(field, t0, t0 + tau / singles) >= t0 + tau / singles:
        parts, report = int(singles), NOTHING
        for i in range(parts):
            before = field
            field, more = stepper.single(field, t0 + tau * i / parts, t0 + tau * (i + 1) / parts, potential)
            if _vanished(field):
                return before, report.worst(VANISHED), Control(np.inf, 0.0, 0)
            field, spread = stepper.resolved(field, more)
            field = positive(field, stepper.bounds)
            report = report.worst(more._replace(splitting=spread, removed=field.removed))
        return field, report._replace(splitting=report.splitting + error / parts**2), control._replace(age=control.age + 1)
    if not control.fixed and control.measured > 0 and tau > 2 * control.measured:
        doubles = max(doubles, np.ceil(min(tau / (1.5 * control.measured), MOST_PARTS)))
    return _adaptively(stepper, field, t0, tau, potential, int(doubles), allowed, 1.0 / least)


def _adaptively(
    stepper: Stepper, field: Field, t0: float, tau: float, potential: Potential | None, parts: int, allowed: float, longest: float
) -> tuple[Field, Report, Control]:
    """Return the density after an interval in extrapolated substeps whose lengths follow from the error of each.

    Shorter substeps are tried as long as the error is larger than the tolerance and than what the grid makes, and decreases with
    an order of at least `WORTH`: at a kink it does not.  No interval has more than about `MOST_PARTS` substeps, and fewer on
    large grids; its report says what error they make.
    """
    done, length, report, rate = 0.0, 1.0 / parts, NOTHING, 0.0
    left, before, stalled, growth, work = MOST_PARTS + 2.0 * parts, (np.inf, 1.0), False, 3.0, 0
    while done < 1 - 1e-12:
        length = min(max(length, (1 - done) / left), longest, 1 - done)
        if 1 - done - length < 0.3 * length:
            length = 1 - done if 1 - done <= 1.3 * length else 0.5 * (1 - done)
        begin, end = t0 + tau * done, t0 + tau * (done + length)
        limit = stepper.limit(field, begin, end)
        if limit < end:
            end, length = limit, (limit - begin) / tau
        result, more, difference = stepper.double(field, begin, end, potential)
        if _vanished(result):
            return field, report.worst(VANISHED), Control(np.inf, 0.0, 0)
        work += result.values.size
        difference = min(difference, 10.0) if np.isfinite(difference) else 10.0
        error = _EXTRAPOLATED * difference ** (5 / 3)
        wanted = max(allowed * length, BALANCED / 3 * min(more.of_grid(stepper.bounds.reach), 1.0))
        change = float(np.clip(0.9 * (wanted / max(error, 1e-30)) ** 0.25, 0.2, growth))
        left = max(min(left - 1, (MOST_WORK - work) / result.values.size), 1)
        stalled = stalled or SMALL > difference and error > before[0] * (length / before[1]) ** WORTH
        if error > 3 * wanted and left > 1 and not (stalled and difference < SMALL):
            before, length, growth = (error, length), length * min(change, 0.7), 1.0
            continue
        result, spread = stepper.resolved(result, more)
        field = positive(result, stepper.bounds)
        report = report.worst(more._replace(splitting=error + spread, removed=math.hypot(more.removed, field.removed)))
        before = np.inf, 1.0
        growth, rate = 3.0, max(rate, difference * (4 / 3) / max((tau * length) ** 3, 1e-300))
        done, last, length = done + length, length, length * (max(change, 1.0) if stalled else change)
    return field, report, Control(rate, tau * last, 0)
