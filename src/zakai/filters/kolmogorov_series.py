"""The on-and-offline filter with the explicit series of the Kolmogorov equation's kernel, for one state and any smooth drift.

    p_t = G p'' / 2 - (f p)',        p(t + dt) = P p(t),      P = K(dt / s)^s on a lattice

with K the logarithmic form of the series up to t^N (`zakai.kolmogorov.heat_series`), positive everywhere.  P knows no
observation: it is composed offline, and its columns are scaled to mass one.  Online an observation multiplies the density by
exp(h'S^-1 dy - h'S^-1 h dt / 2), half of it before the transition and half after, in the logarithm.

P is made again when the lattice no longer fits.  Each time it is compared with the composition of twice as many kernels, which
says how far from the transition it is; `substeps` is doubled until that is small.

Yau (1993), Theorems 10 to 12; Yau and Yau's on-and-offline algorithm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import kolmogorov_series as theorem
from zakai.densities import GridDensity
from zakai.errors import InputError
from zakai.filters import _lattice_choice as choice
from zakai.filters._formulas import Formulas, formulas
from zakai.filters._protocol import Info, Method, Schedule
from zakai.filters.observations import Data, FactorRule, factor_rule, noise_at
from zakai.kolmogorov import lattice as lat
from zakai.kolmogorov.heat_series import FORMS, heat_series, transition
from zakai.kolmogorov.lattice import Lattice
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models.compile import jax_field
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior

_RUN = 64  # intervals between two looks at the lattice
_SIZES = (128, 192, 256, 384, 512, 768, 1024, 1536, 2048)  # few shapes, few compilations
_MOST_SUBSTEPS = 1024
_GOOD = 1e-6  # the estimated error of a transition to which the number of substeps is chosen
_FEW = 1.8  # cells that the standard deviation of the narrowest feature must have
_EDGE = 1e-10  # probability near the edge from which the window is made wider
_KEPT = 0.35  # share of the window that the support must fill, or the window is made smaller


class System:
    """The formulas of a model compiled for this method, with its static options."""

    def __init__(self, model: Model, order: int, form: str):
        self.model, self.order, self.form = model, order, form
        self.observed = jax_field(model.observation, model)


@lru_cache(maxsize=32)
def _system(of: Formulas, order: int, form: str) -> System:
    return System(of.model, order, form)


class Table(NamedTuple):
    """What is composed offline for the lengths `of` (U,): `matrices` (U, M, M), by how much they may be `off` (U, M, M), and for
    each column whether the series is of no use there, `lost` (U, M), and by how much its mass was off, `defects` (U, M).
    """

    of: Any
    matrices: Any
    off: Any
    lost: Any
    defects: Any


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["lattice", "table", "source", "cut", "margin", "fineness"],
    meta_fields=["system", "substeps"],
)
@dataclass(frozen=True)
class State:
    """The normalised density on a lattice, and the transitions on it.

    `source` is the last lattice of the run before, out of which `lattice` was `cut` (2,); `margin` and `fineness` say how
    generous the window and the cell are. The longest transition is made of `substeps` kernels.
    """

    lattice: Lattice
    table: Any
    source: Any
    cut: Any
    margin: Any
    fineness: Any
    system: System
    substeps: int

    @property
    def kept(self) -> State:
        """What a result keeps of the state."""
        return replace(self, table=None, source=None)

    @property
    def run_length(self) -> int:
        return _RUN

    @property
    def possible(self) -> bool:
        """Whether a state that somebody tells of can be one of ours."""
        return 0 < self.substeps <= _MOST_SUBSTEPS


class Interval(NamedTuple):
    """One interval: its ends, the number of its length, and the parameters."""

    start: Any
    stop: Any
    which: Any
    theta: Any


class Reading(NamedTuple):
    """What multiplies the density: exp(linear . h - h'(energy) h / 2 + constant) at the start and at the end."""

    before: Any
    before_energy: Any
    after: Any
    after_energy: Any
    constant: Any


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data; `lengths` are the different lengths of the intervals."""

    model: Model
    system: System
    schedule: Schedule
    substeps: int | None
    splitting: str
    lengths: np.ndarray
    theta: Any
    intervals: Interval


def prepare(
    model: Model, schedule: Schedule, *, order: int = 2, substeps: int | None = None, form: str = "log", splitting: str = "strang"
) -> Prepared:
    """The intervals and their different lengths.

    `order` N is that of the series, `form` "log" or "sum", `substeps` the number of kernels that make the transition of the
    longest interval of a run (by default as many as needed), `splitting` "strang" or "lie". Raises InputError for another value.
    """
    for name, value, most in (("order", order, 6), ("substeps", 1 if substeps is None else substeps, _MOST_SUBSTEPS)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            raise InputError(f"option {name}: {value!r} is not a whole number from 1 to {most}")
    if form not in FORMS:
        raise InputError(f'option form: "{form}" is neither "log" nor "sum"')
    if splitting not in ("strang", "lie"):
        raise InputError(f'option splitting: "{splitting}" is neither "strang" nor "lie"')
    spans = schedule.stops - schedule.starts
    # Lengths that differ in the rounding of the times are one.
    digits = 10.0 ** (np.floor(np.log10(spans)) - 8)
    _, first, which = np.unique(np.round(spans / digits) * digits, return_index=True, return_inverse=True)
    theta = model.theta()
    intervals = Interval(schedule.starts, schedule.stops, which, np.tile(theta, (len(spans), 1)))
    system = _system(formulas(model), order, form)
    return Prepared(model, system, schedule, substeps, splitting, spans[first], theta, intervals)


def with_parameters(prepared: Prepared, theta: Any) -> Prepared:
    """The same intervals with other values of the parameters."""
    intervals = prepared.intervals._replace(theta=jnp.tile(theta, (len(prepared.schedule.starts), 1)))
    return replace(prepared, theta=theta, intervals=intervals)


def observations(prepared: Prepared, data: Data) -> Any:
    """What `step` is given for each interval: the whole likelihood, outside of the transition."""
    given = rule(prepared, data)(data.filled)
    if data.stops[0] > prepared.model.start or isinstance(prepared.theta, np.ndarray):
        return given
    # The lattice of a posterior at the start is chosen for the model's own parameters.
    return given, rule(prepared, data, prepared.model.theta())(data.filled)


class Rule(NamedTuple):
    """What a Reading is but for the values."""

    factors: FactorRule
    start: Any
    end: Any

    def __call__(self, values: Any) -> Reading:
        given = self.factors(values)
        end = self.end if given.energy is None else self.end + given.energy
        return Reading(given.before, self.start, given.after, end, given.constant)


def rule(prepared: Prepared, data: Data, theta: Any = None) -> Rule:
    """What `observations` gives but for the values, for the parameters `theta`, by default those of `prepared`."""
    model, schedule, theta = prepared.model, prepared.schedule, prepared.theta if theta is None else theta
    found = factor_rule(model, data, schedule, rates=False, splitting=prepared.splitting, remove=False, theta=theta)
    xp = np if isinstance(theta, np.ndarray) else jnp
    spans = np.where(schedule.inside.all(axis=1), schedule.stops - schedule.starts, 0.0)[:, None, None]
    start, end = (xp.linalg.inv(noise_at(model, times, theta)) * spans for times in (schedule.starts, schedule.stops))
    start, end = (0.0 * start, end) if prepared.splitting == "lie" else (0.5 * start, 0.5 * end)
    return Rule(found, start, end)


def _log_factor(h: Any, linear: Any, energy: Any) -> Any:
    value = sum((linear[i] * h_i for i, h_i in enumerate(h)), start=jnp.zeros(()))
    return value - 0.5 * sum(energy[i, j] * a * b for i, a in enumerate(h) for j, b in enumerate(h))


def init(prepared: Prepared, prior: Any) -> State:
    """The prior on a lattice."""
    return _start(prepared, prior, None)[0]


def correct(prepared: Prepared, prior: Any, observation: Any) -> tuple[State, Info]:
    """The prior after a sample at the start itself."""
    state, evidence = _start(prepared, prior, observation)
    summary, zero = lat.summary(state.lattice), jnp.zeros(())
    told = {"edge_mass": summary.edge_mass, "quadrature_error": _quadrature(_cells(state.lattice.log_values))}
    told |= {"truncation": zero, "mass_defect": zero, "negative": zero, "depth": zero}
    return state, Info(evidence, summary.mean, summary.cov, told, jnp.zeros(2))


def _start(prepared: Prepared, prior: Any, observation: Any) -> tuple[State, Any]:
    """The first state, after a sample if there is one, and the logarithm of the sample's density."""
    model, system = prepared.model, prepared.system
    traced = not isinstance(prepared.theta, np.ndarray)
    observation, own = observation if traced and observation is not None else (observation, observation)

    def factor(x: Any, reading: Reading, theta: Any) -> Any:
        one = jax.tree.map(lambda a: a[0], reading)
        return _log_factor(system.observed(x, model.start, theta), one.after, one.after_energy) + one.constant

    def own_factor(x: np.ndarray) -> np.ndarray:
        return np.asarray(factor(x, own, model.theta()))

    with jax.ensure_compile_time_eval():
        first, before = choice.first_lattice(model, prior, None)
        lattice, after = (first, before) if observation is None else choice.first_lattice(model, prior, own_factor)
        if lattice.log_values.size == 1:
            raise InputError(f"{model.source}: prior: its variance is zero; kolmogorov-series needs a density")
    evidence: Any = after - before
    if traced:
        earlier = lat.summary(first._replace(log_values=_prior_on(prepared, prior, first))).log_mass
        logs = _prior_on(prepared, prior, lattice)
        if observation is not None:
            logs = logs + factor(lattice.points(), observation, prepared.theta)
        later = lat.summary(lattice._replace(log_values=logs)).log_mass
        lattice, evidence = lattice._replace(log_values=logs - later), later - earlier
    one = jnp.ones(())
    return State(lattice, None, None, choice.SAME, one, one, system, prepared.substeps or 1), evidence


def _prior_on(prepared: Prepared, prior: Any, lattice: Lattice) -> Any:
    """The prior's logarithm on a lattice that was chosen for the model's own parameters, for traced ones."""
    with jax.ensure_compile_time_eval():
        points = lattice.points()
        logs = choice.log_prior(prepared.model, prior)(np.asarray(points))
    if not isinstance(prior, DensityPrior):
        return jnp.asarray(logs)
    there = np.isfinite(logs)
    # Where there is no density a formula may not exist; a point where it does stands in.
    safe = jnp.where(there[:, None], points, points[np.argmax(logs)])
    traced = jax_field([prior.log_density], prepared.model)(safe, prepared.model.start, prepared.theta)[0]
    return jnp.where(there, traced, -jnp.inf)


def adapt(prepared: Prepared, state: State, rows: slice, info: Info | None) -> State | None:
    """The state to begin the intervals `rows` with: the window, the cell, and the transitions on it."""
    which = np.unique(prepared.intervals.which[rows])
    if not np.isfinite(np.max(np.asarray(state.lattice.log_values))):
        # The density is lost, which the warnings say.
        return state if info is None else None
    if info is None:
        source = state.lattice
        margin, fineness = 1.0, 1.0
        state = replace(state, substeps=prepared.substeps or state.substeps)
        if state.table is not None and _fits(state, which, prepared):
            return replace(state, source=source, cut=choice.SAME)
    else:
        source, health = state.source, info.health
        if _is_chosen(prepared) and not np.all(health["truncation"] < 0.1):
            # No lattice helps a series that is of no use over so long a time.
            return None
        margin, fineness = float(state.margin), float(state.fineness)
        finite = np.all(np.isfinite(info.log_likelihood_increment))
        narrow = not finite or not np.all(health["edge_mass"] < _EDGE)
        coarse = not finite or not np.all(health["quadrature_error"] < _quadrature(_FEW))
        may = finite and not _is_chosen(prepared) and state.substeps < _MOST_SUBSTEPS
        more = 2 * state.substeps if may and not np.all(health["truncation"] < 10 * _GOOD) else state.substeps
        if (not (narrow or coarse) and more == state.substeps) or margin > 200 or fineness > 60:
            return None
        state = replace(state, substeps=more)
        margin, fineness = margin * (2.0 if narrow else 1.0), fineness * (1.5 if coarse and not narrow else 1.0)
    return _with_transitions(prepared, state, source, which, margin, fineness, info is None)


def _kept_bounds(state: State, info: Info) -> Any:
    """Whether a step kept every bound that `adapt` looks at."""
    health = info.health
    kept = (health["edge_mass"] < _EDGE) & (health["quadrature_error"] < _quadrature(_FEW)) & (health["truncation"] < 10 * _GOOD)
    return kept & (abs(info.log_likelihood_increment) < np.inf)


def _is_chosen(prepared: Prepared) -> bool:
    """Whether the number of substeps stays as it is: a sum gets no better with more of them."""
    return prepared.substeps is not None or prepared.system.form == "sum"


def _with_transitions(prepared, state, source, which, margin, fineness, first: bool) -> State | None:
    """The state on a new lattice, with as many substeps as it takes; None if it cannot be finer, which health tells."""
    best = None
    while True:
        laid = _laid(prepared, state, source, which, margin, fineness)
        if laid is None:
            if best is None and first:
                raise InputError(
                    f"{prepared.model.source}: kolmogorov-series needs a lattice of more than {_SIZES[-1]} points: an "
                    "interval is too short for the width of the density; name another method"
                )
            return best
        weights = np.exp(np.asarray(laid.lattice.log_values) - np.max(laid.lattice.log_values))
        table = laid.table
        off = np.max(np.abs(table.off @ weights).sum(axis=1) + table.lost @ weights) / weights.sum()
        if _is_chosen(prepared) or off <= _GOOD or laid.substeps >= _MOST_SUBSTEPS:
            return laid
        best = laid
        # The error falls with the power N of the number of kernels, once that is large enough.
        more = np.ceil(np.log2(np.clip(off / _GOOD, 2.0, 4.0**prepared.system.order)) / prepared.system.order)
        state = replace(state, substeps=min(int(laid.substeps * 2**more), _MOST_SUBSTEPS))


def _support(lattice: Lattice) -> tuple[float, float]:
    logs = np.asarray(lattice.log_values)
    at = np.asarray(lattice.points())[:, 0][logs >= logs.max() - lat.SUPPORT]
    return float(at.min()), float(at.max())


def _fits(state: State, which: np.ndarray, prepared: Prepared) -> bool:
    """Whether the lattice and its transitions serve the lengths `which` too."""
    x = np.asarray(state.lattice.points())[:, 0]
    low, high = _support(state.lattice)
    room = 0.02 * (x[-1] - x[0])
    inside = low - x[0] > room and x[-1] - high > room and high - low > _KEPT * (x[-1] - x[0])
    held = set(prepared.lengths[which]) <= set(np.asarray(state.table.of))
    return inside and held and float(_cells(state.lattice.log_values)) > _FEW


def _laid(prepared, state, source, which, margin, fineness) -> State | None:
    """The density of `source` on a lattice that fits it, with the transitions; None if that has too many points."""
    model, spans = prepared.model, prepared.lengths[which]
    G = float(numpy_function(model.covariance, model, (1, 1))(np.zeros(1), model.start, model.theta())[0, 0])
    low, high = _support(source)
    reach = margin * (0.2 * (high - low) + 2.0 * np.sqrt(G * spans.max()))
    old = abs(float(source.basis[0, 0]))
    cells = float(choice.features(np.asarray(source.log_values)[None])[0, 0])
    # The transition is compared with one of twice as many kernels, which must be resolved too.
    shortest = (spans / _shares(state.substeps, spans)).min()
    cell = min(choice.COARSEST * np.sqrt(G * shortest / 2), old * cells / choice.CELLS) / fineness
    if (high - low + 2 * reach) / cell > _SIZES[-1]:
        return None
    size = next(s for s in _SIZES if s >= (high - low + 2 * reach) / cell)
    cell = (high - low + 2 * reach) / size
    count = source.log_values.size
    middle = (0.5 * (low + high) - float(source.centre[0])) / old + count // 2
    cut = np.array([middle, cell / old])
    lattice = choice.cut_out(source, cut, size)
    substeps = _shares(state.substeps, spans)
    table = _composed(prepared.system, substeps, np.asarray(lattice.points()), spans, prepared.theta)
    # Few shapes, few compilations: the last transition stands in for those that there are not.
    missing = 2 ** int(np.ceil(np.log2(len(spans)))) - len(spans)
    table = jax.tree.map(lambda a: np.concatenate([a, np.repeat(a[-1:], missing, axis=0)]), table)
    generous = {"margin": jnp.array(margin), "fineness": jnp.array(fineness)}
    return replace(state, lattice=lattice, table=table, source=source, cut=cut, **generous)


def _composed(system: System, substeps: tuple[int, ...], x: Any, spans: Any, theta: Any) -> Table:
    """The transitions over the times `spans` on a lattice x (M, 1), each of so many kernels: by NumPy, or, traced, by JAX."""
    xp = numpy_or_jax(theta)
    heat = heat_series(system.model, x, system.order, theta=theta, potential=False)
    share = 2.0**system.order / (2.0**system.order - 1.0)

    def scaled(P: Any) -> Any:
        mass = xp.sum(P, axis=0)
        # From where the series is of no use, as where the drift is too fast for it, nothing comes; the error says so.
        good = xp.all(xp.isfinite(P), axis=0) & (mass > 0 if system.form == "log" else True)
        # The sum changes sign, so that its columns may have any mass.
        scale = mass if system.form == "log" else 1.0
        return xp.where(good, P, 0.0) / xp.where(good, scale, 1.0), xp.where(good, xp.abs(mass - 1.0), 1.0), good

    found = []
    with np.errstate(over="ignore", invalid="ignore"):
        for span, count in zip(spans, substeps):
            (P, defect, good), (finer, _, fine) = (
                scaled(transition(heat, x[1, 0] - x[0, 0], span, substeps=s, form=system.form)) for s in (count, 2 * count)
            )
            found.append((P, share * (P - finer), 1.0 - (good & fine), defect))
    return Table(spans, *(xp.stack(parts) for parts in zip(*found, strict=True)))


def _shares(substeps: int, spans: np.ndarray) -> tuple[int, ...]:
    """Of how many kernels each transition is made, the longest of `substeps`: the kernels' times are about the same."""
    return tuple(int(np.ceil(substeps * span / spans.max() - 1e-9)) for span in spans)


_composed_traced = jax.jit(_composed, static_argnums=(0, 1))


def resume(prepared: Prepared, state: State, rows: slice, begin: State) -> State:
    """The traced `state` on the lattice of `begin`, with the transitions for the traced parameters."""
    cut, size = np.asarray(begin.cut), begin.lattice.log_values.size
    lattice = state.lattice if np.array_equal(cut, choice.SAME) else choice.cut_out(state.lattice, cut, size)
    fixed = begin.lattice._replace(log_values=lattice.log_values)
    x, spans = np.asarray(begin.lattice.points()), np.asarray(begin.table.of)
    table = _composed_traced(prepared.system, _shares(begin.substeps, spans), x, spans, prepared.theta)
    return replace(begin, lattice=fixed, table=table)


def step(interval: Interval, state: State, observation: Reading) -> tuple[State, Info]:
    """One interval: half of the factor, the transition, the other half, and the moments."""
    lattice, table, theta = state.lattice, state.table, interval.theta
    points = lattice.points()
    h = state.system.observed(points, interval.start, theta)
    logs = lattice.log_values + _log_factor(h, observation.before, observation.before_energy)
    top = jax.lax.stop_gradient(jnp.max(logs))
    values = jnp.exp(logs - top)
    span = interval.stop - interval.start
    slot = jnp.argmin(jnp.abs(table.of - span))
    moved = table.matrices[slot] @ values
    total = jnp.sum(values)
    spread = lat.log(jnp.maximum(moved, 0.0))
    h = state.system.observed(points, interval.stop, theta)
    factor = _log_factor(h, observation.after, observation.after_energy)
    after = spread + top + factor + observation.constant
    # What the factor does to the density it does to its error, which may be large where an observation surprises.
    weight = jnp.exp(factor + spread - jnp.max(factor + spread))
    relative = jnp.where(moved > 0, jnp.abs(table.off[slot] @ values) / jnp.where(moved > 0, moved, 1.0), 0.0)
    new = lattice._replace(log_values=after)
    summary = lat.summary(new)
    told = {
        "edge_mass": summary.edge_mass,
        "quadrature_error": _quadrature(jnp.minimum(_cells(logs), _cells(after))),
        "truncation": weight @ relative / jnp.sum(weight) + table.lost[slot] @ values / total,
        "mass_defect": table.defects[slot] @ values / total,
        "negative": -jnp.sum(jnp.minimum(moved, 0.0)) / jnp.sum(jnp.abs(moved)),
        "depth": lat.reach(new, spread),
    }
    told = jax.lax.stop_gradient(told)
    lattice = new._replace(log_values=after - summary.log_mass)
    return replace(state, lattice=lattice), Info(summary.log_mass, summary.mean, summary.cov, told, jnp.zeros(2))


def _cells(logs: Any) -> Any:
    """The standard deviation of the narrowest feature, in cells."""
    return jax.lax.stop_gradient(lat.features(Lattice(jnp.asarray(logs), jnp.zeros(1), jnp.eye(1)))[0])


def _quadrature(cells: Any) -> Any:
    """The error of a sum over a lattice in which a standard deviation has so many cells."""
    return 2 * jnp.exp(-2 * jnp.pi**2 * cells**2)


def density(prepared: Prepared, state: State) -> GridDensity:
    """The posterior on its lattice."""
    lattice = state.lattice
    logs, centre, basis = (np.asarray(a) for a in lattice)
    return GridDensity(logs, centre, basis, prepared.model.state, (False,))


METHOD = Method(
    name="kolmogorov-series",
    source="Yau 1993, Theorems 10 to 12, in the logarithmic form; the likelihood online",
    exactness="convergent: order `order` in the length of a kernel, an interval over `substeps`; first order in the interval for "
    "continuous observations, as any splitting of a sampled path",
    theorem=theorem,
    options={"order": 2, "substeps": None, "form": "log", "splitting": "strang"},
    prepare=prepare,
    init=init,
    correct=correct,
    observations=observations,
    rule=rule,
    fits=_kept_bounds,
    step=step,
    density=density,
    adapt=adapt,
    with_parameters=with_parameters,
    resume=resume,
    bounds={
        "edge_mass": (1e-9, "probability in the outermost cells of the lattice"),
        "quadrature_error": (1e-9, "the lattice is too coarse for the density"),
        "truncation": (1e-4, "the estimated error of the composed series over one interval; set substeps to more, or to None"),
        "negative": (1e-12, 'share of the density that became negative and was cut; set form to "log"'),
        "depth": (18.0, "nats below its maximum at which the density lies after an observation: the series is cut there"),
    },
)
