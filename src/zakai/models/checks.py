"""Checks of a model that need numbers: noise that is noise, and angles on which everything is periodic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from zakai.errors import InputError
from zakai.models._definite import ROUNDING, is_symmetric, smallest_eigenvalue
from zakai.models.angles import observed_angles
from zakai.models.kept import kept
from zakai.models.numeric import NumericFunction, numpy_function
from zakai.models.prior import DensityPrior

if TYPE_CHECKING:
    from zakai.models.model import Model

COEFFICIENTS = ("diffusion", "process_noise", "observation_noise", "cross_noise")
NoiseCheck = Callable[[np.ndarray, np.ndarray], tuple[int, tuple[str, str]] | None]
WITHIN = 1024  # times inside of intervals at which noise is checked


def check_noise_at(model: Model, times: Any, keys: Sequence[str] = COEFFICIENTS) -> None:
    """Check that the noise of a model (or that of some `keys`) is noise at every given time.

    S(t) must be positive definite, Q(t) and the joint covariance of both noises positive semidefinite, and all finite.
    What depends on the state or on inputs is checked where it is evaluated.

    `times` has shape (K,), in the model's unit of time. Raises InputError naming the model, the key and the
    first time.

        >>> from zakai.models import load_model
        >>> check_noise_at(load_model("gallery:spiral-sensor"), [0.0, 10.0])
    """
    good: set[str] = kept(model, check_noise_at, set)  # the noises that are noise at all times
    for key in keys:
        if key in good or depends_on_state(getattr(model, key), model):
            continue
        problem, varies = _problem(model, key, np.atleast_1d(np.asarray(times, dtype=float))), getattr(model, key).has(model.t)
        if problem:
            index, words = problem
            when = f" at t = {np.atleast_1d(times)[index]:.12g}" if varies else ""
            raise InputError(f"{model.source}: {key}: {words[0]}{when}{words[1]}")
        if not varies:
            good.add(key)


def check_noise_within(model: Model, times: np.ndarray) -> None:
    """`check_noise_at` some times inside of every interval between the model's start and the times (K,).

    The noise of samples need only be one when they are taken.
    """
    edges = np.unique(np.concatenate([[model.start], times]))
    keys = COEFFICIENTS[:2] if model.observation_kind == "samples" else COEFFICIENTS
    if len(edges) > 1 and any(getattr(model, key).has(model.t) for key in keys):
        count = max(1, WITHIN // (len(edges) - 1))
        check_noise_at(model, (edges[:-1, None] + np.diff(edges)[:, None] * irregular(count)).ravel(), keys)


def irregular(count: int) -> np.ndarray:
    """Places (count,) in (0, 1), increasing and not at equal distances: what has a period is seen at all its phases."""
    places = np.arange(count)
    return (places + 0.5 + 0.4 * np.sin(7.0 * places)) / count


def check_constant_noise(model: Model) -> None:
    """The checks of `check_noise_at` for the matrices that do not depend on time; errors name the key."""
    for key in COEFFICIENTS:
        matrix = getattr(model, key)
        if not matrix.has(model.t) and not matrix.atoms(AppliedUndef) and not depends_on_state(matrix, model):
            problem = _problem(model, key, np.array([model.start]))
            if problem:
                raise InputError(f"{key}: {problem[1][0]}{problem[1][1]}")


def _problem(model: Model, key: str, times: np.ndarray) -> tuple[int, tuple[str, str]] | None:
    """Return the first time at which the matrix is not what it must be, and the words before and after that time."""
    check = noise_check(model, key)
    return None if check is None else check(times, model.theta())


def noise_check(model: Model, key: str) -> NoiseCheck | None:
    """Return what `_problem` does as a function of the times and the parameters; None where there is nothing to check."""
    matrix, m, rows = getattr(model, key), model.m, getattr(model, key).shape[0]
    varies, state = matrix.has(model.t), np.zeros(model.n)
    entries = matrix.todok()
    if key == "cross_noise" and not entries:
        return None
    alone = key == "diffusion" or key != "cross_noise" and all(row == column for row, column in entries)
    # Each entry is a matrix of its own: independent noises of a hundred states at a thousand times need no eigenvalues.
    each = list(entries.values() if key == "diffusion" else matrix.diagonal()) if alone else matrix
    function = numpy_function(each, model) if alone else numpy_function(matrix, model, matrix.shape)
    joint = joint_covariance(model) if key == "cross_noise" else None

    def check(times: np.ndarray, theta: np.ndarray) -> tuple[int, tuple[str, str]] | None:
        times = times if varies else times[:1]
        values = function(state, times, theta)
        matrices = values[..., None, None] if alone else values[:, None]
        finite = np.isfinite(matrices).all(axis=(-3, -2, -1))
        if not finite.all():
            return int(np.argmin(finite)), ("is not finite", "")
        if key == "diffusion":
            return None
        if joint is not None:
            both = joint(state, times, theta)
            good = smallest_eigenvalue(both) >= -ROUNDING * both.shape[-1]
            words = ("is larger than process_noise and observation_noise allow", "; a correlation is at most 1 in size")
            return None if good.all() else (int(np.argmin(good)), words)
        symmetric = is_symmetric(matrices).all(axis=-1)
        if not symmetric.all():
            return int(np.argmin(symmetric)), ("is not symmetric", "")
        smallest = smallest_eigenvalue(matrices).min(axis=-1)
        if key == "observation_noise":
            good = smallest > ROUNDING * m
            words = ("is not positive definite", "; every direction of the observation needs noise of its own")
        else:
            good = smallest >= -ROUNDING * rows
            words = ("is not positive semidefinite", "; a covariance has no negative direction")
        return None if good.all() else (int(np.argmin(good)), words)

    return check


def joint_covariance(model: Model) -> NumericFunction:
    """Return the covariance [[Q, C], [C', S]] of dv and dw per unit time, as a function of x, t and theta."""
    upper = model.process_noise.row_join(model.cross_noise)
    matrix = upper.col_join(model.cross_noise.T.row_join(model.observation_noise))
    return numpy_function(matrix, model, matrix.shape)


def depends_on_state(matrix: sympy.MatrixBase, model: Model) -> bool:
    """Return whether a matrix depends on the state, on inputs or on the observed path."""
    return bool(matrix.free_symbols & {*model.x, *model.u, *model.z})


def check_periodic(model: Model) -> None:
    """Check that drift, noise, observation and a prior density are 2 pi-periodic in every angle, at random points.

    Raises InputError naming the entry. Undetermined functions are taken as periodic.
    """
    if not model.periodic:
        return
    rng = np.random.default_rng(0)
    entries = [(f"drift[{i}]", expr) for i, expr in enumerate(model.drift)]
    families, angles = model.observation_family, observed_angles(model)
    for i, (expr, family, wraps) in enumerate(zip(model.observation, families, angles, strict=True)):
        # The mean direction of an angle is an angle.
        parts = (sympy.sin(expr), sympy.cos(expr)) if family == "von-mises" or wraps else (expr,)
        entries += [(f"observation[{i}]", part) for part in parts]
    for key in ("diffusion", "observation_noise"):
        entries += [(f"{key}[{i}][{j}]", expr) for (i, j), expr in sorted(getattr(model, key).todok().items())]
    entries += [("observation_log_density", model.log_density)] if model.log_density is not None else []
    if isinstance(model.prior, DensityPrior):
        entries.append(("prior: log_density", model.prior.log_density))
    for angle in model.periodic:
        column = model.state.index(angle)
        x = rng.normal(size=(24, model.n)) * 3
        x[:, column] = rng.uniform(-np.pi, np.pi, size=24)
        turned = x.copy()
        turned[:, column] += 2 * np.pi * rng.choice([-2, -1, 1, 3], size=24)
        t = model.start + rng.uniform(0, 10, size=24)
        u, z = rng.normal(size=(24, len(model.u))), rng.integers(0, 2, size=(24, len(model.z)))
        for place, expr in entries:
            if not expr.has(model.x[column]) or expr.atoms(AppliedUndef):
                continue
            value = numpy_function([expr], model, ())
            here, there = value(x, t, model.theta(), u, z), value(turned, t, model.theta(), u, z)
            with np.errstate(invalid="ignore"):
                same = (np.abs(here - there) <= 1e-8 * (1 + np.abs(here))) | (~np.isfinite(here) & ~np.isfinite(there))
            if not same.all():
                said = f"{str(expr)[:60]} is not 2*pi-periodic in {angle!r}, which is listed in periodic"
                turns = bool(np.all(np.abs(np.sin(0.5 * (here - there))) <= 1e-8 * (1 + np.abs(here))))
                raise InputError(f"{place}: {said}; {_instead(model, place, turns, angle)}")


def _instead(model: Model, place: str, turns: bool, angle: str) -> str:
    """Return what to write instead of a formula that is not periodic; `turns` says that it changes by whole turns."""
    if place.startswith("observation[") and turns and model.observation_kind == "samples":
        return 'list the observation in observed_angles, or set observation_family = "von-mises"'
    return f"write it in cos({angle}) and sin({angle}), or leave {angle} out of periodic"


def check_independent_of_state(key: str, model: Model) -> None:
    """Raise InputError at the first entry of a matrix that depends on the state or on an input, with what to write instead."""
    matrix, others = getattr(model, key), {*model.x, *model.u}
    for (row, column), expr in sorted(matrix.todok().items()):
        found = expr.free_symbols & others
        if found:
            name = min(str(symbol) for symbol in found)
            what = "state" if name in model.state else "input"
            may = "it may depend on t and on parameters only"
            if key == "process_noise":
                may += "; multiply the column of diffusion by the square root of the variance, there it may"
            elif what == "input":
                may += "; give the known signal as a table of t"
            raise InputError(f"[{row}][{column}]: depends on the {what} {name!r}; {may}")
