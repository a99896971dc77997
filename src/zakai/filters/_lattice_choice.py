"""Which lattice: the window, the cell and the way to convolve, decided between runs of steps, from the density itself.

Nothing here is part of a compiled step.  A run of steps is tried with a plan; if its health says that mass came near an edge or
that a feature grew narrower than a few cells, it is tried again with a larger window or a finer cell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities import GaussianMixture
from zakai.densities.grid import dirichlet
from zakai.errors import InputError
from zakai.kolmogorov.lattice import REACH, SUPPORT, Lattice
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, GaussianPrior

CELLS = 2.5  # standard deviations of the narrowest feature, in cells: below it, values between the points lose digits
CELLS_SHARPENED = 4.2  # the same where the highest fifth of the frequencies is taken out
COARSEST = 0.75  # the largest cell in kernel standard deviations
EDGE = 1e-12
EDGE_SHARPENED = 1e-9  # sharpening cuts the tails at 1e-13 of the maximum, and the cells along the cut add up
QUADRATURE = 1e-11
JOINT = 1.16  # standard deviation, in cells, from which the error of a sum is below QUADRATURE
ROOM = 64.0  # the longest rows of a slanted lattice, in sizes of an axis
BASE = {1: 128, 2: 64, 3: 48}
MOST = {1: 8192, 2: 1024, 3: 256}
MOST_BANDED = 2**17  # points of a window, and taps
WIDEST, FINEST = 40, 300  # the `window` and the `cells` from which on a plan gets no better
MOST_IMAGES = 1024
LONGEST_RUN = 256
STILL_RUN = 1024  # steps on a window that stands still, which end where it serves no more
# A window that stands still serves a splitting, whose own error is larger than these.
COARSEST_STILL = 0.88
EDGE_STILL = 1e-10
QUADRATURE_STILL = 5e-10
SPARE = 0.97  # of the largest cell of a window, for what comes to be narrower
NARROWER = 1.15  # by what factor a feature may come to be narrower before a window that stands still serves no more
STILL_ROOM = 12  # cells to each side of a window that is moved every few steps only
WIDE, STILL_WIDEST = 1.7, 16.0  # the `window` from which on it is looked at after every step, and up to which it is worth while
LEAST_REACH = 7.0  # standard deviations beyond which a Gaussian has less than EDGE_STILL
FINE = {1: 2.0, 2: 2.0, 3: 1.2}  # by how much the first lattice is finer than it need be

ARRAYS = 24  # arrays of the size of the lattice that a step and what it keeps hold at once
SAME = np.zeros(2)  # the cut of a lattice that was taken as it is


@dataclass(frozen=True)
class Plan:
    """How the next steps move the density; static, so that each plan is compiled once.

    `banded` steps keep a window of `sizes` that moves along; the others choose a lattice of `sizes` each time. `window` and
    `cells` say how generous the banded window and its cell are, `run` how many steps it is for, `room` the length of the
    rows of a lattice that is slanted against the kernel. A banded window that is `still` has the same cells throughout the run.
    """

    banded: bool
    sizes: tuple[int, ...]
    taps: int = 16
    angles: tuple[int, ...] = ()
    images: int = 0
    sharpen: bool = False
    window: float = 1.08
    cells: float = CELLS
    run: int = 256
    room: float = 2.0
    still: bool = False

    @property
    def needed(self) -> float:
        """The fewest cells that a standard deviation may have."""
        return CELLS_SHARPENED if self.sharpen else CELLS

    @property
    def wide(self) -> bool:
        """Whether the mass moves far in a step, on a window that stands still."""
        return self.still and self.window >= WIDE

    @property
    def possible(self) -> bool:
        """Whether a plan that somebody tells of can be one of ours."""
        return (
            all(0 < size <= MOST_BANDED for size in self.sizes)
            and 0 < self.taps <= MOST_BANDED
            and sorted(set(self.angles)) == sorted(self.angles)
            and all(0 <= angle < len(self.sizes) for angle in self.angles)
            and 0 <= self.images <= MOST_IMAGES
            and 0 < self.run <= STILL_RUN
            and 1 <= self.window <= 2 * WIDEST
            and 1 <= self.cells <= 2 * FINEST
            and 0 < self.room <= 2 * ROOM
        )


def rounded_up(size: float, least: int = 64, parts: int = 4) -> int:
    """The next number of the form 2^k (1 + j/parts), from `least`: few shapes, few compilations."""
    power = least
    while 2 * power < size:
        power *= 2
    return next(power * (parts + j) // parts for j in range(parts + 1) if power * (parts + j) // parts >= size or j == parts)


def features(logs: np.ndarray) -> np.ndarray:
    """The standard deviation, in cells, of the narrowest feature along each axis (records, n), of logs (records, *sizes)."""
    out = []
    matters = logs > _top(logs) - 14.0
    for axis in range(1, logs.ndim):
        if logs.shape[axis] < 3:
            out.append(np.full(len(logs), np.inf))
            continue
        moved, used = np.moveaxis(logs, axis, 1), np.moveaxis(matters, axis, 1)[:, 1:-1]
        with np.errstate(invalid="ignore"):
            curvature = 2 * moved[:, 1:-1] - moved[:, :-2] - moved[:, 2:]
        curvature = np.where(used & np.isfinite(curvature), curvature, 0.0).reshape(len(logs), -1)
        out.append(1 / np.sqrt(np.maximum(curvature.max(axis=1), 1e-12)))
    return np.stack(out, axis=1)


def middle(logs: np.ndarray) -> np.ndarray:
    """Where the middle of the support is, as an index (records, n) from the centre."""
    used = logs > _top(logs) - SUPPORT
    out = []
    for axis in range(1, logs.ndim):
        line = used.sum(axis=tuple(a for a in range(1, logs.ndim) if a != axis))
        index = np.arange(logs.shape[axis]) - logs.shape[axis] // 2
        out.append(line @ index / line.sum(axis=1))
    return np.stack(out, axis=1)


def _top(logs: np.ndarray) -> np.ndarray:
    return logs.max(axis=tuple(range(1, logs.ndim)), keepdims=True)


def first_plan(model: Model, still: bool) -> Plan:
    """The plan before anything is known of the steps, the first of which may be on a window that stands `still`."""
    angles = tuple(model.state.index(name) for name in model.periodic)
    # What observations leave of a prior on two states is much smaller, so that the first runs are short.
    run = (STILL_RUN if still else LONGEST_RUN) if model.n == 1 else 2
    return Plan(False, (BASE[model.n],) * model.n, angles=angles, run=run)


def first_lattice(
    model: Model,
    prior: Any,
    log_factor: Callable[[np.ndarray], np.ndarray] | None,
    spread: np.ndarray | None = None,
    still: bool = False,
) -> tuple[Lattice, float]:
    """The prior, times a factor if there is one, on a lattice; and the logarithm of its mass.

    `spread` (n, n) is the covariance of the first kernel; a window, one that moves or one that stands `still`, needs cells that
    are small enough for it.
    """
    axes, log_prior, box = prior_box(model, prior)
    widest = np.full(model.n, np.inf)
    if spread is not None and model.n == 1 and not model.periodic:
        widest = (SPARE * COARSEST_STILL if still else COARSEST) / np.sqrt(np.diag(axes.T @ np.linalg.solve(spread, axes)))
    factor = log_factor or (lambda x: np.zeros(x.shape[:-1]))

    def log_density(x: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            logs = log_prior(x)
            logs = logs + np.where(np.isfinite(logs), factor(x), 0.0)
        if np.isnan(logs).any():
            raise InputError(f"{model.source}: prior: log_density is not a number at x = {x[np.isnan(logs)][0].tolist()}")
        return logs

    low, high = box
    point = high - low == 0
    turn = np.array([2 * np.pi if i in [model.state.index(p) for p in model.periodic] else np.inf for i in _order(model)])
    size = np.where(point, 1, 2 * BASE[model.n])
    for _ in range(60):
        whole = high - low >= turn * (1 - 1e-12)
        low, high = np.where(whole, (low + high - turn) / 2, low), np.where(whole, (low + high + turn) / 2, high)
        cell = np.where(point, 1.0, (high - low) / np.where(whole, size, size - 1))
        index = np.stack(np.meshgrid(*[np.arange(s) for s in size], indexing="ij"), axis=-1)
        logs = log_density((low + cell * index) @ axes.T)
        if not np.isfinite(logs.max()):
            raise InputError(f"{model.source}: prior: log_density is not finite anywhere; give a density")
        used = logs > logs.max() - SUPPORT
        first, last = low.copy(), high.copy()
        for d in range(model.n):
            line = np.flatnonzero(used.any(axis=tuple(a for a in range(model.n) if a != d)))
            if not point[d]:
                first[d] = low[d] + cell[d] * max(line[0] - 1, 0)
                last[d] = low[d] + cell[d] * min(line[-1] + 1, size[d] - 1)
                if whole[d] and line[0] == 0 and line[-1] == size[d] - 1:
                    first[d], last[d] = low[d], high[d]
        if np.any((last - first < 0.7 * (high - low)) & ~point):
            low, high = first, last
            continue
        fine = features(logs[None])[0] >= FINE[model.n] * CELLS
        if not np.all(fine | point | (size >= MOST[model.n])):
            size = np.where(fine | point, size, size * 2)
            continue
        enough = np.clip(np.ceil((high - low) / widest) + 1, size, MOST[model.n]).astype(int)
        if np.all(point | (enough == size)):
            break
        size = np.where(point, size, enough)
        widest = np.full(model.n, np.inf)
    size_half = size // 2
    basis = axes * cell
    mass = logs.max() + np.log(np.exp(logs - logs.max()).sum()) + np.log(abs(np.linalg.det(basis)))
    centre = axes @ (low + cell * size_half)
    return Lattice(jnp.asarray(logs - mass), jnp.asarray(centre), jnp.asarray(basis)), float(mass)


def _order(model: Model) -> list[int]:
    """The states in the order of the lattice's axes: angles first."""
    angles = [model.state.index(name) for name in model.periodic]
    return angles + [i for i in range(model.n) if i not in angles]


