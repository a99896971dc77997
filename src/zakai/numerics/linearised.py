"""A Gaussian that follows a linearised system over many intervals, compiled: the step of `methods/gaussian/extended/filter.py`.

Formulas are data (`numerics/formula_points.py`).  A part of an interval moves by the exact flow of

    dx = (A (x - c) + a s + f) ds + dv,

the exponential of the matrix of (x - c, s, 1) by its series and by squaring.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_points import evaluate, read, slots_of
from zakai.numerics.small_matrices import congruence, dot, multiply
from zakai.numerics.transition import Array

_STEP = 0.25  # largest norm of a matrix whose exponential is a series
_TERMS = 24  # of a series, which ends where they are negligible
_MOST_SQUARINGS, _FEW_SQUARINGS = 60, 6


@helper
def halvings(matrix: Array, n: int, length: float) -> int:  # pragma: no cover
    """Return how often a length is halved until the exponential of the first block (n, n) is a short series."""
    norm = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(matrix[i, j])
        norm = max(norm, row)
    norm, count = norm * abs(length), 0
    while norm > _STEP and count < _MOST_SQUARINGS:
        norm, count = 0.5 * norm, count + 1
    return count


@kernel("void(f8[:, ::1], f8[:, ::1], f8, f8[:, ::1], f8[:, ::1])")
def exponential(matrix: Array, noise: Array, length: float, out: Array, spread: Array) -> None:  # pragma: no cover
    """Set `out` (N, N) to exp(matrix length), and `spread` (n, n) to int exp(A s) noise exp(A's) ds; A is the first block."""
    size, n = len(matrix), len(noise)
    count = halvings(matrix, n, length)
    step = length / 2.0**count
    term, work = np.zeros((size, size)), np.empty((size, size))
    for i in range(size):
        term[i, i] = 1.0
        for j in range(size):
            out[i, j] = term[i, j]
    for k in range(1, _TERMS):
        multiply(work, matrix, term)
        largest = 0.0
        for i in range(size):
            for j in range(size):
                term[i, j] = work[i, j] * step / k
                out[i, j] += term[i, j]
                largest = max(largest, abs(term[i, j]) / (1.0 + abs(out[i, j])))
        if not largest > 1e-18:
            break
    change, block, product = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(n):
            change[i, j] = spread[i, j] = step * noise[i, j]
            block[i, j] = matrix[i, j]
    for k in range(2, _TERMS + 4):
        multiply(product, block, change)
        largest, whole = 0.0, 0.0
        for i in range(n):
            for j in range(n):
                change[i, j] = (product[i, j] + product[j, i]) * step / k
                spread[i, j] += change[i, j]
                largest, whole = max(largest, abs(change[i, j])), max(whole, abs(spread[i, j]))
        if not largest > 1e-18 * whole:
            break
    for _ in range(count):
        for i in range(n):
            for j in range(n):
                block[i, j] = out[i, j]
        congruence(change, block, spread, product)
        for i in range(n):
            for j in range(n):
                spread[i, j] += change[i, j]
        multiply(work, out, out)
        for i in range(size):
            for j in range(size):
                out[i, j] = work[i, j]


@kernel("void(f8[:, ::1], i8, f8, f8[::1])")
def move(matrix: Array, n: int, length: float, x: Array) -> None:  # pragma: no cover
    """Set x (N,) to exp(matrix length) x; the first block of the matrix is (n, n)."""
    size = len(matrix)
    count = halvings(matrix, n, length)
    term, work = np.empty(size), np.empty(size)
    if count > _FEW_SQUARINGS:
        out, nothing = np.empty((size, size)), np.zeros((n, n))
        exponential(matrix, nothing, length, out, np.empty((n, n)))
        for i in range(size):
            term[i] = dot(out[i], x)
        for i in range(size):
            x[i] = term[i]
        return
    step = length / 2.0**count
    for _ in range(2**count):
        for i in range(size):
            term[i] = x[i]
        for k in range(1, _TERMS):
            largest = 0.0
            for i in range(size):
                work[i] = dot(matrix[i], term) * step / k
            for i in range(size):
                term[i] = work[i]
                x[i] += term[i]
                largest = max(largest, abs(term[i]) / (1e-300 + abs(x[i])))
            if not largest > 1e-18:
                break


@helper
def root(cov: Array, out: Array) -> bool:  # pragma: no cover
    """Set `out` to Cholesky's factor, with a column of zeros where no variance is left; return whether all is positive."""
    n, positive = len(cov), True
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
    for j in range(n):
        rest = cov[j, j]
        for a in range(j):
            rest -= out[j, a] * out[j, a]
        if not rest > 1e-14 * cov[j, j] or not rest > 0.0:
            positive = False
            continue
        out[j, j] = np.sqrt(rest)
        for i in range(j + 1, n):
            rest = cov[i, j]
            for a in range(j):
                rest -= out[i, a] * out[j, a]
            out[i, j] = rest / out[j, j]
    return positive


@helper
def points(mean: Array, cov: Array, factor: Array, out: Array) -> None:  # pragma: no cover
    """Set `out` (2 n, n) to the points of the cubature rule of degree three."""
    n = len(mean)
    root(cov, factor)
    for i in range(n):
        for d in range(n):
            step = np.sqrt(n) * factor[d, i]
            out[i, d], out[n + i, d] = mean[d] + step, mean[d] - step


@helper
def turned(angle: float) -> float:  # pragma: no cover
    """Return an angle in (-pi, pi]."""
    return angle + 2.0 * np.pi * np.floor((np.pi - angle) / (2.0 * np.pi))


@helper
def log_normal(factor: Array, positive: bool, values: Array) -> float:  # pragma: no cover
    """Set values (m,) to L^-1 values, and return -|L^-1 values|^2 / 2 - log det L, NaN where the covariance is not positive."""
    total = 0.0 if positive else np.nan
    for i in range(len(values)):
        for a in range(i):
            values[i] -= factor[i, a] * values[a]
        values[i] /= factor[i, i]
        total -= 0.5 * values[i] * values[i] + np.log(factor[i, i])
    return total


@helper
def worse(worst: float, change: float, scale: float) -> float:  # pragma: no cover
    """Return the larger of a figure and |change| / scale, infinite where that is not a number; zero scales do not count."""
    if scale <= 0.0:
        return worst
    value = abs(change) / scale
    return max(worst, value) if value == value else np.inf


@kernel(
    "void(UniTuple(Tuple((i8[:, ::1], f8[::1], i8[::1], i8[::1], f8[::1])), 5), Tuple((b1[::1], b1[::1], b1)),"
    " Tuple((i8[::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, :, ::1])),"
    " Tuple((f8[::1], f8[::1], f8[:, ::1], b1[:, ::1], b1[:, ::1], f8[:, ::1], f8[:, :, ::1])),"
    " f8[:, ::1], f8[::1], f8[:, ::1], Tuple((f8[:, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1])))"
)
def segment(
    programs: Any, kinds: Any, parts: Any, intervals: Any, values: Array, mean: Array, cov: Array, after: Any
) -> None:  # pragma: no cover
    """Advance a Gaussian over R intervals.

    Args:
        programs: f, df/dx, G and the derivatives of f by t and by inputs; h and dh/dx; f; h; S, without outputs where it does not
            depend on the state.
        kinds: The states (n,) that are angles, the observations (m,) that are, and whether the observations are samples.
        parts: The first part (R + 1) of each interval, and of the J parts the starts, the lengths, the inputs (J, p) at the
            start, their derivatives, and the covariances (J, 2, m, m) of the rates in both halves.
        intervals: The stops and the lengths (R,), the inputs (R, p) at the stops, the coordinates (R, m) that act inside, those
            that act at the end with their spans, and the covariance (R, m, m) at the end.
        values: What is observed (R, m), zero where nothing is.
        mean: The mean (n,) before, which is overwritten.
        cov: The covariance (n, n), likewise.
        after: What is written: the means (R, n) and the covariances (R, n, n) after each interval, the increments (R,) of the
            log-likelihood, and two figures (2, R), how far from linear the system is
            (`methods/gaussian/extended/linearisation.py`), and the largest weight of another image of an angle
            (`models/angles.py`).
    """
    periodic, angles, samples = kinds
    means, covs, gains, figures = after
    motion, sensor, drift, observation, noise = programs
    first, starts, lengths, inputs, rates, rate_noise = parts
    stops, spans_of_time, end_inputs, inside, at_end, spans, end_noise = intervals
    n, m, p, width = len(mean), values.shape[1], inputs.shape[1], 2 * len(mean)
    in_motion, in_sensor, in_drift = slots_of(motion, 1), slots_of(sensor, 1), slots_of(drift, width)
    in_observation, in_noise, has_noise = slots_of(observation, width), slots_of(noise, 1), noise[3].size > 0
    matrix, flow, spread = np.zeros((n + 2, n + 2)), np.empty((n + 2, n + 2)), np.empty((n, n))
    slope, G, change, f = np.empty((n, n)), np.empty((n, n)), np.empty((n, 1 + p)), np.empty((n, 1))
    h, H, across, gain = np.empty((m, 1)), np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    V, factor, S, residual = np.empty((m, m)), np.empty((m, m)), np.empty((m, m)), np.empty(m)
    keep, product, phi, corner = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    centre, one, cloud, moved, u = np.empty((1, n)), np.empty((1, n)), np.empty((width, n)), np.empty(n + 2), np.empty(p)
    before, before_cov, observed, weights = np.empty(n), np.empty((n, n)), np.empty(m), np.empty(m)
    shift, excess, small = np.empty(n + 2), np.empty(n + 2), np.zeros((n + 2, n + 2))

    for row in range(len(values)):
        total, any_inside, any_end, inside_figure = 0.0, False, False, 0.0
        figures[1, row] = 0.0
        for i in range(m):
            any_inside, any_end = any_inside or inside[row, i], any_end or at_end[row, i]
        for i in range(n):
            before[i] = mean[i]
            for j in range(n):
                before_cov[i, j] = cov[i, j]
        begin, last = first[row], first[row + 1]
        span = spans_of_time[row]
        # Of a part: half of the factor of the observations inside (stage 0), the motion, and the other half (stage 1); after the
        # parts the observations at the end (stage 2).
        for j in range(begin, last + 1):
            for stage in range(2 if j < last else 1):
                last_one = j == last
                if not last_one and stage == 1:
                    # The mean in the middle, to second order, is where the system is linearised.
                    length, start = lengths[j], starts[j]
                    for i in range(n):
                        centre[0, i] = mean[i]
                    for half in range(2):
                        clock = start if half == 0 else start + 0.5 * length
                        for i in range(p):
                            u[i] = inputs[j, i] + (clock - start) * rates[j, i]
                        evaluate(motion, in_motion, centre, 1, clock, u)
                        read(motion, in_motion, 0, f)
                        read(motion, in_motion, n, slope)
                        read(motion, in_motion, n + n * n, G)
                        read(motion, in_motion, n + 2 * n * n, change)
                        for i in range(n):
                            for d in range(n):
                                matrix[i, d] = slope[i, d]
                            matrix[i, n] = change[i, 0]
                            for d in range(p):
                                matrix[i, n] += change[i, 1 + d] * rates[j, d]
                            matrix[i, n + 1] = f[i, 0]
                            moved[i] = mean[i] - centre[0, i]
                        matrix[n, n + 1] = 1.0
                        moved[n], moved[n + 1] = start - clock, 1.0
                        if half == 0:
                            move(matrix, n, 0.5 * length, moved)
                            for i in range(n):
                                centre[0, i] += moved[i]
                    exponential(matrix, G, length, flow, spread)
                    for i in range(n):
                        mean[i] = centre[0, i] + dot(flow[i], moved)
                        if periodic[i]:
                            mean[i] = turned(mean[i])
                        for d in range(n):
                            phi[i, d] = flow[i, d]
                    congruence(cov, phi, cov, product)
                    for i in range(n):
                        for d in range(n):
                            cov[i, d] += spread[i, d]
                if last_one:
                    # How far the system is from linear over the density, in the motion and in what is observed.
                    worst = 0.0
                    if last > begin:
                        for i in range(p):
                            u[i] = inputs[begin, i]
                        for i in range(n):
                            one[0, i] = before[i]
                        evaluate(motion, in_motion, one, 1, starts[begin], u)
                        read(motion, in_motion, 0, f)
                        read(motion, in_motion, n, slope)
                        points(before, before_cov, corner, cloud)
                        evaluate(drift, in_drift, cloud, width, starts[begin], u)
                        for i in range(n):
                            average, twice = 0.0, 0.0
                            for q in range(width):
                                apart = in_drift[drift[3][i], q] - f[i, 0]
                                average += apart / width
                                twice += 2.0 * (cloud[q, i] - before[i]) * apart / width
                            shift[i], excess[i] = 0.0, 0.0
                            small[i, n], small[i, n + 1] = average, twice - 2.0 * dot(slope[i], before_cov[i])
                        for way in range(2):
                            for i in range(n):
                                for d in range(n):
                                    matrix[i, d] = (1.0 + way) * slope[i, d]
                                matrix[i, n], matrix[i, n + 1] = 0.0, small[i, n + way]
                            matrix[n, n + 1] = 0.0
                            if way == 0:
                                shift[n], shift[n + 1] = 0.0, 1.0
                                move(matrix, n, span, shift)
                            else:
                                excess[n], excess[n + 1] = 0.0, 1.0
                                move(matrix, n, span, excess)
                        for i in range(n):
                            worst = worse(worst, shift[i], np.sqrt(max(cov[i, i], 0.0)))
                            worst = worse(worst, excess[i], cov[i, i])
                    figures[0, row] = worst
                if not (any_end if last_one else any_inside):
                    continue
                # What is observed: values, spans, and the covariance of its noise.
                clock = stops[row] if last_one else starts[j] + stage * lengths[j]
                for i in range(p):
                    u[i] = end_inputs[row, i] if last_one else inputs[j, i] + (clock - starts[j]) * rates[j, i]
                for i in range(n):
                    one[0, i] = mean[i]
                evaluate(sensor, in_sensor, one, 1, clock, u)
                read(sensor, in_sensor, 0, h)
                read(sensor, in_sensor, m, H)
                if last_one and has_noise:
                    evaluate(noise, in_noise, one, 1, clock, u)
                    read(noise, in_noise, 0, S)
                for i in range(m):
                    acts = at_end[row, i] if last_one else inside[row, i]
                    weights[i] = (spans[row, i] if last_one else 1.0) if acts else 0.0
                    observed[i] = (values[row, i] if last_one else values[row, i] / span) if acts else 0.0
                    for d in range(m):
                        if not last_one:
                            S[i, d] = rate_noise[j, stage, i, d]
                        elif not has_noise:
                            S[i, d] = end_noise[row, i, d]
                        elif not (acts and at_end[row, d]):
                            S[i, d] = 1.0 if i == d else 0.0
                # The figure of the sensor, at the start of an interval for what acts inside of it.
                if last_one or (j == begin and stage == 0):
                    points(mean, cov, corner, cloud)
                    evaluate(observation, in_observation, cloud, width, clock, u)
                    worst = 0.0
                    for i in range(m):
                        bias, square = 0.0, 0.0
                        for q in range(width):
                            apart = weights[i] * (in_observation[observation[3][i], q] - h[i, 0])
                            apart = turned(apart) if angles[i] else apart
                            bias += apart / width
                            square += apart * apart / width
                        linear = 0.0
                        for d in range(n):
                            linear += weights[i] * H[i, d] * weights[i] * dot(cov[d], H[i])
                        variance = linear + (S[i, i] if last_one else 0.5 * S[i, i])
                        worst = worse(worst, bias, np.sqrt(max(variance, 0.0)))
                        worst = worse(worst, square - bias * bias - linear, variance)
                    if last_one:
                        figures[0, row] = max(figures[0, row], worst)
                    else:
                        inside_figure = worst
                # The Kalman update in Joseph's form.
                for i in range(m):
                    residual[i] = observed[i] - weights[i] * h[i, 0]
                    if angles[i]:
                        residual[i] = turned(residual[i])
                    for d in range(n):
                        H[i, d] *= weights[i]
                multiply(across, H, cov)
                for i in range(m):
                    for d in range(m):
                        V[i, d] = dot(across[i], H[d]) + S[i, d]
                for i in range(m):
                    if angles[i] and weights[i] != 0.0:
                        least = max(2.0 * np.pi - 2.0 * abs(residual[i]), 0.0)
                        figures[1, row] = max(figures[1, row], np.exp(-np.pi * least / V[i, i]))
                positive = root(V, factor)
                total += log_normal(factor, positive, residual)
                for d in range(n):
                    for i in range(m):
                        gain[i, d] = across[i, d]
                        for a in range(i):
                            gain[i, d] -= factor[i, a] * gain[a, d]
                        gain[i, d] /= factor[i, i]
                for i in range(m - 1, -1, -1):
                    for a in range(i + 1, m):
                        residual[i] -= factor[a, i] * residual[a]
                        for d in range(n):
                            gain[i, d] -= factor[a, i] * gain[a, d]
                    residual[i] /= factor[i, i]
                    for d in range(n):
                        gain[i, d] /= factor[i, i]
                for d in range(n):
                    for i in range(m):
                        mean[d] += across[i, d] * residual[i]
                    if periodic[d]:
                        mean[d] = turned(mean[d])
                for i in range(n):
                    for d in range(n):
                        keep[i, d] = 1.0 if i == d else 0.0
                        for a in range(m):
                            keep[i, d] -= gain[a, i] * H[a, d]
                congruence(cov, keep, cov, product)
                multiply(across, S, gain)
                for i in range(n):
                    for d in range(i + 1):
                        for a in range(m):
                            cov[i, d] += gain[a, i] * across[a, d]
                        cov[d, i] = cov[i, d]
                if samples:
                    for i in range(m):
                        if weights[i] != 0.0:
                            total -= 0.5 * np.log(2.0 * np.pi)
                else:
                    positive = root(S, factor)
                    total -= log_normal(factor, positive, observed)
        if any_inside:
            figures[0, row] = max(figures[0, row], inside_figure)
        gains[row] = total
        for i in range(n):
            means[row, i] = mean[i]
            for j in range(n):
                covs[row, i, j] = cov[i, j]
