"""The recent past of the particles as standard normal noise, and the Gaussian that approximates its posterior.

Resampling does not copy the past: every interval keeps the noise of its own particles, and the ancestors that lead from one
interval to the next.  The past of the particles is put together when it is moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.particles.events import Events, Observed
from zakai.methods.particles.interval import Motion
from zakai.methods.particles.programs import Array
from zakai.methods.particles.system import root
from zakai.numerics.particles import moves
from zakai.numerics.particles.chunks import CHUNK, over_chunks
from zakai.numerics.particles.even import Even

INTERVALS = 64  # of a window
# Normal numbers of a particle in a window, at least and at most: a move costs their square.  Between these it is as many as all
# particles together may have: while the window begins at the prior, moves reach what never changes, such as a parameter.
FEWEST, MOST, TOGETHER = 80, 240, 2**23
_STEP = 1e-4  # of forward differences, in standard deviations
_WIDER = 1.15  # variance of the Gaussian over that of the linearised posterior
_INFORMED = 0.1  # information of a direction of the noise, over that of N(0, 1), from which moves follow it
_EMPTY = np.zeros(0, np.int32)
_NO_EVENTS = Events(
    np.zeros((0, 2)), np.zeros((0, 3), np.int64), np.zeros((0, 2, 0)), np.zeros((0, 0, 0)), np.zeros((0, 3), np.int64),
    np.zeros((0, 0)),
)  # fmt: skip


class Window(NamedTuple):
    """The past since the prior, or since the states `start` where that is too long.

    `start` (n, N) are the states at its beginning, `first` (d, N) the noise of a Gaussian prior with `mean` (n,) and `root` (n,
    d), with no rows where the start does not move.  Of `length` intervals, each for its own particles: `noises` (d, N), `ends`
    (n, N) the states at the end, none where they have been moved, `ancestors` (N,) from the particles of the next interval to
    those of this one, none where they are the same, `events`, and what was observed: `times` (I,), `given` (I, L), `counted` (I,
    T).
    """

    start: Array
    first: Array
    mean: Array
    root: Array
    length: int
    noises: tuple[Array, ...]
    ends: tuple[Array, ...]
    ancestors: tuple[Array, ...]
    events: tuple[Events, ...]
    times: Array
    given: Array
    counted: Array

    @classmethod
    def begin(cls, start: Array, first: Array, prior: tuple[Array, Array], shape: tuple[int, int]) -> Window:
        """Return the window at the prior; `shape` are the numbers that are given to the law, and its terms."""
        none, nothing, (given, terms) = (np.zeros((0, 0)),) * INTERVALS, np.zeros(0), shape
        return cls(
            start, first, *prior, 0, none, none, (_EMPTY,) * INTERVALS, (_NO_EVENTS,) * INTERVALS,
            nothing, np.zeros((0, given)), np.zeros((0, terms)),
        )  # fmt: skip

    @property
    def width(self) -> int:
        """The number of normal numbers of a particle."""
        return len(self.first) + sum(map(len, self.noises[: self.length]))

    def resampled(self, ancestors: Array) -> Window:
        """Return the window of particles with these ancestors."""
        if self.length == 0:
            return self._replace(start=taken(self.start, ancestors), first=taken(self.first, ancestors))
        last = self.ancestors[self.length - 1]
        return self._replace(ancestors=_with(self.ancestors, self.length - 1, last[ancestors] if len(last) else ancestors))

    def appended(self, motion: Motion, events: Events, observed: Observed, noise: Array, end: Array) -> Window:
        """Return the window with one interval more, without the oldest ones where it is too long."""
        window = self
        most = min(max(TOGETHER // noise.shape[1], FEWEST), MOST)
        while window.length and (window.length == INTERVALS or window.width + len(noise) > most):
            window = window._shortened(motion)
        k = window.length
        return window._replace(
            length=k + 1, noises=_with(window.noises, k, noise), ends=_with(window.ends, k, end),
            ancestors=_with(window.ancestors, k, _EMPTY), events=_with(window.events, k, events),
            times=np.append(window.times, observed.time), given=np.vstack([window.given, observed.given]),
            counted=np.vstack([window.counted, observed.counted]),
        )  # fmt: skip

    def _shortened(self, motion: Motion) -> Window:
        """Return the window without its first interval: it starts from the states there, which do not move."""
        end = self.ends[0]
        if not end.size:
            begin = self.mean[:, None] + self.root @ self.first if len(self.first) else self.start
            end, _ = motion.advanced(self.events[0], begin, self.noises[0])

        def rest(parts: tuple[Any, ...], empty: Any) -> tuple[Any, ...]:
            return (*parts[1:], empty)

        none = np.zeros((0, 0))
        start = taken(end, self.ancestors[0]) if len(self.ancestors[0]) else end
        return Window(
            start, np.zeros((0, start.shape[1])), self.mean, np.zeros((len(start), 0)), self.length - 1,
            rest(self.noises, none), rest(self.ends, none),
            rest(self.ancestors, _EMPTY), rest(self.events, _NO_EVENTS), self.times[1:], self.given[1:], self.counted[1:],
        )  # fmt: skip

    def path(self, index: Array | None = None) -> tuple[Array, Array]:
        """Return the noise (D, N) of the particles, or of some, and the states (n, N) at the start of the window."""
        if index is None and self.length and len(self.ancestors[self.length - 1]):
            count = len(self.ancestors[self.length - 1])
        elif index is None:
            count = (self.noises[self.length - 1] if self.length else self.first).shape[1]
        else:
            count = len(index)
        out = np.empty((self.width, count))
        place = len(out)
        for k in reversed(range(self.length)):
            ancestors, noise = self.ancestors[k], self.noises[k]
            if len(ancestors):
                index = ancestors if index is None else ancestors[index]
            place -= len(noise)
            out[place : place + len(noise)] = noise if index is None else taken(noise, index)
        out[:place] = self.first if index is None else taken(self.first, index)
        return out, np.ascontiguousarray(self.start if index is None else taken(self.start, index))

    def moved(self, path: Array, start: Array, end: Array) -> Window:
        """Return the window of particles with this noise (D, N), from these starts, that end there."""
        none, place, noises = np.zeros((0, 0)), len(self.first), list(self.noises)
        for k in range(self.length):
            noises[k] = np.ascontiguousarray(path[place : place + len(noises[k])])
            place += len(noises[k])
        ends = _with((none,) * INTERVALS, self.length - 1, end)
        first = np.ascontiguousarray(path[: len(self.first)])
        return self._replace(start=start, first=first, noises=tuple(noises), ends=ends, ancestors=(_EMPTY,) * INTERVALS)

    def beginning(self, index: Array) -> Array:
        """Return the states (n, M) of some particles at the start of the window."""
        if len(self.first):
            return np.asarray(self.mean[:, None] + self.root @ taken(self.first, index))
        return taken(self.start, index)

    def part(self, motion: Motion, index: Array, length: int) -> Window:
        """Return the first intervals of the window, of some particles after them, with the states at all ends."""
        none = (_EMPTY,) * INTERVALS
        before = self._replace(
            length=length, ancestors=(*self.ancestors[: length - 1], *none[: INTERVALS - length + 1]),
            times=self.times[:length], given=self.given[:length], counted=self.counted[:length],
        )  # fmt: skip
        path, start = before.path(index)
        first = np.ascontiguousarray(path[: len(self.first)])
        begin = self.mean[:, None] + self.root @ first if len(first) else start
        ends = np.zeros((length, *start.shape))
        motion.advanced(joined(self.events[:length]), np.ascontiguousarray(begin), np.ascontiguousarray(path[len(first) :]), ends)
        window = before.moved(path, start, ends[-1])
        return window._replace(ends=(*ends, *before.ends[length:]))

    def last(self, motion: Motion, count: int) -> tuple[Window, Array, Array]:
        """Return the past of the particles in the last intervals.

        Returns:
            The window without ancestors and states in them, the states (n, N) before them, and the noise (D, N) in them.
        """
        place, index, noises = self.length - count, None, list[Array]()

        def own(columns: Array) -> Array:
            return columns if index is None else taken(columns, index)

        def before(k: int) -> Array | None:
            ancestors = self.ancestors[k]
            return index if not len(ancestors) else ancestors if index is None else ancestors[index]

        for k in reversed(range(place, self.length)):
            index = before(k)
            noises.append(own(self.noises[k]))
        none, window = (_EMPTY,) * INTERVALS, self
        if place == 0:
            start = own(self.mean[:, None] + self.root @ self.first if len(self.first) else self.start)
            window = self._replace(start=own(self.start), first=own(self.first))
        else:
            index, end = before(place - 1), self.ends[place - 1]
            if not end.size:
                end = self.part(motion, np.arange(self.noises[place - 1].shape[1]), place).ends[place - 1]
            start = own(end)
            window = self._replace(ancestors=_with(self.ancestors, place - 1, _EMPTY if index is None else index))
        nothing = (np.zeros((0, 0)),) * len(none[place:])
        window = window._replace(ancestors=(*window.ancestors[:place], *none[place:]), ends=(*self.ends[:place], *nothing))
        return window, np.ascontiguousarray(start), np.concatenate(noises[::-1])

    def with_noise(self, count: int, path: Array) -> Window:
        """Return the window with this noise (D, N) in the last intervals."""
        noises, place = list(self.noises), 0
        for k in range(self.length - count, self.length):
            size = len(noises[k])
            noises[k] = np.ascontiguousarray(path[place : place + size])
            place += size
        return self._replace(noises=tuple(noises))

    def target(self, motion: Motion, start: Array) -> Target:
        """Return what the noise of this window must follow."""
        prior = (self.mean, self.root) if len(self.first) else None
        return Target(motion, joined(self.events[: self.length]), self.times, self.given, self.counted, prior, start)


def taken(columns: Array, index: Array) -> Array:
    """Return columns (d, N) by their numbers, contiguous."""
    return np.take(columns, index, axis=1)


def _with(parts: tuple[Any, ...], place: int, part: Any) -> tuple[Any, ...]:
    return (*parts[:place], part, *parts[place + 1 :])


def joined(parts: tuple[Events, ...]) -> Events:
    """Return the events of consecutive intervals as one list, whose observations are numbered."""
    if len(parts) == 1:
        return parts[0]
    width = max(part.roots.shape[2] for part in parts)
    roots, places, rows, kicks, noise = [], [], [], 0, 0
    for number, part in enumerate(parts):
        roots.append(np.pad(part.roots, ((0, 0), (0, 0), (0, width - part.roots.shape[2]))))
        place = part.places.copy()
        place[:, 0] += np.where(place[:, 0] >= 0, kicks, 0)
        place[:, 1] = np.where(place[:, 1] >= 0, number, -1)
        row = part.rows.copy()
        row[:, 0] += noise
        places.append(place)
        rows.append(row)
        kicks, noise = kicks + len(part.rows), noise + part.width
    times, given, spreads = (np.concatenate([getattr(part, name) for part in parts]) for name in ("times", "given", "spreads"))
    return Events(times, np.concatenate(places), given, np.concatenate(roots), np.concatenate(rows), spreads)


class _Precision(NamedTuple):
    """A matrix I + V' diag(values) V of as few orthonormal rows V (r, D) as observations inform."""

    values: Array
    vectors: Array

    @classmethod
    def of(cls, rows: list[Array]) -> _Precision:
        """Return I + B'B for blocks of the rows of B."""
        _, sizes, vectors = np.linalg.svd(np.concatenate(rows), full_matrices=False)
        return cls(sizes**2, vectors)

    def solve(self, right: Array) -> Array:
        """Return the product of the inverse and a vector (D,) or columns (D, k)."""
        share = self.values / (1.0 + self.values)
        return np.asarray(right - (self.vectors.T * share) @ (self.vectors @ right))


