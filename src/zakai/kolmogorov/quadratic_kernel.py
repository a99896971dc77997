"""Kernels that are exponentials of a quadratic, and what it is to apply one after another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.kolmogorov.taylor import apply, dot, symmetric, transpose


class KernelCoefficients(NamedTuple):
    """log K(x, y) = x'A x + x'B y + y'C y + D.x + E.y + s, where v(stop, x) = int K(x, y) v(start, y) dy.

    A and C are symmetric (..., n, n), B is (..., n, n), D and E are (..., n), s is (...).  `order` is the
    power at which the series was cut; `remainder` (...) estimates the sum of the terms left out, the state in
    units in which G is the identity.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    E: np.ndarray
    s: np.ndarray
    order: int
    remainder: np.ndarray

    def part(self, index: int | slice) -> KernelCoefficients:
        """The kernels at `index` of the first axis of the batch."""
        A, B, C, D, E, s, order, remainder = self
        return KernelCoefficients(
            A[index], B[index], C[index], D[index], E[index], s[index], order, remainder[index]
        )


def log_kernel(kernel: KernelCoefficients, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """log K(x_i, y_j) for points x (k, n) and y (l, n), shape (k, l), of one kernel."""
    ends = dot(x @ kernel.A, x) + x @ kernel.D + kernel.s
    starts = dot(y @ kernel.C, y) + y @ kernel.E
    return ends[:, None] + x @ kernel.B @ y.T + starts


def compose(second: KernelCoefficients, first: KernelCoefficients) -> KernelCoefficients:
    """The kernel of `first` and then `second`: the Gaussian integral int K2(x, z) K1(z, y) dz."""
    middle = -(second.C + first.A)
    width = np.linalg.inv(middle)
    e = second.E + first.D
    after, before = 0.5 * second.B @ width, 0.5 * transpose(first.B) @ width
    volume = middle.shape[-1] * np.log(np.pi) - np.linalg.slogdet(middle)[1]
    return KernelCoefficients(
        A=symmetric(second.A + 0.5 * after @ transpose(second.B)),
        B=after @ first.B,
        C=symmetric(first.C + 0.5 * before @ first.B),
        D=second.D + apply(after, e),
        E=first.E + apply(before, e),
        s=second.s + first.s + 0.25 * dot(e, apply(width, e)) + 0.5 * volume,
        order=max(first.order, second.order),
        remainder=first.remainder + second.remainder,
    )
