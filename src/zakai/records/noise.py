"""Where the noise of increments varies within an interval, so that their law differs from the convention of the filters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from zakai.models.numeric import numpy_function
from zakai.records.schedule import Schedule

if TYPE_CHECKING:
    from zakai.models.model import Model

NODES = 64  # times inside of an interval at which the noise is evaluated
DIFFERS = 0.05  # relative difference of the two precisions that a result reports
AT_ONCE = 4096  # intervals that are checked together


def noise_varies(model: Model) -> bool:
    """Return whether the noise may vary within an interval over which an increment is gathered."""
    varying = model.t in model.observation_noise.free_symbols
    return model.observation_kind != "samples" and varying and not model.observation_noise.free_symbols & set(model.z)


def notes_on_noise(model: Model, schedule: Schedule) -> list[str]:
    """Return a sentence where y linear between observations is far from the exact law of the increments.

    The filters integrate S^-1 over an interval of length d (y is linear inside), and the covariance of an increment is the
    integral of S:

        (1/d) int S^-1 dt   against   ((1/d) int S dt)^-1;

    the first is the larger.  Where their ratio exceeds 1 + 0.05 in some coordinate, the sentence names the first such time.
    """
    if not noise_varies(model):
        return []
    noise = numpy_function(list(model.observation_noise.diagonal()), model)
    origin, theta = np.zeros(model.n), model.theta()
    # Irregular places see a coefficient with a period at all its phases.
    places = (np.arange(NODES) + 0.5 + 0.4 * np.sin(7.0 * np.arange(NODES))) / NODES
    worst, first, count = 0.0, np.nan, 0
    for begin in range(0, len(schedule), AT_ONCE):
        part = schedule.part(slice(begin, begin + AT_ONCE))
        times = part.starts[:, None] + (part.stops - part.starts)[:, None] * places
        u = None if part.inputs is None else part.inputs.at(times, model.input_hold)
        values = noise(origin, times, theta, u)
        excess = (np.mean(values, axis=1) * np.mean(1.0 / values, axis=1)).max(axis=1) - 1.0
        over = (excess > DIFFERS) & part.seen.any(axis=1) & (part.stops > part.starts)
        count += int(over.sum())
        if over.any():
            first = float(part.stops[np.argmax(over)]) if np.isnan(first) else first
            worst = max(worst, float(excess[over].max()))
    if not count:
        return []
    return [
        f"observation_noise varies within {count} of {len(schedule)} intervals (first at t = {first:.12g}): y is taken as linear "
        f"between observations, whose precision exceeds that of the exact law of the increments by up to {worst:.0%}; "
        "give shorter intervals"
    ]
