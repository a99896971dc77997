"""Where the lattice of a density stands, how fine it is and how a run of steps is taken: all of it from the prior and the data.

A lattice must hold the mass and resolve the narrowest feature.  The first is seen in what lies beyond each of its layers, the
second in the spectrum along each axis: both are measured on the density itself, at the beginning of every run of steps and,
by the health of the steps, within it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.filters import _lattice_choice as choice
from zakai.filters._splitting import CHIN, STRANG, Scheme
from zakai.kolmogorov.comoving import Field, axes_of
from zakai.kolmogorov.finite_volume import TERMS
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

LEAST = {1: 32, 2: 24, 3: 20, 4: 16}
MOST = {1: 4096, 2: 512, 3: 128, 4: 48}
RUNS = {1: 512, 2: 64, 3: 16, 4: 8}
BRIEF = 4  # a run of the characteristics: in how many parts an interval is stepped differs from one to the next
SHORTEST = 8  # a run that must be shorter than this asks for a lattice that is laid anew in every step
MOST_PARTS = 4096
RESOLVED = 1e-3  # share of a density in its highest frequencies below which it is seen, if not yet resolved
MOST_SPLITS = 4096
MOST_POINTS = 2**20  # of lattices whose flow is looked at together
FEW_POINTS = 128  # of a lattice that is small
FEW = {1: 128, 2: 8, 3: 4, 4: 4}  # parts of an interval beyond which the lattice had better follow the flow
SPARE = 1.25  # how much wider than its density a window is, and
WORST = {1: 8.0, 2: 3.0, 3: 2.0, 4: 2.0}  # how much more of both a run may ask for before it is cut into shorter ones
MOST_ROOM = 1e3
LONGEST_GAP = 2**40  # parts of an interval, of which nobody lives to see the end
CALMER = 0.5  # of the error of splitting that is allowed, below which a run may be taken with fewer transitions
FINER = 1.15  # how much finer than the density needs: what may change within a run
FOLLOWED = 1.9  # cells that a deviation has, and
NEARER = 0.85  # of REACH, for a lattice that was laid where the reading will put the mass
TURN = 1.5  # by how much the flow may stretch, as an exponent, along a part of a path
REACH = 6.5  # deviations on each side that a lattice holds that is laid anew in every step


class Shape(NamedTuple):
    """What a step is compiled for: `sizes` of the lattice and the way to take it.

    An interval is split in `splits`, each of them by Strang's scheme or, with `chin`, by Chin's, and every transition of these is
    stepped in `parts`: one, 0 for what the Room says, or a number that JAX can differentiate.  `order` is that of the time
    stepping, 2 or 4.  With `follow` the basis moves with the flow and is laid anew in every step; with `cross` the noise may
    couple axes of the lattice.  With `tabled` the lattice stands still and the transition is a known matrix.  `operator` is
    "spectral", "finite-volume", of which `order` is the number of terms of its series, or "characteristics".
    """

    sizes: tuple[int, ...]
    splits: int = 1
    parts: int = 1
    order: int = 2
    follow: bool = False
    cross: bool = False
    tabled: bool = False
    operator: str = "spectral"
    chin: bool = False
    aligned: bool = False
    quiet: tuple[int, ...] = ()

    @property
    def scheme(self) -> Scheme:
        """How the likelihood of increments is split from the transition."""
        return CHIN if self.chin else STRANG

    @property
    def possible(self) -> bool:
        """Whether a shape that somebody tells of can be one of ours."""
        return (
            0 <= self.splits <= MOST_SPLITS
            and 0 <= self.parts <= LONGEST_GAP
            and self.order in (2, 4, *TERMS)
            and self.operator in ("spectral", "finite-volume", "characteristics")
        )


class Room(NamedTuple):
    """What a step is told and not compiled for; `wider` and `finer` multiply SPARE and FINER for a run of `run` steps.

    `splitting` is the error of splitting that is allowed, infinite where `splits` is the user's.
    """

    tolerance: Any
    wider: Any = 1.0
    finer: Any = 1.0
    run: Any = 256.0
    splitting: Any = np.inf
    splits: Any = 1.0
    parts: Any = 1.0

    @property
    def counts(self) -> tuple[Any, Any, Any]:
        """What changes a run though the lattice stays."""
        return self.run, self.splits, self.parts

    @property
    def reach(self) -> Any:
        """The deviations on each side of a lattice that is laid anew in every step."""
        return REACH * self.wider

    @property
    def allowed(self) -> tuple[Any, Any, Any, Any, Any]:
        """The most that may be of aliasing, of the mass in the outermost layers, of the error in time, of what is lost and of the
        error of splitting."""
        return 0.1 * self.tolerance, 0.01 * self.tolerance, 0.1 * self.tolerance, self.tolerance, self.splitting

    @property
    def possible(self) -> bool:
        """Whether a room that somebody tells of can be one of ours."""
        most = {"run": max(RUNS.values()), "splits": MOST_SPLITS, "parts": LONGEST_GAP}
        whole = all(1 <= (count := float(getattr(self, name))) <= least and count % 1 == 0 for name, least in most.items())
        room = all(1 <= part <= MOST_ROOM for part in (self.wider, self.finer))
        return whole and room and bool(0 < self.tolerance < 1 and 0 < self.splitting)


@dataclass(frozen=True)
class Plan:
    """How a run of steps is taken: the fields of a Shape and of a Room; with `fixed` the counts are compiled."""

    sizes: tuple[int, ...]
    tolerance: float
    splits: int = 1
    parts: int = 1
    order: int = 2
    run: int = 256
    follow: bool = False
    cross: bool = False
    tabled: bool = False
    operator: str = "spectral"
    chin: bool = False
    wider: float = 1.0
    finer: float = 1.0
    splitting: float = np.inf
    fixed: bool = False
    aligned: bool = False
    quiet: tuple[int, ...] = ()

    @classmethod
    def of(cls, shape: Shape, room: Room) -> Plan:
        """The plan that was divided into these; of the records of a batch that which has most room."""
        told = {name: max(np.ravel(part).tolist()) for name, part in room._asdict().items()}
        counts = {name: int(told[name]) for name in ("run", "splits", "parts")}
        return cls(**{**shape._asdict(), **told, **counts})

    @property
    def shape(self) -> Shape:
        """The static part."""
        # Where the splits are not the user's they may change with every run, but mostly there is one, and on a small lattice a
        # loop is a good part of the time.
        given = self.fixed or self.splitting == np.inf or (self.splits == 1 and np.prod(self.sizes) <= FEW_POINTS)
        splits = self.splits if given else 0
        if self.tabled:
            return Shape(self.sizes, splits, tabled=True, chin=self.chin)
        parts = self.parts if self.fixed or self.parts == 1 else 0
        shape = Shape(self.sizes, splits, parts, self.order, self.follow, self.cross, False, self.operator, self.chin)
        return shape._replace(aligned=True, quiet=self.quiet) if self.aligned and not self.follow else shape

    @property
    def steps(self) -> int:
        """In how many transitions an interval is taken."""
        return self.splits * (len(self.scheme.shares) - 1)

    @property
    def scheme(self) -> Scheme:
        """How the likelihood of increments is split from the transition."""
        return self.shape.scheme

    @property
    def room(self) -> Room:
        """The part that may change without a compilation."""
        counts = float(self.run), self.splitting, float(self.splits), float(self.parts)
        return Room(self.tolerance, self.wider, self.finer, *counts)

    @property
    def aliasing(self) -> float:
        """The largest share of the density that may be at the highest frequency."""
        return self.room.allowed[0]

    @property
    def edge(self) -> float:
        """The largest share of the mass that may be in the outermost layers."""
        return self.room.allowed[1]

    @property
    def stepping(self) -> float:
        """The largest error in time of one interval."""
        return self.room.allowed[2]


def rounded_up(size: float, n: int) -> int:
    """The next even size out of few: few shapes, few compilations."""
    sizes = (LEAST[n] * 2**power * quarters // 4 // 2 * 2 for power in range(20) for quarters in (4, 6))
    return next(candidate for candidate in sizes if candidate >= size)


class Extent(NamedTuple):
    """Of densities on lattices, along each axis (records, n): the first and the last index that matter, and the share of all
    frequencies that does."""

    first: np.ndarray
    last: np.ndarray
    band: np.ndarray


def extent(values: np.ndarray, aliasing: float, edge: float) -> Extent:
    """What matters of the values (records, *sizes): all but a share `edge` of the mass on each side of an axis, and all
    frequencies that hold more than the share `aliasing`."""
    n = values.ndim - 1
    total = values.sum(axis=tuple(range(1, n + 1)))[:, None]
    columns = []
    for d in range(1, n + 1):
        others = tuple(a for a in range(1, n + 1) if a != d)
        marginal = values.sum(axis=others) / total
        first = (np.cumsum(marginal, axis=1) < edge).sum(axis=1)
        last = values.shape[d] - 1 - (np.cumsum(marginal[:, ::-1], axis=1) < edge).sum(axis=1)
        above = np.abs(np.fft.rfft(values, axis=d)).sum(axis=others) / total > aliasing
        frequencies = above.shape[1]
        highest = np.where(above.any(axis=1), frequencies - np.argmax(above[:, ::-1], axis=1), 0)
        columns.append((first, last, np.minimum(highest / (frequencies - 1), 1.0)))
    return Extent(*(np.stack(part, axis=1) for part in zip(*columns, strict=True)))


def measured(fields: Field, plan: Plan) -> Extent | None:
    """What matters of densities, one a record; nothing is looked at where the lattice is laid anew in every step."""
    return None if plan.follow else extent(np.asarray(fields.values), plan.aliasing / 10, plan.edge / 10)


def coarser(band: Any, plan: Plan) -> Any:
    """How many times as wide a cell may be where the share `band` of the frequencies matters."""
    # What the highest frequency still holds was not resolved.
    return np.where(band > 0.98, 0.7, 1 / (FINER * np.maximum(band, 0.1))) / plan.finer


def fitted(
    fields: Field, measures: Extent | None, plan: Plan, check: Callable[[tuple[int, ...]], None]
) -> tuple[np.ndarray, Plan]:
    """How to lay densities, one a record, on lattices of one size with the same axes as theirs: cuts (records, 2, n), the middle
    as an index from the centre and the cell in cells; and the plan with the sizes."""
    records, *shape = fields.values.shape
    n, sizes = len(shape), np.array(shape)
    if plan.follow or measures is None:
        wanted = np.array([rounded_up(2 * REACH * plan.wider * FOLLOWED * plan.finer, n)] * n)
        plan = replace(plan, sizes=tuple(int(s) for s in np.minimum(wanted, MOST[n])))
        check(plan.sizes)
        cut = np.stack([np.zeros(n), np.maximum(sizes / plan.sizes, 1.0)])
        return np.tile(cut, (records, 1, 1)), plan
    first, last, band = measures
    ratio = coarser(band, plan)
    span = (last - first + 3) * SPARE * plan.wider
    wanted = np.array([rounded_up(s, n) for s in (span / ratio).max(axis=0)])
    wanted = np.minimum(wanted, MOST[n])
    wanted = np.where((wanted <= sizes) & (wanted > 0.7 * sizes), sizes, wanted)
    plan = replace(plan, sizes=tuple(int(s) for s in wanted))
    check(plan.sizes)
    middle = 0.5 * (first + last) - sizes // 2
    # The size is given: what there is too much of goes to the window and to the cells alike.
    least = span / wanted
    ratio = np.where(least > ratio, least, np.sqrt(ratio * least))
    # A lattice that is about as good is kept, since to lay one anew has an error of its own.
    good = (np.abs(middle) < 0.05 * sizes) & (np.abs(np.log(ratio)) < 0.15) & (wanted == sizes)
    return np.where(good[:, None], [[0.0], [1.0]], np.stack([middle, ratio], axis=1)), plan


def first_field(
    model: Model, prior: Any, log_factor: Callable[[np.ndarray], np.ndarray] | None, plan: Plan
) -> tuple[Field, Plan, float]:
    """The prior, times a factor if there is one, on a lattice of its own; the plan for it; and the logarithm of its mass."""
    axes, log_prior, box = choice.prior_box(model, prior)
    low, high = box
    if np.any(high <= low):
        raise InputError(f"{model.source}: prior: a variance is zero; yau-yau needs a density in every coordinate")
    factor = log_factor or (lambda x: np.zeros(x.shape[:-1]))
    n = model.n
    sizes: tuple[int, ...] = (rounded_up({1: 256, 2: 96, 3: 48, 4: 32}[n], n),) * n
    for _ in range(60):
        size = np.array(sizes)
        cell = (high - low) / size
        basis, centre = axes * cell, axes @ (0.5 * (low + high))
        index = np.stack(np.meshgrid(*axes_of(sizes), indexing="ij"), axis=-1)
        points = centre + index @ basis.T
        with np.errstate(all="ignore"):
            logs = log_prior(points)
            logs = logs + np.where(np.isfinite(logs), factor(points), 0.0)
        if np.isnan(logs).any():
            raise InputError(f"{model.source}: prior: log_density is not a number at x = {points[np.isnan(logs)][0].tolist()}")
        top = logs.max()
        if not np.isfinite(top):
            raise InputError(f"{model.source}: prior: log_density is not finite anywhere; give a density")
        values = np.exp(logs - top)
        first, last, band = (part[0] for part in extent(values[None], plan.aliasing / 10, plan.edge / 100))
        used = (last - first + 1) / size
        if np.any(used < 0.55):
            middle = low + cell * (0.5 * (first + last) + 0.5)
            half = 0.5 * cell * (last - first + 3) * 1.15
            low, high = np.maximum(low, middle - half), np.minimum(high, middle + half)
            continue
        if np.any(band > 0.95) and np.all(size < MOST[n]):
            sizes = tuple(min(rounded_up(s + 1, n), MOST[n]) if b > 0.95 else s for s, b in zip(sizes, band, strict=True))
            continue
        break
    mass = values.sum()
    field = Field(values / mass, centre, basis)
    log_mass = float(top + np.log(mass) + np.log(abs(np.linalg.det(basis))))
    return field, replace(plan, sizes=values.shape), log_mass


def healthy(info: Any) -> Any:
    """Which steps kept every bound; traced by JAX or not."""
    return (abs(info.log_likelihood_increment) < np.inf) & (info.health["missed"] < 1.0)


def more(plan: Plan, info: Any) -> Plan | None:
    """A better plan for the same run; None where nothing better can be had.

    The cells come first: of a density that they do not resolve the other figures say nothing.
    """
    n, health = len(plan.sizes), {name: np.where(np.isfinite(figure), figure, 1.0) for name, figure in info.health.items()}
    lost = ~np.isfinite(info.log_likelihood_increment)
    alias, edge = (np.where(lost, 1.0, health[name]).max() for name in ("aliasing", "edge_mass"))
    error, cut = health["time_error"].max(), health["lost"].max()
    # The spectrum of a Gaussian falls as exp(-(pi s)^2 / 2), s its deviation in cells.
    finer = np.sqrt(np.log(plan.aliasing) / np.log(np.clip(alias, 1e-12, 0.3)))
    finer = max(finer, 1.2 if cut >= plan.tolerance else 1.0) if finer > 1 or cut >= plan.tolerance else 1.0
    if plan.operator == "characteristics":
        if error >= plan.stepping and finer == 1:
            parts = int(np.ceil(plan.parts * np.clip((error / plan.stepping) ** (1 / 3), 1.1, 4.0)))
            return replace(plan, parts=parts) if plan.parts < MOST_PARTS else None
    elif plan.operator == "finite-volume":
        # Steps in time cost no accuracy: what is left is the error of the cells, of second order.
        if finer == 1 and error >= plan.stepping:
            finer = np.clip((error / plan.stepping) ** 0.5, 1.2, 3.0)
    elif error > 1e-2 or (error >= plan.stepping and finer == 1):
        # An unstable step spoils all other figures.
        if plan.parts >= MOST_PARTS:
            return None
        if plan.order == 2:
            return replace(plan, order=4)
        if not plan.follow and plan.parts >= FEW[n]:
            return replace(plan, follow=True, parts=1)
        parts = 2.0 ** np.ceil(np.log2(np.clip((error / plan.stepping) ** 0.25, 2, 8)))
        return replace(plan, parts=int(plan.parts * parts))
    apart = health["splitting"].max()
    # One that leaves more of an error than there is density makes features of its own.
    if apart >= plan.splitting and (finer == 1 or (apart > 1 and alias < RESOLVED)):
        if plan.splits >= MOST_SPLITS:
            return None
        if not plan.chin and plan.operator != "characteristics":
            return replace(plan, chin=True, parts=1)
        fewest = (apart / plan.splitting) ** (1 / plan.scheme.order)
        splits = plan.splits * 2 ** int(np.ceil(np.log2(np.clip(fewest, 2, 64))))
        return replace(plan, splits=min(splits, MOST_SPLITS), parts=1)
    if finer == 1 and edge < plan.edge:
        return None
    # What cells do not resolve is everywhere, at the edges too; and further out a drift may be steep.
    narrow = edge >= plan.edge and (finer == 1 or edge > alias)
    plan = replace(plan, finer=plan.finer * min(1.1 * finer, 3.0), wider=plan.wider * (1.35 if narrow else 1.0))
    room = 2.0 if plan.operator == "characteristics" else 4.0 if plan.follow or plan.tabled else 1.0
    if plan.operator == "finite-volume":
        # The cells must be small for a single step already: a shorter run is no way out.
        room = 64.0
        if not narrow and min(plan.sizes) == MOST[n]:
            return None
    if plan.finer * plan.wider < WORST[n] * room:
        return plan
    shorter = plan.run // 4
    if plan.follow or (plan.operator == "finite-volume" and shorter < SHORTEST):
        return None
    return replace(plan, run=max(shorter, SHORTEST), finer=1.0, wider=1.0, follow=shorter < SHORTEST, order=4)


def relaxed(plan: Plan, run: int, follow: bool, coarser: float) -> Plan:
    """The plan for the next run: what the last one needed more of is given back step by step.

    `run` and `follow` are those that a filter begins with; `coarser` is what the error of splitting would have come to with the
    next fewer transitions.
    """
    fewer = coarser < CALMER * plan.splitting < np.inf
    return replace(
        plan,
        run=min(run, 2 * plan.run),
        follow=follow or (plan.follow and plan.run < 4 * SHORTEST),
        wider=max(1.0, plan.wider / 1.2),
        finer=max(1.0, plan.finer / 1.2),
        parts=max(1, plan.parts * 2 // 3 if plan.operator == "characteristics" else plan.parts // 2),
        splits=max(1, plan.splits // 2) if fewer else plan.splits,
        chin=plan.chin and not (fewer and plan.splits == 1),
    )


def timed(model: Model, plan: Plan, intervals: Any, rows: slice, fields: Field, ratio: np.ndarray) -> Plan:
    """The plan with what the coefficients say: whether the noise couples axes of the lattices, and in how many parts and by which
    formula an interval is stepped; `ratio` (records, n) says of how many of their cells the new ones will be."""
    times = np.unique(np.linspace(intervals.start[rows][0], intervals.stop[rows][-1], 5))
    basis, theta = np.asarray(fields.basis) * ratio[:, None, :], model.theta()
    inverse = np.linalg.inv(basis)
    if model.n > 1 and not plan.cross:
        G = numpy_function(model.covariance, model, (model.n, model.n))(np.zeros(model.n), times, theta)
        spread = np.abs(np.einsum("rij,kjl,rml->rkim", inverse, np.broadcast_to(G, (len(times), model.n, model.n)), inverse))
        diagonal = np.einsum("rkii->rk", spread)
        couples = (spread.sum(axis=(2, 3)) - diagonal) > 1e-12 * diagonal
        plan = replace(plan, cross=plan.follow or bool(couples.any()))
    if model.n > 1:
        aligned = plan.operator == "spectral" and not np.any(basis[:, ~np.eye(model.n, dtype=bool)])
        quiet = tuple(d for d in range(model.n) if aligned and model.covariance.row(d).is_zero_matrix)
        plan = replace(plan, aligned=aligned, quiet=quiet)
    tau = (intervals.stop[rows] - intervals.start[rows]).max() / plan.steps
    if plan.operator == "characteristics":
        rate = _turning(model, np.asarray(fields.centre), times)
        least = int(np.ceil(tau * rate / TURN)) if 0 < tau * rate < TURN * MOST_PARTS else 1
        return replace(plan, parts=max(least, plan.parts))
    fastest = crossing = 0.0
    many = max(1, MOST_POINTS // int(np.prod(fields.values.shape[1:])))
    for begin in range(0, len(basis), many):
        some = slice(begin, begin + many)
        part = Field(np.asarray(fields.values)[some], np.asarray(fields.centre)[some], basis[some])
        fast, far = _speeds(model, part, ratio[some], times, plan.follow)
        fastest, crossing = max(fastest, fast), max(crossing, far)
    if not np.isfinite(fastest + crossing):
        return plan
    if plan.operator == "finite-volume":
        least, most = TERMS
        rate = tau * (crossing / np.pi + _leaving(model, basis, times))
        parts = 2 ** int(np.ceil(np.log2(max(rate / TERMS[most], 1.0))))
        return replace(plan, parts=parts, order=least if parts == 1 and rate <= TERMS[least] else most)
    parts = 2 ** int(np.ceil(np.log2(max(tau * crossing / 2.5, tau * fastest / (30 * plan.stepping) ** 0.2, 1.0))))
    if plan.follow:
        return replace(plan, parts=parts)
    if parts > FEW[model.n]:
        return replace(plan, follow=True, order=4, parts=1, cross=model.n > 1)
    order = 2 if parts == 1 and (tau * fastest) ** 3 < plan.stepping and tau * crossing < 0.5 else 4
    return replace(plan, order=order, parts=parts)


def _speeds(model: Model, fields: Field, ratio: np.ndarray, times: np.ndarray, follow: bool) -> tuple[float, float]:
    """Of the flow around the mean, which takes the lattices of `fields` with it: its root mean square in deviations, and its
    largest sum over the axes in cells, times pi; a unit of time, the worst of all records and of the first and the last time."""
    n, theta, back = model.n, model.theta(), np.swapaxes(np.linalg.inv(fields.basis), 1, 2)
    weights = fields.values.reshape(len(ratio), -1)
    weights = np.where(weights > 1e-11 * weights.max(axis=1, keepdims=True), weights, 0.0)
    weights, matters = weights / weights.sum(axis=1, keepdims=True), (weights > 0)[..., None]
    index = np.stack(np.meshgrid(*axes_of(fields.values.shape[1:]), indexing="ij"), axis=-1).reshape(-1, n) / ratio[:, None]
    points = fields.centre[:, None] + index @ np.swapaxes(fields.basis, 1, 2)
    function = numpy_function(model.drift, model)
    ends = times[[0, -1]] if model.t in model.drift.free_symbols else times[:1]
    with np.errstate(all="ignore"):
        flow = np.where(matters, np.stack([function(points, t, theta) @ back for t in ends]), 0.0)
    flow = flow - np.einsum("rp,rpi->ri", weights, flow[0])[:, None]
    apart = index - np.einsum("rp,rpi->ri", weights, index)[:, None]
    variance = np.einsum("rp,rpi->ri", weights, apart**2)
    if follow:
        # The basis takes the part that is affine, and leaves the growth by diffusion.
        weighted = np.swapaxes(apart * weights[..., None], 1, 2)
        slopes = np.linalg.solve(weighted @ apart, weighted @ flow.mean(axis=0))
        G = numpy_function(model.covariance, model, (n, n))(np.zeros(n), times[0], theta)
        growth = 0.5 * np.diagonal(np.swapaxes(back, 1, 2) @ G @ back, axis1=1, axis2=2) / variance
        flow = flow - apart @ slopes - apart * growth[:, None]
    flow = np.where(matters, flow, 0.0)
    spread = np.einsum("rp,trpi->ri", weights, flow**2) / 2
    fastest = np.sqrt((spread / np.maximum(variance, 1e-12)).max())
    return float(fastest), float(np.pi * np.abs(flow).sum(axis=-1).max())


def _turning(model: Model, centres: np.ndarray, times: np.ndarray) -> float:
    """The largest absolute eigenvalue of the derivative of the drift at the centres (records, n)."""
    n, theta = model.n, model.theta()
    slope = numpy_function(model.drift.jacobian(model.x), model, (n, n))
    slopes = np.stack([np.broadcast_to(slope(centres, t, theta), (len(centres), n, n)) for t in times[[0, -1]]])
    return float(np.abs(np.linalg.eigvals(slopes)).max()) if np.isfinite(slopes).all() else np.inf


def _leaving(model: Model, basis: np.ndarray, times: np.ndarray) -> float:
    """The largest sum over the axes of the noise in cells; InputError where it couples axes too much for positive rates."""
    inverse, theta = np.linalg.inv(basis), model.theta()
    G = numpy_function(model.covariance, model, (model.n, model.n))(np.zeros(model.n), times, theta)
    spread = np.einsum("rij,kjl,rml->rkim", inverse, np.broadcast_to(G, (len(times), model.n, model.n)), inverse)
    own = np.einsum("rkii->rki", spread)
    others = np.abs(spread).sum(axis=3) - own
    if np.any(others > own * (1 + 1e-9)):
        raise InputError(
            f'option operator: the noise of {model.source} couples the axes of the lattice more than the positive rates of '
            '"finite-volume" can; take operator "spectral"'
        )
    return float(own.sum(axis=2).max())


def check_memory(model: Model, sizes: tuple[int, ...], budget: int) -> None:
    """Raise InputError if a step on such a lattice needs more than `budget` bytes."""
    needed = 8.0 * np.prod(sizes, dtype=float) * (24 + 4 * model.n + 2 * model.m)
    if needed > budget:
        lattice = " x ".join(map(str, sizes))
        raise InputError(
            f"option memory: {model.source} needs a lattice of {lattice} points, {needed / 2**20:.0f} MiB, and has "
            f"{budget / 2**20:.0f}; set memory to more MiB or tolerance to more"
        )
