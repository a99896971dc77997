"""From which past each backward draw descends: the particles of windows of the filter, and their noise, interval by interval.

A draw at some time is a particle of the filter at that time or later.  The window of that filter holds its past: the state at the
start of each interval, and the noise in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.particles.events import Events
from zakai.methods.particles.interval import Motion
from zakai.methods.particles.islands import Islands
from zakai.methods.particles.programs import Array
from zakai.methods.particles.window import Window, taken


class Piece(NamedTuple):
    """One interval of the past of draws: the events, the states (n, M) at its start, and the noise (d, M)."""

    events: Events
    start: Array
    noise: Array


class Descent(NamedTuple):
    """The past of M draws.

    `windows` by number, with the intervals until their ends; of each draw the number of its window (M,), -1 where nothing is
    known, its particle (M,) after the interval in question, and its families (2, M).
    """

    windows: dict[int, tuple[int, Window]]
    root: Array
    particle: Array
    families: Array

    @classmethod
    def begin(cls, interval: int, window: Window, particle: Array, families: Array) -> Descent:
        """Return the past of particles of a filter after so many intervals."""
        return cls({interval: (interval, window)}, np.full(len(particle), interval), particle, families)

    def piece(self, interval: int, motion: Motion) -> tuple[Descent, Piece | None]:
        """Return the past of the draws before an interval of this number, and in it; NaN where it is not known."""
        windows, root, particle = dict(self.windows), self.root.copy(), self.particle.copy()
        start = noise = events = None
        for number in np.unique(root[root >= 0]).tolist():
            end, window = windows[number]
            place, own = window.length - (end - interval), np.flatnonzero(root == number)
            if place < 0:
                root[own] = -1
                continue
            if place and not window.ends[place - 1].size:
                window = window.part(motion, own_particles(window, place, particle[own]), place + 1)
                windows[number], particle[own] = (interval + 1, window), np.arange(len(own))
            index = particle[own]
            if len(window.ancestors[place]):
                index = window.ancestors[place][index]
            if events is None:
                events = window.events[place]
                start, noise = (np.full((len(part), len(root)), np.nan) for part in (window.start, window.noises[place]))
            assert start is not None and noise is not None
            noise[:, own] = taken(window.noises[place], index)
            if place and len(window.ancestors[place - 1]):
                before = window.ancestors[place - 1][index]
            else:
                before = index
            start[:, own] = taken(window.ends[place - 1], before) if place else window.beginning(index)
            particle[own] = index
        used = set(root.tolist())
        known = {number: one for number, one in windows.items() if number in used}
        after = Descent(known, root, particle, self.families)
        if events is None:
            return after, None
        assert start is not None and noise is not None
        return after, Piece(events, start, noise)

    def joined_by(self, chosen: Array, other: Descent) -> Descent:
        """Return the past of draws of which some (M,) go on with that of another one."""
        root, particle = np.where(chosen, other.root, self.root), np.where(chosen, other.particle, self.particle)
        return Descent(
            {**self.windows, **other.windows}, root, particle, np.where(chosen, other.families, self.families)
        )

    def variances(self, deviations: Array) -> Array:
        """Return the variances (n,) of the mean of draws, from their deviations (n, M): the largest by families."""
        count, found = deviations.shape[1], np.zeros(len(deviations))
        for labels in (*self.families, self.root * 2**32 + self.particle):
            _, places = np.unique(labels, return_inverse=True)
            for d, row in enumerate(deviations):
                sums = np.bincount(places, row)
                found[d] = max(found[d], float(sums @ sums) / count**2)
        return found


def own_particles(window: Window, place: int, particle: Array) -> Array:
    """Return the particles at the end of interval `place` of a window as those of that interval."""
    return window.ancestors[place][particle] if len(window.ancestors[place]) else particle


def families(islands: Islands, particle: Array, interval: int) -> Array:
    """Return numbers (2, M) of groups of draws: those of one particle, and those of one island."""
    return np.array([interval * 2**32 + particle.astype(np.int64), islands.epoch * 2**32 + islands.label[particle]])
