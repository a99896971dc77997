"""Predictions of observations: their laws before they are made, one row ahead in a record or at later times.

The law of a coordinate z of a row is a mixture: p(z) = sum_i w_i p(z | x_i, t) over the predicted density of the state, which is
a grid or a sum of Gaussians; of another density draws are taken, always the same.  Of an increment the state is that in the
middle of its interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai import _display
from zakai._progress import Progress, counting
from zakai.diagnostics.predictive import DRAWS, Mixture, PredictiveSums
from zakai.engine.forecast import future_of, origin_of
from zakai.engine.loop import CHUNK, Run, segments
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.models.families import COUNTS
from zakai.records import Inputs
from zakai.records.schedule import Schedule

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult

Array = NDArray[Any]
SMALL = 1e-10  # weight of a point, relative to the largest, that is left out
HALVINGS = 60  # of the bracket of a quantile
EXTENT = 39.0  # standard deviations beyond which a Gaussian has no probability in double precision
ROUNDING = 1e-13  # last step of a quantile, relative to the law


class Law(NamedTuple):
    """The law of one row of observations of one block: N points with weights, and how observations follow from them.

    The means (N, m) and variances (N, m) of Gaussian observations with the covariance `cov` (m, m) or (N, m, m) given the point;
    other families take the law at the points x (N, n) at `t`, with inputs u.
    """

    weights: Array
    means: Array
    cov: Array | None
    points: Array
    t: float
    u: Array | None
    setting: Setting
    scale: Array  # of an increment, and
    shift: Array  # what is added to it: observation = shift + scale * what the law gives

    @property
    def _families(self) -> tuple[str, ...]:
        return self.setting.model.observation_family

    def mean(self) -> Array:
        """Return the means (m,), of angles the mean directions."""
        if self.cov is None and "von-mises" in self._families:
            angle = np.array([name == "von-mises" for name in self._families])
            turned = np.angle(self.weights @ np.exp(1j * self.means))
            return np.where(angle, turned, self.weights @ self.means)
        return np.asarray(self.shift + self.scale * (self.weights @ self.means))

    def distribution(self, z: Array) -> Array:
        """Return P(Z_j <= z_j) (m,)."""
        if self.cov is not None:
            from scipy.special import ndtr

            deviations = np.sqrt(np.diagonal(self.cov, axis1=-2, axis2=-1))
            return np.asarray(self.weights @ ndtr(((z - self.shift) / self.scale - self.means) / deviations))
        law, theta = self.setting.model.observation_law, self.setting.theta.real
        found = np.empty(len(z))
        for j in range(len(z)):  # each by itself, not given those before it
            row = np.where(np.arange(len(z)) == j, z, np.nan)
            found[j] = self.weights @ law.cdf(row, self.points, self.t, theta, self.u)[1][:, j]
        return found

    def quantile(self, q: Array) -> Array:
        """Return quantiles (len(q), m), of counts the smallest count with at least this probability."""
        find = self._bisection if self.cov is None else self._newton
        return np.stack([find(float(probability)) for probability in q])

    def _newton(self, probability: float) -> Array:
        """Return the quantiles (m,) of mixtures of Gaussians by Newton's method, with bisection where it converges slowly."""
        from scipy.special import ndtr, ndtri

        assert self.cov is not None
        deviations = np.sqrt(np.diagonal(self.cov, axis1=-2, axis2=-1))
        low = (self.means - EXTENT * deviations).min(axis=0)
        high = (self.means + EXTENT * deviations).max(axis=0)
        mean = self.weights @ self.means
        scale = np.sqrt(self.weights @ ((self.means - mean) ** 2 + deviations**2))
        z, step = np.clip(mean + ndtri(probability) * scale, low, high), high - low
        found = np.zeros(len(z), bool)
        for _ in range(2 * HALVINGS):
            scores = (z - self.means) / deviations
            excess = self.weights @ ndtr(scores) - probability
            slope = self.weights @ (np.exp(-0.5 * scores**2) / deviations) / np.sqrt(2 * np.pi)
            low, high = np.where(excess < 0, z, low), np.where(excess < 0, high, z)
            with np.errstate(all="ignore"):
                proposed = z - excess / slope
            converges = (low < proposed) & (proposed < high) & (np.abs(proposed - z) < 0.5 * np.abs(step))
            proposed = np.where(converges, proposed, 0.5 * (low + high))
            step = np.where(found, 0.0, proposed - z)
            z = z + step
            found |= np.abs(step) <= ROUNDING * (scale + np.abs(z))
            if found.all():
                break
        return np.asarray(self.shift + self.scale * z)

    def _bisection(self, probability: float) -> Array:
        """Return the quantiles (m,) of other laws."""
        counts = np.array([name in COUNTS for name in self._families])
        angles = np.array([name == "von-mises" for name in self._families])
        positive = np.array([name in ("log-normal", "exponential") for name in self._families])
        centre = self.mean()
        low, high = np.where(angles, -np.pi, centre - 1.0), np.where(angles, np.pi, centre + 1.0)
        low = np.where(counts, -1.0, np.where(positive, 0.0, low))
        for _ in range(200):
            below, above = self.distribution(low) > probability, self.distribution(high) < probability
            fixed = counts | angles | positive
            below, above = below & ~fixed, above & ~angles
            if not (below.any() or above.any()):
                break
            width = high - low
            low, high = np.where(below, low - 2 * width, low), np.where(above, high + 2 * width, high)
        high = np.where(counts, np.ceil(high), high)
        for _ in range(HALVINGS):
            if np.where(counts, high - low <= 1.0, False).all():
                break
            middle = 0.5 * (low + high)
            middle = np.where(counts, np.floor(middle), middle)
            enough = self.distribution(middle) >= probability
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return high

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return draws (count, m)."""
        place = rng.choice(len(self.weights), count, p=self.weights / self.weights.sum())
        if self.cov is not None:
            factors = np.linalg.cholesky(np.broadcast_to(self.cov, (len(self.weights), *self.cov.shape[-2:])))[place]
            normal = rng.standard_normal((count, self.means.shape[1], 1))
            return np.asarray(self.shift + self.scale * (self.means[place] + (factors @ normal)[..., 0]))
        u = None if self.u is None else np.broadcast_to(self.u, (count, np.shape(self.u)[-1]))
        model = self.setting.model
        return model.observation_law.sample(rng, self.points[place], np.full(count, self.t), self.setting.theta.real, u)


@dataclass(frozen=True, eq=False, repr=False)
class PredictedObservations:
    """The laws of observations before they are made.

    `times` (K,) are those of the record, each row given the rows before it, or later ones, given the whole record; `mean` (K, m),
    of angles the mean direction.  Values are of the model's `observation_kind`.
    """

    times: Array
    mean: Array
    _laws: tuple[tuple[tuple[int, ...], tuple[Law, ...]], ...]

    def __repr__(self) -> str:
        return f"PredictedObservations({_display.counted(len(self.times), 'time')} x {self.mean.shape[1]})"

    def _repr_html_(self) -> str:
        shown = range(min(len(self.times), _display.MOST_ROWS))
        rows = [tuple(map(_display.number, (self.times[k], *self.mean[k]))) for k in shown]
        header = ["time", *(f"mean of y{j + 1}" for j in range(self.mean.shape[1]))]
        return _display.html_table(repr(self), header, rows, total=len(self.times))

    def quantile(self, q: Any) -> Array:
        """Return quantiles of each coordinate by itself.

        Args:
            q: probabilities from 0 to 1, not 0 and 1 themselves.

        Returns:
            (len(q), K, m), or (K, m) for one probability; of a count the smallest one that has at least this probability, of an
            angle counted from -pi.
        """
        wanted = np.asarray(q, float)
        if not ((wanted > 0) & (wanted < 1)).all():
            raise InputError(f"quantile: {q!r}; give probabilities between 0 and 1")
        found = np.empty((wanted.size, *self.mean.shape))
        for columns, laws in self._laws:
            found[:, :, list(columns)] = np.stack([law.quantile(np.atleast_1d(wanted)) for law in laws], axis=1)
        return found if wanted.ndim else found[0]

    def sample(self, count: int, seed: int = 0) -> Array:
        """Return draws (count, K, m); the rows are drawn each by itself, the coordinates of a row together."""
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"sample: count is {count!r}; expected a whole number of at least 1")
        found, rng = np.empty((count, *self.mean.shape)), np.random.default_rng(seed)
        for columns, laws in self._laws:
            found[:, :, list(columns)] = np.stack([law.sample(rng, count) for law in laws], axis=1)
        return found


def predict_observations(
    result: FilterResult, times: Any = None, inputs: Inputs | None = None, progress: Progress | None = None
) -> PredictedObservations:
    """Return the laws of observations; see `FilterResult.predict_observations`."""
    plan, states, record = origin_of(result, "predict_observations")
    model = plan.model
    if model.observation_kind == "samples" and model.log_density is not None:
        raise InputError(f"{model.source}: predict_observations: observation_log_density gives no law that can be predicted")
    ahead = record if times is None else future_of(result, times, inputs, "predict_observations")
    observed = [parts for parts in zip(plan.runs(ahead, "moments"), plan.blocks, states, strict=True) if parts[1].observations]
    last = None if times is None else float(record.times[-1])
    laws = []
    with counting("predicting observations", len(observed) * len(ahead), progress) as counted:
        for run, block, state in observed:
            if last is not None:
                run.state, run.schedule.starts[0] = state, last
            path = _path_before(run, record, block.observations, last)
            laws.append((tuple(block.observations), tuple(counted(_laws(run, path, last)))))
    mean = np.empty((len(ahead), model.m))
    for columns, own in laws:
        mean[:, list(columns)] = [law.mean() for law in own]
    return PredictedObservations(np.asarray(ahead.times), mean, tuple(laws))


def _path_before(run: Run, record: Any, columns: Any, last: float | None) -> tuple[Array, Array]:
    """Return for a path the last values (K, m) before each row and their times, for other kinds zeros and the rows' starts."""
    starts, m = run.schedule.starts, run.setting.model.m
    values, since = np.zeros((len(starts), m)), np.repeat(starts[:, None], m, axis=1)
    if run.setting.model.observation_kind != "path":
        return values, since
    given = record.values[:, list(columns)]
    value, time = np.zeros(m), np.full(m, run.setting.model.start)
    for k in range(len(record)):
        if last is None:
            values[k], since[k] = value, time
        seen = ~np.isnan(given[k])
        value, time = np.where(seen, given[k], value), np.where(seen, record.times[k], time)
    if last is not None:
        values[:], since[:] = value, time
    return values, since


