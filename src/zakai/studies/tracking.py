"""Three tracks by tensor trains and by particle filters: the error of the means against the time of an observation.

    radar       range and bearing of a target on a line: 4 states
    bearings    the bearing alone, from an observer that moves on a circle: 4 states
    turn        range and bearing of a target that turns at an unknown rate: 5 states

The reference is the mean of two bootstrap filters with many particles, written in NumPy, whose difference is its error.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai.densities._values import wrap
from zakai.engine.driver import filter as filter_record
from zakai.methods._options import whole_number
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import GaussianPrior
from zakai.records import Record
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import INK, OTHER, OURS, TRUTH, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, Table

TRAIN, GUIDED, BOOTSTRAP = "tensor-train", "guided-particles", "particle filter in NumPy"
TOLERANCES, GUIDES, SIZES = (2e-2, 5e-3, 1e-3), (1000, 4000), (1000, 10_000, 100_000)
LONGEST = 0.05  # substep of the particle filter in NumPy
SHOWN = (0.2, 0.6, 1.0)  # shares of the record at which a density is drawn
LABELS = {TRAIN: f"{TRAIN}, by tolerance", GUIDED: f"{GUIDED}, by number", BOOTSTRAP: f"{BOOTSTRAP}, by number"}
COLOURS = {TRAIN: OURS, GUIDED: TRUTH, BOOTSTRAP: OTHER}


class Moments(NamedTuple):
    """Means and standard deviations (K, n) after each observation."""

    means: np.ndarray
    deviations: np.ndarray


class Point(NamedTuple):
    """A filter with one setting: its name, the setting, milliseconds an observation, and the error of the means."""

    method: str
    setting: str
    milliseconds: float
    error: float


class Track(NamedTuple):
    """What was found for one system: the points, the error of the reference, and the warnings of tensor-train."""

    points: list[Point]
    reference: float
    warnings: list[str]


def _track(state: list[str], drift: list[str], noise: list[float], observation: list[str], errors: list[float], mean: list[float],
           variances: list[float]) -> Model:  # fmt: skip
    n, driven = len(state), len(state) - len(noise)
    return Model(
        state=state, drift=drift, diffusion=(np.vstack([np.zeros((driven, len(noise))), np.diag(noise)])).tolist(),
        observation=observation, observation_kind="samples", observation_noise=np.diag(errors).tolist(),
        prior={"kind": "gaussian", "mean": mean, "cov": variances[:n]},
    )  # fmt: skip


def radar() -> Model:
    """Return a target that moves on a line, seen by range and bearing."""
    return _track(
        ["px", "py", "vx", "vy"], ["vx", "vy", "0", "0"], [0.25, 0.25], ["sqrt(px**2 + py**2)", "atan2(py, px)"],
        [0.06, 0.003], [7.0, 5.0, -0.7, 0.2], [3.0, 3.0, 0.4, 0.4],
    )  # fmt: skip


def bearings() -> Model:
    """Return a target of which an observer that moves on a circle sees the bearing."""
    return _track(
        ["px", "py", "vx", "vy"], ["vx", "vy", "0", "0"], [0.12, 0.12], ["atan2(py - 1.2*sin(0.8*t), px - 1.2*cos(0.8*t))"],
        [0.003], [6.0, 5.0, -0.6, 0.2], [6.0, 6.0, 0.2, 0.2],
    )  # fmt: skip


def turn() -> Model:
    """Return a target that turns at an unknown rate, seen by range and bearing."""
    return _track(
        ["px", "py", "vx", "vy", "w"], ["vx", "vy", "-w*vy", "w*vx", "-0.1*w"], [0.2, 0.2, 0.15],
        ["sqrt(px**2 + py**2)", "atan2(py, px)"], [0.08, 0.003], [6.0, 6.0, -0.9, 0.4, 0.25], [1.5, 1.5, 0.4, 0.4, 0.15],
    )  # fmt: skip


SYSTEMS: dict[str, Callable[[], Model]] = {"radar": radar, "bearings": bearings, "turn": turn}


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    observations: int = 20,
    particles: int = 200_000,
    seed: int = 1,
) -> Reproduction:
    """Filter a record of each system by every filter.

    Args:
        progress: called with the work done and all of it.
        pictures: where pictures go.
        observations: in each record.
        particles: of the reference.
        seed: of the records and of the random numbers of filters.
    """
    whole_number("observations", observations, 2, 10_000)
    whole_number("particles", particles, 1000, 10**7)
    whole_number("seed", seed, 0, 2**31)
    each = 2 + len(TOLERANCES) + len(GUIDES) + len(SIZES)
    pictures, work = pictures or Pictures(), Progress(progress, each * len(SYSTEMS))
    times = np.cumsum(np.random.default_rng(11).uniform(0.1, 0.6, observations))
    found = dict[str, Track]()
    for name, of in SYSTEMS.items():
        model = of()
        truth, record = simulate(model, times, seed=seed)
        if name == "bearings":
            pictures.add("posterior", partial(draw_densities, model, record, truth.values))
        found[name] = _compared(model, record, particles, seed, work)
    pictures.add("error-and-time", partial(draw, found))
    return reproduction(found, {"observations": observations, "particles": particles, "seed": seed})


def _compared(model: Model, record: Record, particles: int, seed: int, work: Progress) -> Track:
    """Return the errors and times of all filters on one record."""
    one, other = (_bootstrap(model, record, particles, 100 + seed + i) for i in range(2))
    work.add(2)
    exact = Moments(0.5 * (one.means + other.means), 0.5 * (one.deviations + other.deviations))

    def rms(means: np.ndarray) -> float:
        return float(np.sqrt(np.mean(((means - exact.means) / exact.deviations) ** 2)))

    points, warnings = list[Point](), list[str]()

    def add(method: str, setting: str, means: Callable[[], np.ndarray]) -> None:
        begun = time.process_time()
        found = means()
        points.append(Point(method, setting, 1e3 * (time.process_time() - begun) / len(record.times), rms(found)))
        work.add()

    def filtered(method: str, **options: Any) -> np.ndarray:
        result = filter_record(model, record, method, keep="moments", **options)
        if method == TRAIN:
            warnings.extend(result.warnings)
        return np.asarray(result.mean[1:])

    begin = Record(record.times[:1], record.values[:1], record.kind)
    for method in (TRAIN, GUIDED):  # kernels are compiled, and formulas are made programs
        filter_record(model, begin, method, keep="moments")
    for tolerance in TOLERANCES:
        add(TRAIN, f"{tolerance:g}", partial(filtered, TRAIN, tolerance=tolerance))
    for count in GUIDES:
        add(GUIDED, f"{count:,}", partial(filtered, GUIDED, particles=count, seed=seed))
    for count in SIZES:
        add(BOOTSTRAP, f"{count:,}", lambda count=count: _bootstrap(model, record, count, seed).means)  # type: ignore[misc]
    return Track(points, 0.5 * rms(2 * one.means - exact.means), warnings)


def _bootstrap(model: Model, record: Record, count: int, seed: int) -> Moments:
    """Return what a bootstrap filter finds: half of a Runge-Kutta step, noise, and half a step."""
    rng, theta = np.random.default_rng(seed), model.theta()
    f, h = numpy_function(model.drift, model), numpy_function(model.observation, model)
    S = np.diag(np.asarray(model.observation_noise.tolist(), float))
    g = np.asarray(model.diffusion.tolist(), float)
    angles = np.array(["atan2" in str(part) for part in model.observation])

    def half(x: np.ndarray, t: float, d: float) -> np.ndarray:
        a = f(x, t, theta)
        b = f(x + d / 2 * a, t + d / 2, theta)
        c = f(x + d / 2 * b, t + d / 2, theta)
        return np.asarray(x + d / 6 * (a + 2 * b + 2 * c + f(x + d * c, t + d, theta)))

    assert isinstance(model.prior, GaussianPrior)
    x, now, means, deviations = model.prior.sample(rng, count), 0.0, list[np.ndarray](), list[np.ndarray]()
    for stop, z in zip(record.times, record.values, strict=True):
        steps = max(1, math.ceil((stop - now) / LONGEST))
        d = (stop - now) / steps
        for i in range(steps):
            x = half(x, now + i * d, d / 2) + math.sqrt(d) * rng.standard_normal((count, g.shape[1])) @ g.T
            x = half(x, now + (i + 0.5) * d, d / 2)
        now = float(stop)
        apart = z - h(x, now, theta)
        logs = -0.5 * (np.where(angles, wrap(apart), apart) ** 2 / S).sum(axis=1)
        w = np.exp(logs - logs.max())
        w /= w.sum()
        mean = w @ x
        means.append(mean)
        deviations.append(np.sqrt(w @ (x - mean) ** 2))
        x = x[np.minimum(np.searchsorted(np.cumsum(w), (rng.random() + np.arange(count)) / count), count - 1)]
    return Moments(np.array(means), np.array(deviations))


def reproduction(found: dict[str, Track], settings: dict[str, Any]) -> Reproduction:
    """Return the figures and what they say."""
    comparisons, rows = list[Comparison](), list[tuple[Any, ...]]()
    for name, track in found.items():
        best = min((one for one in track.points if one.method == TRAIN), key=lambda one: one.error)
        last = track.points[-1]
        said = f"{last.setting} particles: {last.error:.2g} in {last.milliseconds / best.milliseconds:.2g} times as long"
        comparisons.append(Comparison(f"error of the means, {name}", None, best.error, track.reference, said))
        rows += [(name, one.method, one.setting, one.milliseconds, one.error) for one in track.points]
        rows.append((name, "the reference itself", f"2 x {settings['particles']:,}", None, track.reference))
    table = Table(
        "Error of the means, rms over times and coordinates, in standard deviations, and milliseconds of a core for an "
        "observation; the setting is a tolerance or a number of particles",
        ("", "filter", "setting", "ms", "error"),
        tuple(rows),
    )
    warned = [name for name, track in found.items() if track.warnings]
    return Reproduction(
        "Three tracks by tensor trains and by particle filters: error against time",
        f"Nothing is published. The records are simulated, seed {settings['seed']}; the reference is the mean of two bootstrap "
        "filters in NumPy, and the error of a filter contains that of the reference.",
        tuple(comparisons),
        "an error below that of the reference cannot be seen. "
        + (f"tensor-train warns in {', '.join(warned)}." if warned else "tensor-train has no warnings."),
        (table,),
        settings,
    )


def draw(found: dict[str, Track]) -> Any:
    """Draw errors against times."""
    figure = new_figure(11.0, 4.0)
    for panel, (name, track) in zip(figure.subplots(1, len(found), sharey=True), found.items(), strict=True):
        plain(panel)
        for method, colour in COLOURS.items():
            own = [one for one in track.points if one.method == method]
            panel.plot([one.milliseconds for one in own], [one.error for one in own], "o-", color=colour, label=LABELS[method])
            for one in own if method != TRAIN else (own[0], own[-1]):
                place, first = (one.milliseconds, one.error), method == TRAIN and one is own[0]
                side, offset = ("right", (-6, 4)) if first else ("left", (6, -12 if method == TRAIN else 6))
                panel.annotate(one.setting, place, offset, textcoords="offset points", fontsize=8, color=colour, ha=side)
        panel.axhline(track.reference, color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="error of the reference")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.margins(x=0.2)
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("milliseconds of a core, an observation")
    figure.axes[0].set_ylabel("error of the means, in standard deviations")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_densities(model: Model, record: Record, truth: np.ndarray) -> Any:
    """Draw the density of the position of a track that is seen by bearings alone, at some times."""
    result = filter_record(model, record, TRAIN)
    figure = new_figure(11.0, 3.8)
    last = len(record.times)
    chosen = [max(1, round(share * last)) for share in SHOWN]
    for panel, k in zip(figure.subplots(1, len(chosen)), chosen, strict=True):
        result.density(k).marginal(["px", "py"]).plot(ax=panel)
        t, bearing = float(record.times[k - 1]), float(record.values[k - 1, 0])
        observer = 1.2 * np.array([math.cos(0.8 * t), math.sin(0.8 * t)])
        low, high = panel.get_xlim(), panel.get_ylim()
        ray = observer[:, None] + np.array([[math.cos(bearing)], [math.sin(bearing)]]) * np.array([0.0, 100.0])
        panel.plot(*ray, color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="observed bearing")
        panel.plot(*truth[k, :2], "x", color=TRUTH, markersize=9, markeredgewidth=2, label="true position")
        panel.set_xlim(low)
        panel.set_ylim(high)
        panel.set_title(f"t = {t:.1f}, {k} bearings", fontsize=10, loc="left")
    figure.axes[0].legend(frameon=False, fontsize=8)
    return figure