def log_prior(model: Model, prior: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The logarithm of the prior, as `first_lattice` takes it."""
    return prior_box(model, prior)[1]


def prior_box(model, prior):
    """Axes (columns), the prior's logarithm, and a box in their coordinates that holds all of it; no width: a point mass."""
    n, periodic = model.n, tuple(name in model.periodic for name in model.state)
    axes = np.eye(n)[:, _order(model)]
    if isinstance(prior, DensityPrior):
        function = numpy_function([prior.log_density], model)

        def log_prior(x):
            return function(x, model.start, model.theta())[..., 0]

        return axes, log_prior, _search(model, log_prior, axes)
    mixture = (
        GaussianMixture.gaussian(prior.mean, prior.cov, model.state, periodic)
        if isinstance(prior, GaussianPrior)
        else GaussianMixture(prior.weights, prior.means, prior.covs, model.state, periodic)
    )
    if len(mixture.weights) == 1 and not any(periodic):
        values, vectors = np.linalg.eigh(mixture.covs[0])
        axes = vectors if n > 1 else np.eye(1)
    spreads = np.einsum("ia,kij,ja->ka", axes, mixture.covs, axes)
    tiny = 1e-14 * np.maximum(np.abs(mixture.means @ axes) ** 2, 1e-6)
    if np.any(np.all(spreads <= tiny, axis=0)):
        if len(mixture.weights) > 1:
            raise InputError(f"{model.source}: prior: a mixture on a lattice needs positive variances in every coordinate")
        spreads = np.where(spreads <= tiny, 0.0, spreads)
        flat = spreads[0] == 0
        white = np.where(flat, 0.0, 1 / np.sqrt(np.where(flat, 1.0, spreads[0])))

        def log_degenerate(x):
            z = (x - mixture.means[0]) @ axes * white
            # With a cell of width one along a flat direction, the sum of the cells is the probability.
            return -0.5 * np.sum(z**2, axis=-1) - np.sum(np.log(np.sqrt(2 * np.pi) / white[~flat]))

        centre = mixture.means[0] @ axes
        return axes, log_degenerate, (centre - REACH * np.sqrt(spreads[0]), centre + REACH * np.sqrt(spreads[0]))
    if np.any(spreads <= tiny):
        raise InputError(f"{model.source}: prior: a component has no variance in some direction; give it a small one")
    centres = mixture.means @ axes
    reach = REACH * np.sqrt(spreads)
    return axes, mixture.log_density, ((centres - reach).min(axis=0), (centres + reach).max(axis=0))


def _search(model, log_prior, axes):
    """A box around a density of which nothing is known: angles have their circle, the rest is looked for up to 10^6."""
    count = {1: 4001, 2: 401, 3: 161, 4: 41}[model.n]
    angles = len(model.periodic)
    lines = [
        np.linspace(-np.pi, np.pi, count) if d < angles else np.sinh(np.linspace(-21.4, 21.4, count)) * 1e-3
        for d in range(model.n)
    ]
    mesh = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    with np.errstate(all="ignore"):
        logs = log_prior(mesh @ axes.T)
    logs = np.where(np.isnan(logs), -np.inf, logs)
    used = logs > logs.max() - SUPPORT
    low, high = np.zeros(model.n), np.zeros(model.n)
    for d in range(model.n):
        line = np.flatnonzero(used.any(axis=tuple(a for a in range(model.n) if a != d)))
        if d < angles:
            low[d], high[d] = -np.pi, np.pi
            continue
        if not len(line) or line[0] == 0 or line[-1] == count - 1:
            raise InputError(f"{model.source}: prior: log_density does not fall off within 10^6; it must be a density")
        low[d], high[d] = lines[d][line[0] - 1], lines[d][line[-1] + 1]
    return low, high


def adapted(
    model: Model,
    lattice: Lattice,
    cells: np.ndarray,
    plan: Plan,
    spreads: np.ndarray,
    maps: np.ndarray,
    info: Any,
    budget: int,
    drift: Callable[[Any], Any] | None = None,
) -> tuple[Lattice | None, Plan | None, np.ndarray]:
    """A plan for a run of intervals of several records, their lattices if they change, and how these were cut out (records, 2).

    The arrays of `lattice` and `info` have a leading axis of records, as have the narrowest features `cells` (records, n).  The
    kernels have covariances `spreads` and move by `maps` (K, parts, n, n).  With the `info` of a try: a better plan, or None
    where the try was good or nothing better can be had.  With `drift`, which tells by how much what is at x (..., 1) moves in
    each interval, the first try is one with a window that stands still, where there is a window.

    Raises InputError if a lattice needs more than `budget` bytes.
    """
    records = len(lattice.centre)
    same = np.tile(SAME, (records, 1))
    if info is not None:
        better = None if np.all(healthy(info, plan)) else _more(plan, info)
        if plan.still and better is not None and better.window > STILL_WIDEST:
            better = replace(plan, still=False, window=Plan.window)
        if better is None:
            return None, None, same
        plan = better
    else:
        # Mass does not move far for ever.
        window = Plan.window if plan.wide else plan.window
        plan = replace(plan, still=drift is not None, window=window, run=min(plan.run, LONGEST_RUN))
    one_line = model.n == 1 and not plan.angles and maps.shape[1] == 1
    if one_line and lattice.log_values[0].size > 1:

        def check(size: int) -> None:
            check_memory(model, (size,), plan.room, records, budget)

        banded = _banded(lattice, cells[:, 0], plan, np.sqrt(spreads[:, 0, 0, 0]), np.abs(maps[:, 0, 0, 0]), drift, check)
        if banded is not None:
            return banded
    sizes = plan.sizes if not plan.banded else (BASE[1],)
    run = plan.run
    if info is None:
        own = lattice.log_values.shape[1:] == sizes
        # Only a lattice of the plan's own sizes tells whether they were more than enough.
        if own:
            kernel = np.linalg.inv(spreads)
            kernel = np.einsum("rid,kpij,rjd->rkpd", lattice.basis, kernel, lattice.basis, optimize=True).max(axis=(0, 1, 2))
            roomy = cells.min(axis=0) > 3 * plan.needed
            roomy &= (2.4 * np.sqrt(kernel) < COARSEST) | plan.sharpen
            sizes = tuple(max(s // 2, BASE[model.n]) if room else s for s, room in zip(sizes, roomy, strict=True))
        if model.n > 1:
            run = 64 if own and np.prod(sizes) < 4e4 else 4
    angle = np.sqrt(max((spreads[:, :, i, i].max() for i in plan.angles), default=0.0))
    reach = REACH * angle / (2 * np.pi)
    images = max(0, int(np.ceil(reach - 0.5))) if plan.angles else 0
    check_memory(model, sizes, plan.room, records, budget)
    return None, replace(plan, banded=False, sizes=sizes, images=images, run=run, still=False), same


def check_memory(model: Model, sizes: tuple[int, ...], room: float, records: int, budget: int) -> None:
    """Raise InputError if a step on lattices of these sizes, one a record, needs more than `budget` bytes."""
    # The density, its points, h, the rows that are spread, and what a run of steps keeps.
    needed = 8.0 * records * np.prod(sizes, dtype=float) * (ARRAYS + 2 * model.m + 6 * room)
    if needed > budget:
        lattice = " x ".join(map(str, sizes))
        raise InputError(
            f"option memory: {model.source} needs a lattice of {lattice} points, {needed / 2**20:.0f} MiB, and has "
            f"{budget / 2**20:.0f}; set memory to more MiB, take shorter intervals, or name another method (general-direct)"
        )


def free_memory() -> int:
    """Half of the bytes that the machine has free."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            free = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
        return free * 512
    except (OSError, StopIteration, ValueError):
        return 2**31


def healthy(info: Any, plan: Plan) -> Any:
    """Which steps kept every bound; traced by JAX or not."""
    return well(info.log_likelihood_increment, info.health, plan)


def well(increment: Any, health: Mapping[str, Any], plan: Plan) -> Any:
    """The same, from what they added to the log-likelihood and their health."""
    edge = EDGE_SHARPENED if plan.sharpen else _edge(plan)
    return (
        (abs(increment) < np.inf)
        & (health["edge_mass"] < edge)
        & (health["resolution"] > plan.needed)
        & (health["quadrature_error"] < (QUADRATURE_STILL if plan.still else QUADRATURE))
    )


def _edge(plan: Plan) -> float:
    """How much mass may stand at the edges of a window."""
    return EDGE_STILL if plan.still else EDGE


def _more(plan: Plan, info: Any) -> Plan | None:
    """A larger window or a finer cell, whichever was missing; None at the limit."""
    info = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), info)
    if not plan.banded:
        most = MOST[len(plan.sizes)]
        *need, taken = np.nanmax(np.where(np.isfinite(info.need), info.need, 2.0), axis=0)
        if taken > plan.room:
            return replace(plan, room=float(np.ceil(1.1 * taken))) if taken < ROOM else None
        need = np.array(need)
        if np.all(info.health["resolution"] > plan.needed) and np.all(np.isfinite(info.log_likelihood_increment)):
            if plan.sharpen and not np.all(info.health["edge_mass"] < EDGE_SHARPENED):
                # The tails that sharpening loses matter here: resolve the kernel instead.
                return replace(plan, sharpen=False)
            if not plan.sharpen and np.any(info.health["quadrature_error"] >= QUADRATURE):
                return replace(plan, sharpen=True)
        elif not plan.sharpen:
            # What a lattice that is too coarse says of the kernel may be far off; its own features come first.
            own = np.isfinite(info.need[:, :-1])
            need = np.nanmax(np.where(own, CELLS / info.health["resolution"][:, None], 2.0), axis=0)
        least = 32 if len(plan.sizes) == 3 else 64
        need = np.clip(1.1 * need if need.max() > 1 else np.full(len(plan.sizes), 1.5), None, 2.0)
        sizes = tuple(
            min(most, max(s, rounded_up(s * f, least))) if f > 1.1 else s for s, f in zip(plan.sizes, need, strict=True)
        )
        return None if sizes == plan.sizes else replace(plan, sizes=sizes)
    finite = np.all(np.isfinite(info.log_likelihood_increment))
    coarse = not np.all(info.health["resolution"] > CELLS)
    narrow = not np.all(info.health["edge_mass"] < _edge(plan)) or not finite
    if plan.sizes[0] >= MOST_BANDED or plan.cells > FINEST or plan.window > WIDEST:
        return None
    return replace(plan, cells=plan.cells * (2 if coarse else 1), window=plan.window * (1.6 if narrow else 1))


def _banded(
    lattice: Lattice,
    cells: np.ndarray,
    plan: Plan,
    deviation: np.ndarray,
    maps: np.ndarray,
    drift: Callable[[Any], Any] | None,
    check: Callable[[int], None],
) -> tuple[Lattice | None, Plan, np.ndarray] | None:
    """The windows and the cells of a banded run, or None where summing over all pairs is cheaper; `check` may refuse a size."""
    logs = lattice.log_values
    count = logs.shape[1]
    cell = np.abs(lattice.basis[:, 0, 0])
    # A window that moves along grows with the flow; a kernel between points that stand still has the variance map Sigma.
    along = 1 / np.sqrt(maps) if plan.still else np.concatenate([[1.0], np.cumprod(maps)])[: len(deviation)]
    growth = along / deviation
    coarsest = COARSEST_STILL if plan.still else COARSEST
    widest = np.minimum(coarsest / growth.max(), cells * cell / plan.cells / (NARROWER if plan.still else 1.0))
    if plan.still:
        # The windows of all records stand on one lattice.
        widest = np.full(len(cell), widest.min())
    well = (0.8 * widest <= cell) & (cell <= widest)
    if plan.still:
        well = np.full(len(cell), np.all(well & (cell == cell[0])))
    new_cell = np.where(well, cell, SPARE * widest)
    used = logs > _top(logs) + np.log(0.1 * _edge(plan))
    first, last = used.argmax(axis=1), count - 1 - used[:, ::-1].argmax(axis=1)
    middle, span = (first + last) // 2, (last - first + 1) * cell
    enough, taps = REACH / (new_cell.min() * growth.min()), 16
    if plan.still:
        # The kernel reaches as far as what drifts goes, but for less than `_edge`.
        ends = lattice.centre + cell[:, None] * (np.stack([first, last], axis=1) - count // 2)
        drifting = np.abs(drift(ends[..., None])).max() / new_cell.min() if drift else 0.0
        taps = rounded_up(max(enough, LEAST_REACH / REACH * enough + drifting), 4)
        middle = _aligned(lattice, middle, new_cell[0])
    while not plan.still and taps < enough:
        taps *= 2
    wanted = plan.window * (span / new_cell).max() + 8
    # Runs on a window that stands still take the part of it that they need, and its compilation takes longer than they do; but a
    # live filter takes all of it, at every step.
    many = len(logs) > 1
    size = rounded_up(wanted + 2 * STILL_ROOM, BASE[1], 1 if many else 2) if plan.still else rounded_up(wanted)
    own = plan.banded and plan.sizes[0] >= size >= ((0.5 if many else 0.8) if plan.still else 0.6) * plan.sizes[0]
    size = plan.sizes[0] if own else size
    pairs = max(BASE[1], rounded_up(span.max() / (COARSEST * deviation.min())))
    if size * (12 + 0.2 * taps) > 3 * pairs**2:
        return None
    check(size)
    if plan.still and own and size == count and np.all(well) and np.all(middle % 1 == 0):
        # Its steps lay the windows over the mass by themselves; records from other groups may stand between the points.
        return None, replace(plan, taps=taps), np.tile(SAME, (len(logs), 1))
    cuts = np.stack([middle, new_cell / cell], axis=1)
    window = _resampled(logs, cuts[:, 0], cuts[:, 1], size)
    centre = lattice.centre + lattice.basis[:, :, 0] * (cuts[:, :1] - count // 2)
    lattice = Lattice(window, centre, lattice.basis * cuts[:, 1, None, None])
    return lattice, replace(plan, banded=True, sizes=(size,), taps=taps), cuts


def _aligned(lattice: Lattice, middle: np.ndarray, new_cell: float) -> np.ndarray:
    """The points, `new_cell` apart, with that at the index `middle[0]` of the first lattice among them, that are nearest to an
    index (records,) of each, as indices of each."""
    if len(middle) == 1:
        return middle
    centre, cell, half = lattice.centre[:, 0], lattice.basis[:, 0, 0], lattice.log_values.shape[1] // 2
    at = centre + cell * (middle - half)
    at = at[0] + new_cell * np.rint((at - at[0]) / new_cell)
    index = (at - centre) / cell + half
    # Points of lattices that are one but for rounding are the same.
    return np.where(np.abs(index - np.rint(index)) < 1e-6, np.rint(index), index)


def composed(first: np.ndarray, second: np.ndarray, size: int) -> np.ndarray:
    """The cuts (records, 2) that do what two do one after the other; `size` is that of the lattice between them."""
    middle, ratio = first.T
    both = np.stack([middle + ratio * (second[:, 0] - size // 2), ratio * second[:, 1]], axis=1)
    return np.where(ratio[:, None] == 0, second, np.where(second[:, 1:] == 0, first, both))


def cut_out(lattice: Lattice, cut: np.ndarray, size: int) -> Lattice:
    """The density at the indices middle + ratio (j - size // 2), j < `size`, of a lattice of one state; pure, for gradients.

    `cut` is (middle, ratio); where densities are below 1e-11 of the maximum, logarithms are interpolated.
    """
    middle, ratio = cut
    count = lattice.log_values.size
    at = middle + ratio * (np.arange(size) - size // 2)
    inside = (at >= 0) & (at <= count - 1)
    top = jax.lax.stop_gradient(jnp.max(lattice.log_values))
    value = jnp.asarray(dirichlet(at[:, None] - np.arange(count), count)) @ jnp.exp(lattice.log_values - top)
    left = np.clip(np.floor(at), 0, count - 2).astype(int)
    share = np.clip(at - left, 0.0, 1.0)
    logs = jnp.maximum(lattice.log_values, top - 800.0)
    tail = (1 - share) * logs[left] + share * logs[left + 1]
    tail = jnp.where(tail <= top - 799.0, -jnp.inf, tail)
    good = value > 1e-11
    window = jnp.where(inside, jnp.where(good, jnp.log(jnp.where(good, value, 1.0)) + top, tail), -jnp.inf)
    return Lattice(window, lattice.centre + lattice.basis[:, 0] * (middle - count // 2), lattice.basis * ratio)


def _resampled(logs: np.ndarray, middle: np.ndarray, ratio: np.ndarray, size: int) -> np.ndarray:
    """The densities (records, count) at the indices middle + ratio (j - size // 2), j < size.

    Trigonometric interpolation is exact where the density is resolved; its rounding would drown the far tails, which are
    interpolated in the logarithm.
    """
    count, index = logs.shape[1], np.arange(size) - size // 2
    at = middle[:, None] + ratio[:, None] * index
    inside = (at >= 0) & (at <= count - 1)
    rows = np.flatnonzero((ratio != 1.0) | (middle % 1 != 0.0))
    if not len(rows):
        return np.where(inside, np.take_along_axis(logs, np.clip(at, 0, count - 1).astype(int), axis=1), -np.inf)
    left = np.clip(np.floor(at), 0, count - 2).astype(int)
    share = np.clip(at - left, 0.0, 1.0)
    top = _top(logs)
    held = np.maximum(logs, top - 800.0)
    window = (1 - share) * np.take_along_axis(held, left, axis=1) + share * np.take_along_axis(held, left + 1, axis=1)
    window = np.where(window <= top - 799.0, -np.inf, window)
    value = _trigonometric(np.exp(logs[rows] - top[rows]), middle[rows, None], ratio[rows, None], size)
    good = value > 1e-11
    window[rows] = np.where(good, np.log(np.where(good, value, 1.0)) + top[rows], window[rows])
    return np.where(inside, window, -np.inf)


def _trigonometric(values: np.ndarray, middle: np.ndarray, ratio: np.ndarray, size: int) -> np.ndarray:
    """The trigonometric interpolants at the indices middle + ratio (j - size // 2), by Bluestein's chirp transform."""
    count = values.shape[1]
    frequency = np.fft.fftfreq(count) * count
    spectrum = np.fft.fft(values) * np.exp(2j * np.pi * frequency * middle / count)
    spectrum = np.fft.fftshift(spectrum, axes=1) / count
    k = np.sort(frequency)
    j = np.arange(size) - size // 2
    angle = np.pi * ratio / count
    # 2 j k = j^2 + k^2 - (j - k)^2 turns the sum over k into a convolution.
    distance = np.arange(j[0] - k[-1], j[-1] - k[0] + 1)
    length = int(2 ** np.ceil(np.log2(count + len(distance))))
    product = np.fft.fft(spectrum * np.exp(1j * angle * k**2), length) * np.fft.fft(np.exp(-1j * angle * distance**2), length)
    convolved = np.fft.ifft(product)[:, count - 1 : count - 1 + size]
    return np.real(convolved * np.exp(1j * angle * j**2))
