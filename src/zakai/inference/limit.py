"""The limit of a parameter beyond which a log-likelihood does not exist, as a function of the other parameters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

DOUBLINGS = 60  # of the step by which the limit is sought
HALVINGS = 32  # of the interval that holds it
STEP = 1e-3  # of the differences for its slope

Exists = Callable[[np.ndarray], bool]


class Limit:
    """The limit of parameter `axis` in the direction `side`, at which it is for a function of the others.

    Of all parameters it is the one that can raise the log-likelihood least, to first order, before its limit.
    """

    def __init__(self, exists: Exists, u: np.ndarray, gradient: np.ndarray, most: float):
        """Choose the parameter.

        Args:
            exists: whether the log-likelihood exists at parameters (p,).
            u: parameters (p,) at which it exists.
            gradient: that of the negative log-likelihood there (p,).
            most: the largest gain before a limit that counts as found.
        """
        self._exists, self.last = exists, 0.0
        sides, found = -np.sign(gradient), []
        for axis, side in enumerate(sides):
            self.axis, self.side, self.last = axis, side, u[axis]
            end = self.at(u) if side else None
            found.append(np.inf if end is None else abs(gradient[axis] * (end - u[axis])))
        self.axis = int(np.argmin(found))
        self.side, self.last = float(sides[self.axis]), float(u[self.axis])
        self.found = bool(found[self.axis] < most)

    def at(self, u: np.ndarray) -> float | None:
        """Return a value of the parameter just beyond its limit for the others in u (p,), None where there is no limit."""

        def exists(value: float) -> bool:
            point = u.copy()
            point[self.axis] = value
            return self._exists(point)

        begin, step = self.last, STEP
        inside = exists(begin)
        towards = self.side if inside else -self.side
        for _ in range(DOUBLINGS):
            end = begin + towards * step
            if exists(end) != inside:
                break
            begin, step = end, 2.0 * step
        else:
            return None
        within, beyond = (begin, end) if inside else (end, begin)
        for _ in range(HALVINGS):
            middle = 0.5 * (within + beyond)
            within, beyond = (middle, beyond) if exists(middle) else (within, middle)
        self.last = float(beyond)
        return self.last

    def slope(self, u: np.ndarray) -> np.ndarray:
        """Return the derivatives (p,) of the limit with respect to the others, zero where there is none."""
        found = np.zeros(len(u))
        for i in range(len(u)):
            if i != self.axis:
                ends = [self.at(u + sign * STEP * np.eye(len(u))[i]) for sign in (1.0, -1.0)]
                found[i] = 0.0 if None in ends else (ends[0] - ends[1]) / (2.0 * STEP)  # type: ignore[operator]
        return found