def _laws(run: Run, before: tuple[Array, Array], last: float | None) -> Any:
    """Yield the law of each row of a run."""
    setting, model = run.setting, run.setting.model
    samples = model.observation_kind == "samples"
    shifts, since = before
    actual = run.schedule
    elapsed = np.zeros(actual.seen.shape) if samples else actual.stops[:, None] - since
    full = Schedule(actual.starts, actual.stops, np.ones_like(actual.seen), elapsed, actual.inputs)
    for segment in segments(setting, actual, None if last is None else run.state, run.values):
        if segment.rows.start == 0:
            chunk = full.part(slice(segment.first, segment.first + CHUNK))
            sums = PredictiveSums(setting, chunk)
        for i, state in enumerate([segment.before, *segment.states[:-1]]):
            place, k = segment.rows.start + i, segment.first + i
            with np.errstate(all="ignore"):
                yield _law(run, sums, place, state, shifts[k])


def _law(run: Run, sums: PredictiveSums, k: int, state: Any, shift: Array) -> Law:
    """Return the law of row k of a chunk, from the state before it."""
    setting, model = run.setting, run.setting.model
    prepared, predicted = sums.predicted(k, state)
    density = setting.method.density(prepared, predicted)
    mixture = Mixture.of(density)
    if mixture is None or (mixture.covs is not None and not (sums.gaussian and sums.affine)):
        mixture = Mixture.drawn(density)
    if mixture is None:
        mixture = Mixture(np.full(DRAWS, 1.0 / DRAWS), density.sample(np.random.default_rng(0), DRAWS), None, ())
    kept = mixture.weights > SMALL * mixture.weights.max()  # without negative ones, from which nothing can be drawn
    mixture = Mixture(mixture.weights[kept], mixture.points[kept], None if mixture.covs is None else mixture.covs[kept], ())
    weights, points = mixture.weights / mixture.weights.sum(), mixture.points
    t, m = float(sums.unobserved.stops[k]), model.m
    u = sums.inputs(t)
    if sums.samples and not model.observation_law.is_gaussian:
        means = np.broadcast_to(model.observation_law.mean(points, t, sums.theta.real, u), (len(points), m))
        return Law(weights, means, None, points, t, u, setting, np.ones(m), shift)
    span = np.ones(m) if sums.samples else sums.schedule.elapsed[k]
    means = span * np.real(sums.h(points, t, sums.theta, u))
    near = Mixture(weights, points, mixture.covs, ())
    cov = np.real(sums.noise(points, t, sums.theta, u) if sums.samples else sums.noise_at(k, np.arange(m), near))
    if mixture.covs is not None:
        slopes = span[:, None] * sums.slopes(points, t)
        cov = cov + slopes @ mixture.covs @ np.swapaxes(slopes, 1, 2)
    scale = 1.0 / span if model.observation_kind == "rates" else np.ones(m)
    return Law(weights, means, np.broadcast_to(cov, (len(points), m, m)), points, t, u, setting, scale, shift)
