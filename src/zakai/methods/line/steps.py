"""The coefficients in time of intervals that the compiled loop of one-state filters reads."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zakai.methods.line.system import Coefficients, Prepared
from zakai.methods.line.tables import finite
from zakai.models.prior import GaussianPrior
from zakai.numerics.complex_step import log_determinant
from zakai.numerics.line.channel import packed
from zakai.numerics.line.filters import kernel_size
from zakai.numerics.line.panels import GAUSS_NODES, interpolation
from zakai.numerics.line.segment import FACTOR, KERNEL, SPLIT, SPLIT_FACTOR, Steps

RESOLVED = 1e-8  # relative error of the interpolants of coefficients in time
MOST_PARTS = 16  # in which an interval is cut at a time
PROBES = np.linspace(0.0, 1.0, 129)  # parts of an interval at which coefficients are compared with their interpolants



def coefficients_of(prepared: Prepared) -> Coefficients:
    """Return what the loop needs of the coefficients in time of all intervals."""
    schedule, system, theta = prepared.schedule, prepared.system, prepared.theta
    count, seen, m = len(schedule), schedule.seen, system.m
    starts, lengths, stops = schedule.starts[:, None], prepared.lengths[:, None], schedule.stops[:, None]
    if prepared.timed:
        nodes = np.clip(starts + lengths * GAUSS_NODES, starts, np.nextafter(stops, starts))
        t = np.concatenate([nodes, stops, probed(starts, stops)], axis=1)
    else:
        t = np.concatenate([np.full((count, 1), prepared.model.start), stops], axis=1)
    size = len(GAUSS_NODES) if prepared.timed else 1
    own, probes, ends = slice(size), slice(size + 1, None), slice(size, size + 1) if system.samples else slice(size)
    if not system.samples and system.steady_observation and system.steady_noise:
        ends = slice(1)

    def everywhere(function: Callable[..., np.ndarray], steady: bool) -> np.ndarray:
        """Return a function of time alone at all times."""
        found = function(_X, t[:1, :1] if steady else t, theta)
        return np.broadcast_to(found, (*t.shape, *found.shape[2:]))

    def precision(noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if system.general:  # the loop takes only intervals without observations
            return np.zeros((*noise.shape[:2], m, m)), np.zeros(count)
        both = (seen[:, :, None] & seen[:, None])[:, None]
        block = np.where(both, noise, 0.0) + np.eye(m) * ~seen[:, None, :, None]
        constant = np.zeros(count)
        if system.samples:
            constant = -0.5 * (log_determinant(block[:, 0]) + np.log(2 * np.pi) * seen.sum(axis=1))
        return np.where(both, np.linalg.inv(block), 0.0), constant

    if prepared.mixed:  # the terms of the table are those at the nodes and at the end
        factors = np.broadcast_to(np.eye(size + 1), (count, size + 1, size + 1))
    else:
        assert system.separated is not None
        factors = everywhere(system.separated[0], False)
    G = everywhere(system.covariance, system.steady_covariance)[..., 0, 0] if prepared.divides else np.zeros(t.shape)
    noise = everywhere(system.noise, system.steady_noise)
    precisions, constants = precision(noise[:, ends])
    parts = np.ones(count, int)
    if prepared.timed and count:
        terms = _mixed_terms(prepared, t) if prepared.mixed else factors
        parts = parts_needed(terms[:, probes], terms[:, own])
        if not system.steady_covariance:
            parts = np.maximum(parts, parts_needed(G[:, probes, None], G[:, own, None]))
        if not (system.samples or system.steady_noise):
            parts = np.maximum(parts, parts_needed(precision(noise[:, probes])[0], precisions))
    drifts, outputs, covariances = (np.array(part, order="C") for part in (factors[:, own], factors[:, ends], G[:, own]))
    return Coefficients(drifts, outputs, covariances, precisions, constants, parts)


_X = np.zeros((1, 1, 1))


def _mixed_terms(prepared: Prepared, t: np.ndarray) -> np.ndarray:
    """Return f, and h of increments, at times (K, T) and points where the state may be (K, T, C)."""
    system, prior = prepared.system, prepared.model.prior
    points = np.linspace(-np.pi, np.pi, 9)
    if isinstance(prior, GaussianPrior) and not prepared.model.domain and not prepared.model.periodic:
        points = float(prior.mean[0]) + np.linspace(-5.0, 5.0, 9) * float(np.sqrt(prior.cov[0, 0]))
    terms = system.drift(points[:, None], t[..., None], prepared.theta)
    if not system.samples:
        terms = np.concatenate([terms, system.observation(points[:, None], t[..., None], prepared.theta)], axis=-1)
    return np.asarray(finite(terms).reshape(*t.shape, -1))


def probed(starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return times (K, P) at which coefficients are compared with their interpolants, of which the last are before the ends."""
    return np.asarray(np.clip(starts + (stops - starts) * PROBES, starts, np.nextafter(stops, starts)))