@dataclass(frozen=True)
class Target:
    """The law of the noise of a window: N(0, I) times the likelihood of what is observed in it.

    `prior` is the mean and the root of a Gaussian prior whose noise belongs to the window; None where it starts from states.
    """

    motion: Motion
    events: Events
    times: Array
    given: Array
    counted: Array
    prior: tuple[Array, Array] | None
    start: Array

    @property
    def arrays(self) -> moves.WindowLaw:
        """The law as the kernels take it."""
        observed = (self.motion.law, self.times, self.given, self.counted)
        n = len(self.start)
        prior = self.prior or (np.zeros(n), np.zeros((n, 0)))
        return moves.WindowLaw(self.motion.arrays, tuple(self.events), observed, prior)

    def propagate(self, even: Even, update: bool) -> tuple[moves.Advance, int]:
        """Return the particles after noise that is drawn, and how many are lost; with `update` those before the last one, too."""
        n, count = self.start.shape
        noise, states, seen = (np.empty((rows, count)) for rows in (self.events.width, n, n if update else 0))
        after, arrays = moves.Advance(noise, states, seen, np.empty(count)), self.arrays
        lost = over_chunks(lambda low, high: moves.propagate(arrays, even, self.start, low, high, after), count)
        return after, sum(lost)

    def follow(self, path: Array) -> tuple[Array, Array]:
        """Return the states (n, N) at the end and the log-likelihoods (N,) for noise (D, N)."""
        out, total = np.empty_like(self.start), np.empty(path.shape[1])
        arrays = self.arrays
        over_chunks(lambda low, high: moves.follow(arrays, self.start, path, low, high, out, total), len(total))
        return out, total

    def draw(self, gaussian: Any, share: float, even: Even) -> tuple[Array, Array]:
        """Return noise (D, N) of which a share is drawn from N(0, I), and log N(0, I) less the log of its density (N,)."""
        count = self.start.shape[1]
        path, ratio = np.empty((len(gaussian[0]), count)), np.empty(count)
        over_chunks(lambda low, high: moves.draw(gaussian, share, even, self.start, low, high, path, ratio), count)
        return path, ratio

    def sweep(
        self, gaussian: Any, path: Array, control: tuple[float, ...], key: Array
    ) -> tuple[Array, Array, Array, float, float]:
        """Move noise in place; return it, states, log-likelihoods, the mean acceptance, and the smallest change of a chunk."""
        out, total, arrays = np.empty_like(self.start), np.empty(path.shape[1]), self.arrays
        moved, numbers = np.zeros((-(-len(total) // CHUNK), 2)), np.array(control)
        paths = moves.Paths(self.start, path, out, total, moved)
        over_chunks(lambda low, high: moves.sweep(arrays, gaussian, numbers, key, low, high, paths), len(total))
        return path, out, total, float(moved[:, 0].mean()), float(moved[:, 1].min())

    def gaussian(self, path: Array, weights: Array | None, power: float = 1.0, rounds: int = 2, wider: float = _WIDER) -> Any:
        """Return the posterior of the linearised window by Gauss and Newton's iteration, None where it does not exist.

        It depends on the particles through the point of linearisation only.

        Args:
            path: the noise (D, N), or (D, 1) where the iteration begins.
            weights: of the particles (N,), None where they are equal.
            power: of the likelihood of the last observation.
            rounds: of the iteration.
            wider: the factor of the variances.
        """
        D, n, start = len(path), len(self.start), self.start
        point = path.mean(axis=1) if weights is None or path.shape[1] == 1 else path @ weights
        centre = start.mean(axis=1) if weights is None else start @ weights
        apart = start - centre[:, None]
        spread = np.sqrt(np.mean(apart**2, axis=1) if weights is None else apart**2 @ weights)
        spread = _STEP * np.maximum(spread, 1e-9 * (1.0 + np.abs(centre)))
        moving = 0 if self.prior is not None else n
        rows = self.events.rows[self.events.rows[:, 2] > 0]
        coins = rows[:, 0] + rows[:, 1] + (0 if self.prior is None else self.prior[1].shape[1])  # of which no path is smooth
        gain: Array = np.zeros((D, n))
        posterior = None
        for _ in range(rounds):
            points = np.repeat(point[:, None], 1 + D + moving, axis=1)
            points[np.arange(D), 1 + np.arange(D)] += _STEP
            begin = np.repeat(centre[:, None], 1 + D + moving, axis=1)
            if self.prior is not None:
                d0 = self.prior[1].shape[1]
                begin, points = self.prior[0][:, None] + self.prior[1] @ points[:d0], points[d0:]
            else:
                begin[np.arange(n), 1 + D + np.arange(n)] += spread
            ends = np.zeros((len(self.times), n, points.shape[1]))
            self.motion.advanced(self.events, np.ascontiguousarray(begin), np.ascontiguousarray(points), ends)
            informing, right, across = list[Array](), np.zeros(D), np.zeros((D, moving))
            before = begin
            for k, end in enumerate(ends):
                x = end if self.motion.system.sampled else 0.5 * (before + end)
                before = end
                J = (x[:, 1 : 1 + D] - x[:, :1]) / _STEP
                J[:, coins] = 0.0
                scale = np.sqrt(np.sum(J**2, axis=1)) + spread / _STEP
                slope, information = self._information(k, x[:, 0], scale)
                factor = power if k == len(ends) - 1 else 1.0
                seen = np.sqrt(factor) * root(information).T
                inner = seen @ J
                informing.append(inner)
                right += J.T @ (factor * slope) + inner.T @ (inner @ point)
                if moving:
                    across += inner.T @ (seen @ ((x[:, 1 + D :] - x[:, :1]) / spread))
            if not all(np.isfinite(part).all() for part in (*informing, right, across)):
                return None
            posterior = _Precision.of([np.zeros((0, D)), *informing])
            point = posterior.solve(right)
        assert posterior is not None
        if moving:
            gain = -posterior.solve(across)
        informed = posterior.values > _INFORMED
        directions = np.ascontiguousarray(posterior.vectors[informed])
        factors = np.sqrt((1.0 + posterior.values[informed]) / wider)
        return point, np.ascontiguousarray(gain), centre, directions, factors

    def _information(self, k: int, x: Array, scale: Array) -> tuple[Array, Array]:
        """Return the slope (n,) and the information (n, n) of the log-likelihood of observation k at a state."""
        system, theta, t = self.motion.system, self.motion.theta, float(self.times[k])
        n, law = system.n, system.law
        slope, information = np.zeros(n), np.zeros((n, n))
        if law is None:
            return self._of_increment(k, x, scale)
        if not self.counted[k].any():
            return slope, information
        u = self.given[k, : system.inputs] if system.inputs else None
        read = np.flatnonzero(law.reads)
        if law.is_gaussian:
            h, H = self._slopes(x, scale, read, t, u)
            values = self.given[k, system.inputs : system.inputs + system.m]
            seen = np.flatnonzero(self.given[k, -system.m :])
            r = values - h
            r[law.angles] -= 2 * np.pi * np.round(r[law.angles] / (2 * np.pi))
            S = self.motion.law_parameters(t, u)[0] if law.fixed else law.noise(x[: system.model.n], t, theta, u)
            inverse = np.linalg.inv((S + law.spread(x, t, theta, u))[np.ix_(seen, seen)])
            weighted = inverse @ H[seen]
            slope[read], information[np.ix_(read, read)] = r[seen] @ weighted, H[seen].T @ weighted
            return slope, information
        step = 1e-3 * scale[read]
        count = len(read)
        shifts = [np.zeros(count), *np.eye(count), *-np.eye(count)]
        pairs = [(i, j) for i in range(count) for j in range(i)]
        shifts += [(a * np.eye(count)[i] + b * np.eye(count)[j]) for i, j in pairs for a in (1, -1) for b in (1, -1)]
        points = np.repeat(x[:, None], len(shifts), axis=1)
        points[read] += (np.array(shifts) * step).T
        terms = self.motion.values(self.motion.law, points, t, self.given[k])
        value = np.where(self.counted[k][:, None] > 0, terms, 0.0).sum(axis=0)
        above, below = value[1 : 1 + count], value[1 + count : 1 + 2 * count]
        g, second = 0.5 * (above - below), np.diag(above - 2 * value[0] + below)
        for place, (i, j) in enumerate(pairs):
            four = value[1 + 2 * count + 4 * place :][:4]
            second[i, j] = second[j, i] = 0.25 * (four[0] - four[1] - four[2] + four[3])
        if not (np.isfinite(g).all() and np.isfinite(second).all()):
            return slope, information
        eigenvalues, vectors = np.linalg.eigh(-second)
        positive = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
        slope[read], information[np.ix_(read, read)] = g / step, positive / np.outer(step, step)
        return slope, information

    def _slopes(self, x: Array, scale: Array, read: Array, t: float, u: Array | None) -> tuple[Array, Array]:
        """Return h (m,) and its derivatives (m, R) by the coordinates that are read."""
        step = _STEP * scale[read]
        points = np.repeat(x[:, None], 1 + len(read), axis=1)
        points[read, 1 + np.arange(len(read))] += step
        h = self.motion.values(self.motion.observe, points, t, np.zeros(0) if u is None else u)
        change = h[:, 1:] - h[:, :1]
        if self.motion.system.law is not None:
            angles = self.motion.system.law.angles
            change[angles] -= 2 * np.pi * np.round(change[angles] / (2 * np.pi))
        return h[:, 0], change / step

    def _of_increment(self, k: int, x: Array, scale: Array) -> tuple[Array, Array]:
        """Return slope and information of h'r - h'P h / 2, where r and P are integrals over the interval."""
        system, m = self.motion.system, self.motion.system.m
        last = np.flatnonzero(self.events.places[:, 1] == k)[0]
        first = 0 if k == 0 else np.flatnonzero(self.events.places[:, 1] == k - 1)[0] + 1
        t = float(self.times[k])
        u = self.given[k, : system.inputs] if system.inputs else None
        pairs = system.numbers.pairs

        def numbers(row: Array) -> tuple[Array, Array]:
            P, row = np.zeros((m, m)), row[system.inputs :]
            for (i, j), value in zip(pairs, row[m : m + len(pairs)], strict=True):
                P[i, j] = P[j, i] = value
            return row[:m], P

        r, P = numbers(self.given[k])
        length = float(self.events.times[last, 1] - self.events.times[first, 0])
        own_r, own_P = numbers(self.events.given[first : last + 1].mean(axis=(0, 1)))
        r, P = r * self.counted[k, 0] + length * own_r, P * self.counted[k, 0] + length * own_P
        h, H = self._slopes(x, scale, np.arange(system.n), t, u)
        return H.T @ (r - P @ h), H.T @ P @ H
