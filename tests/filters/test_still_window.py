"""Whole runs of the limited direct method on a window that stands still: the numbers of its steps, in less time."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from scipy.linalg import expm

import zakai
from zakai.filters import _lattice_choice, _run, _still_window, limited_direct
from zakai.filters._splitting import bent, bridged
from zakai.filters.observations import data_of, schedule_of

SPIRAL = zakai.load_model("gallery:spiral-sensor")
MOVING = replace(
    limited_direct.METHOD,
    adapt=partial(limited_direct.adapt, still=False),
    adapt_many=partial(limited_direct.adapt_many, still=False),
)


def increments(model, count, seeds=(4,)):
    times = 0.01 * np.arange(1, count + 1)
    return [zakai.simulate(model, times, seed=seed)[1] for seed in seeds]


def same(one, other, close=1e-10):
    assert np.allclose(one.mean, other.mean, rtol=0, atol=close)
    assert np.allclose(one.cov, other.cov, rtol=0, atol=close)
    assert np.allclose(one.log_likelihood_increments, other.log_likelihood_increments, rtol=0, atol=close)


@pytest.fixture
def moved(monkeypatch):
    """How often a run was traced to be taken at once."""
    calls, own = [], _still_window.moved

    def spied(lattice, *rest):
        calls.append(lattice.log_values.shape)
        return own(lattice, *rest)

    monkeypatch.setattr(_still_window, "moved", spied)
    return calls


def test_a_run_at_once_gives_the_numbers_of_its_steps(monkeypatch, moved):
    records = increments(SPIRAL, 300, seeds=(3, 4))
    at_once = [zakai.filter(SPIRAL, record, "limited-direct") for record in records]
    together = zakai.filter(SPIRAL, records, "limited-direct")
    assert moved
    monkeypatch.setattr(limited_direct.State, "together", None)
    # What was compiled for a step is not traced again; this one is another.
    monkeypatch.setattr(limited_direct, "METHOD", replace(limited_direct.METHOD, step=lambda *given: limited_direct.step(*given)))
    for one, other, record in zip(at_once, together, records, strict=True):
        stepwise = zakai.filter(SPIRAL, record, "limited-direct")
        same(one, stepwise)
        same(other, stepwise)
        for k in (1, 150, 300):
            assert np.allclose(one.density(k).mean(), stepwise.density(k).mean(), rtol=0, atol=1e-10)
            assert np.allclose(one.density(k).cov(), stepwise.density(k).cov(), rtol=0, atol=1e-10)
        assert not one.warnings and not other.warnings


@pytest.mark.slow
def test_a_drift_that_is_a_constant_and_noise_that_is_not_one_are_in_the_kernel(moved):
    model = zakai.Model(
        state=["x"], drift=["cos(t) - (1 + t)*x/2"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        process_noise=[["2 + sin(3*t)"]],
        prior={"kind": "mixture", "weights": [0.4, 0.6], "means": [[-1.0], [1.5]], "covs": [[[0.3]], [[0.2]]]},
    )  # fmt: skip
    (record,) = increments(model, 100)
    at_once = zakai.filter(model, record, "limited-direct")
    assert moved
    truth = zakai.filter(model, record, "yau-yau", tolerance=1e-8)
    same(at_once, truth, 5e-6)


@pytest.mark.slow
def test_mass_that_leaves_the_window_is_followed_step_by_step(monkeypatch, moved):
    model = zakai.Model(
        state=["x"], drift=["100"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.1]]},
    )  # fmt: skip
    (record,) = increments(model, 64)
    at_once = zakai.filter(model, record, "limited-direct")
    assert moved
    monkeypatch.setattr(limited_direct, "METHOD", MOVING)
    stepwise = zakai.filter(model, record, "limited-direct")
    # What moves along is of second order only, and says that here this is not enough.
    assert np.abs(at_once.mean - stepwise.mean).max() < 5e-3
    for result in (at_once, stepwise):
        assert result.warnings[0].startswith("splitting exceeded")


def test_mass_that_moves_far_between_two_looks_is_followed_to_the_same_order():
    # Some twenty cells in the steps between two looks, and a prior from which they are at once so many.
    model = zakai.Model(
        state=["x"], drift=["0.3*x"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [25.0], "cov": [[0.04]]},
    )  # fmt: skip
    records = increments(model, 48, seeds=(1, 2))
    together = zakai.filter(model, records, "limited-direct")
    for record, other in zip(records, together, strict=True):
        alone = zakai.filter(model, record, "limited-direct")
        reference = zakai.filter(model, record, "yau-yau", tolerance=1e-6)
        for result in (alone, other):
            assert np.abs(result.mean - reference.mean).max() < 1e-4 * np.sqrt(reference.variance.min())
            assert abs(result.log_likelihood - reference.log_likelihood) < 1e-4
            assert 0 < np.nanmax(result.health["splitting"]) < 1e-3 and not result.warnings


def test_a_way_of_which_the_ends_do_not_tell_is_said():
    # h turns by two radians in an interval.
    model = zakai.Model(
        state=["x"], drift=["-3*x"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [60.0], "cov": [[0.01]]},
    )  # fmt: skip
    (record,) = increments(model, 16)
    result = zakai.filter(model, record, "limited-direct")
    # Simpson's rule less the trapezium's, at the first step, where all is known but for a deviation of 0.1 to each side.
    x = 60.0 + 0.1 * np.array([0.0, 1.0, -1.0])
    ways = x[:, None] * np.array([1.0, (1 + np.exp(-0.03)) / 2, np.exp(-0.03)])
    seen = ways * np.stack([np.sin(ways), np.cos(ways)])
    off = np.tensordot(record.values[0], seen[..., 1] - 0.5 * (seen[..., 0] + seen[..., 2]), 1)
    assert np.isclose(result.health["splitting"][1], np.abs(off).max() * 2 / 3, rtol=0.02)
    assert any(said.startswith("splitting exceeded 0.001") for said in result.warnings)


@pytest.mark.slow
def test_what_the_ends_do_not_tell_is_the_same_where_there_is_another_state(monkeypatch):
    seen = ["x*sin(x)", "x*cos(x)"]
    one = zakai.Model(
        state=["x"], drift=["-3*x"], observation=seen, observation_kind="increments",
        prior={"kind": "gaussian", "mean": [20.0], "cov": [[0.01]]},
    )  # fmt: skip
    two = zakai.Model(
        state=["x", "y"], drift=["-3*x", "-y"], observation=[*seen, "y"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [20.0, 0.0], "cov": [[0.01, 0.0], [0.0, 0.01]]},
    )  # fmt: skip
    (record,) = increments(one, 12)
    both = zakai.Record(record.times, np.column_stack([record.values, np.zeros(12)]), "increments")
    monkeypatch.setattr(limited_direct, "METHOD", MOVING)
    alone = zakai.filter(one, record, "limited-direct").health["splitting"][1:]
    beside = zakai.filter(two, both, "limited-direct").health["splitting"][1:]
    # Their lattices have not the same centres.
    assert np.allclose(beside, alone, rtol=0.1) and alone.min() > 1e-3


def test_records_between_each_others_points_come_to_stand_on_one_lattice():
    (record,) = increments(SPIRAL, 300)
    prepared = limited_direct.prepare(SPIRAL, schedule_of(data_of(SPIRAL, record), True))
    rows = slice(100, 110)
    own = limited_direct.adapt(prepared, limited_direct.init(prepared, SPIRAL.prior), rows, None)
    cell, lattice = own.lattice.basis[0, 0], own.lattice
    apart = np.array([0.0, 0.5, 40.25]) * cell
    states = jax.tree.map(lambda a: np.broadcast_to(a, (3, *np.shape(a))), replace(own, table=None, seen=None))
    states = replace(states, lattice=states.lattice._replace(centre=lattice.centre + apart[:, None]))
    given = limited_direct.density(prepared, own)
    # With the cells that they have, and with finer ones.
    for finer in (1.0, 2.0):
        plan = replace(own.plan, cells=finer * own.cells[0] / 1.25)
        many = limited_direct.adapt_many(prepared, replace(states, plan=plan), rows, None)
        assert many.plan.still and (many.table.cell < cell) == (finer > 1)
        (centres,) = many.lattice.centre.T
        steps = (centres - many.table.home) / many.table.cell
        assert np.allclose(steps, np.rint(steps), rtol=0, atol=1e-6)
        for k in range(3):
            moved = limited_direct.density(prepared, jax.tree.map(lambda a: a[k], replace(many, table=None)))  # noqa: B023
            assert np.allclose(moved.mean() - apart[k], given.mean(), rtol=0, atol=1e-9)
            assert np.allclose(moved.cov(), given.cov(), rtol=0, atol=1e-9)


def test_a_window_is_laid_over_the_mass_by_whole_cells():
    index = np.arange(64) - 32
    table = _still_window.Table(0.0, 0.5, np.zeros((1, 5, 192)))
    logs, place = _still_window.laid_anew(-0.5 * ((index - 9) / 2.0) ** 2, np.array(3), table)
    assert place == 12
    assert np.allclose(logs[:52], -0.5 * (index[:52] / 2.0) ** 2)


def test_where_readings_are_missing_or_h_depends_on_time_steps_are_taken_one_by_one(moved):
    (record,) = increments(SPIRAL, 20)
    values = record.values.copy()
    values[7, 0] = np.nan
    zakai.filter(SPIRAL, zakai.Record(record.times, values, "increments"), "limited-direct")
    assert not moved


@pytest.mark.slow
def test_the_errors_of_the_splitting_are_undone():
    """Readings of a path that runs linearly between two of them, given at finer and finer times, converge to one density."""
    # Later times, farther out, where h is steeper.
    (record,) = increments(zakai.load_model("gallery:spiral-sensor"), 400)

    def refined(parts, method="limited-direct", **options):
        times = np.linspace(0.0, record.times[-1], parts * 400 + 1)[1:]
        fine = zakai.Record(times, np.repeat(record.values, parts, axis=0) / parts, "increments")
        return zakai.filter(SPIRAL, fine, method, keep="moments", **options).mean[parts::parts, 0]

    truth = refined(8)
    errors = [np.sqrt(np.mean((refined(parts) - truth) ** 2)) for parts in (1, 2)]
    # Of Strang's splitting it is 3e-4, with its first error undone 2e-5.
    assert errors[0] < 2e-7 and errors[0] > 8 * errors[1]
    assert np.sqrt(np.mean((refined(1, "yau-yau", tolerance=1e-8) - truth) ** 2)) < 2e-8


def test_the_kernel_between_two_halves_is_that_of_a_brownian_bridge():
    """The corrections of one interval against exp(tau A + b) in the sine functions of a box, where everything is known."""
    longer, shorter = (_error_of_one_interval(tau) for tau in (0.04, 0.02))
    for size in (-3.0, -1.0, 1.0, 3.0):
        # Local errors of the fourth order in tau where b is of the order of its root.
        assert shorter(size, True) < longer(size, True) / 10
        assert shorter(size, True) < 0.1 * shorter(size, False)


def _error_of_one_interval(tau):
    """How far the mean is off, for a likelihood of a size and with or without what is made up for."""
    width, count = 16.0, 240
    x = width * (np.arange(1, count + 1) / (count + 1) - 0.5)
    k = np.arange(1, count + 1)
    sines = np.sqrt(2 / (count + 1)) * np.sin(np.pi * np.outer(k, k) / (count + 1))
    laplace = -sines @ np.diag((np.pi * k / width) ** 2) @ sines
    q = 0.3 * x**2

    def exact(b):
        return expm(tau * (0.5 * laplace - np.diag(q)) + np.diag(b))

    def split(parts, corrected):
        f, *slopes = parts
        half = [0.5 * part for part in parts] if corrected else [0.5 * f, *(np.zeros(count) for _ in slopes)]
        log, bend, twice = (np.asarray(part) for part in bridged(half, tau, -tau * 0.6 * x))
        if not corrected:
            log = 0.5 * f
        kernel = exact(np.zeros(count))
        steps = np.abs(x[:, None] - x)
        first, second = bent(kernel * (steps < 2.0), steps, tau)
        return np.exp(log)[:, None] * (kernel + (bend[:, None] + bend) * first + twice[:, None] * second) * np.exp(log)

    density = np.exp(-((x - 0.3) ** 2) / 0.4)

    def error(size, corrected):
        b = np.array([np.sin(2 * x), 2 * np.cos(2 * x), -4 * np.sin(2 * x), -8 * np.cos(2 * x), 16 * np.sin(2 * x)])
        b *= size * np.sqrt(tau)
        means = [(x @ (kernel @ density)) / np.sum(kernel @ density) for kernel in (exact(b[0]), split(b, corrected))]
        return abs(means[0] - means[1])

    return error


def test_the_steps_that_pad_a_run_change_neither_its_end_nor_what_was_told():
    assert _run.WHOLE % _still_window.LOOK == 0
    (record,) = increments(SPIRAL, 64)
    data = data_of(SPIRAL, record)
    prepared = limited_direct.prepare(SPIRAL, schedule_of(data, True))
    given = limited_direct.observations(prepared, data)
    begin = limited_direct.adapt(prepared, limited_direct.init(prepared, SPIRAL.prior), slice(0, 64), None)
    together = jax.jit(begin.together, static_argnums=3)
    short, (own, _), _ = together(begin, *jax.tree.map(lambda a: a[:32], (prepared.intervals, given)), False, 32, True)
    padded, (told, _), taken = together(begin, prepared.intervals, given, False, 32, True)
    whole, _, _ = together(begin, prepared.intervals, given, False, 64, True)
    assert taken == 32
    assert np.allclose(padded.lattice.log_values, short.lattice.log_values, rtol=0, atol=1e-9)
    assert padded.lattice.centre == short.lattice.centre and not np.allclose(whole.cells, padded.cells, rtol=1e-6)
    assert np.allclose(told.mean[:32], own.mean, rtol=0, atol=1e-12)
    assert np.allclose(told.log_likelihood_increment[:32], own.log_likelihood_increment, rtol=0, atol=1e-12)


def test_the_part_of_a_window_on_which_steps_are_taken_does_not_show(monkeypatch):
    (record,) = increments(SPIRAL, 640, seeds=(5,))
    sizes, own, scan = [], _still_window.seen, _run.scan.function

    def spied(table, at, size):
        sizes.append(size)
        return own(table, at, size)

    monkeypatch.setattr(_still_window, "seen", spied)
    # What was compiled is not traced again; these are others.
    monkeypatch.setattr(_run, "scan", _run.Scan(lambda *given: scan(*given)))
    on_parts = zakai.filter(SPIRAL, record, "limited-direct")
    assert len(set(sizes)) > 2
    sizes.clear()
    monkeypatch.setattr(_still_window, "SHARES", ())
    monkeypatch.setattr(_run, "scan", _run.Scan(lambda *given: scan(*given)))
    on_all = zakai.filter(SPIRAL, record, "limited-direct")
    assert len(set(sizes)) == 1
    same(on_parts, on_all, close=1e-9)


def test_a_run_ends_before_the_steps_that_its_window_does_not_serve(monkeypatch):
    # What is seen of the state grows with it, so that the density gets narrower.
    model = zakai.Model(
        state=["x"], drift=["0.5*x"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.1]]},
    )  # fmt: skip
    records = increments(model, 350, seeds=(5, 6, 7))
    took, own = [], _run.run_steps

    def spied(*rest):
        run = own(*rest)
        took.append(run[0].stop - run[0].start)
        return run

    with monkeypatch.context() as patch:
        patch.setattr(_run, "run_steps", spied)
        alone = [zakai.filter(model, record, "limited-direct") for record in records]
    assert len(took) > len(records)
    together = zakai.filter(model, records, "limited-direct")
    # Runs so short that each finds its window.
    monkeypatch.setattr(_lattice_choice, "STILL_RUN", _still_window.LOOK)
    for one, other, record in zip(alone, together, records, strict=True):
        short = zakai.filter(model, record, "limited-direct")
        same(one, short, close=1e-8)
        same(other, short, close=1e-8)
        assert not one.warnings and not other.warnings and not short.warnings