def parts_needed(exact: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return in how many parts (K,) interpolants of values at nodes (K, Q, ...) agree with probes (K, P, ...), 0 for never."""
    exact, nodes = exact.reshape(*exact.shape[:2], -1), nodes.reshape(*nodes.shape[:2], -1)
    scale = np.maximum(np.abs(exact).max(axis=1), 1e-300)
    rest = np.abs(_TO_PROBES @ nodes - exact).max(axis=1) / scale
    excess = rest.max(axis=1) / RESOLVED
    more = np.ceil(1.1 * np.nan_to_num(excess) ** (1.0 / len(GAUSS_NODES)))
    return np.where(excess <= 1.0, 1, np.where(np.isfinite(excess), np.clip(more, 2, MOST_PARTS), 0)).astype(int)


_TO_PROBES = interpolation(PROBES)


def kinds_of(prepared: Prepared) -> np.ndarray:
    """Return how the compiled loop of `line/loop.py` takes each interval (K,), -1 where it does not."""
    system, schedule, yau, kernels = prepared.system, prepared.schedule, prepared.yau, prepared.kernels
    positive = prepared.lengths > 0
    none = np.full(len(schedule), -1)
    if not len(schedule) or np.iscomplexobj(prepared.theta) or prepared.lie or (prepared.model.periodic and not system.samples):
        return none
    silent = ~schedule.seen.any(axis=1)
    regular = positive & np.all(schedule.seen == prepared.inside, axis=1)
    if not prepared.gaussian:
        usable = system.samples and not system.moving and system.separated is not None
        return np.where(positive, FACTOR, -1) if usable else none
    if system.separated is None and not prepared.mixed:
        return none
    whole = np.zeros(len(schedule), bool)
    if kernels is not None and yau is not None and yau.unobserved and yau.steady_gauge:
        whole = positive & (kernels.place >= 0) & (kernels.errors[kernels.place] == 0)
    split = positive & prepared.divides & (prepared.coefficients.parts == 1)
    if system.samples:
        whole = whole & (silent | (not system.general))
        return np.where(whole, FACTOR, np.where(split, SPLIT_FACTOR, -1))
    inside = np.where(whole, KERNEL, -1) if yau is not None and yau.affine else np.where(split, SPLIT, -1)
    return np.where(silent, np.where(whole, FACTOR, inside), np.where(regular, inside, -1))


def steps_of(prepared: Prepared) -> Steps:
    """Return what the compiled loop reads of all intervals."""
    kinds, kernels, c = prepared.kinds, prepared.kernels, prepared.coefficients
    inputs = 1 + prepared.system.m
    parameters = np.full((len(kinds), kernel_size(inputs)), np.nan)
    here = np.flatnonzero((kinds == KERNEL) | (kinds == FACTOR))
    if prepared.gaussian and kernels is not None and len(here):
        parameters[here] = packed(kernels.transitions, kernels.place[here])
    precisions = np.where((kinds == KERNEL)[:, None, None, None], 0.0, c.precisions)
    lengths = np.ascontiguousarray(prepared.lengths)
    shares = np.ones(len(kinds)) if prepared.shares is None else prepared.shares
    return Steps(kinds, lengths, shares, precisions, c.constants, parameters, c.drifts, c.outputs, c.covariances)
