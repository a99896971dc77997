"""The coefficients of a kernel from the package's transitions, and the Taylor data of a reference system."""

from __future__ import annotations

import numpy as np
import sympy

from zakai.methods.system.jets import Expansion
from zakai.methods.yau.kernel import transition_of
from zakai.methods.yau.power import Series, _recursion, _term_sizes, power_series, schroedinger, taylor_data
from zakai.numerics.series.power_series import value

KEYS = ("G", "L", "l", "Q", "p", "r")


def texts(system):
    """G, L, l, Q, p, r of a system as SymPy matrices, where q = x'Q x + p.x + r."""
    return [sympy.Matrix(np.atleast_1d(sympy.sympify(system.yau[key]))) for key in KEYS]


def entries(G, L, l, Q, p, r):
    """The entries of L, l, G and of -q / 2, in the order of the package."""
    return [entry for block in (L, l, G, -Q / 2, -p / 2, -r / 2) for entry in block]


def data(system, start, terms):
    """The Taylor data of a system about `start`, as a batch of one."""
    expansion = Expansion(entries(*texts(system)), sympy.Symbol("t"), [])
    return taylor_data(expansion.taylor(np.array([start]), terms, np.zeros(0)), np.zeros(system.n))


def kernel_of(transition):
    """A, B, C, D, E, s of log K(x, y) = x'A x + x'B y + y'C y + D.x + E.y + s."""
    psi, offset, noise, information, vector, constant = transition
    inverse = np.linalg.inv(noise)
    B, D = inverse @ psi, inverse @ offset
    C, E = -0.5 * (information + np.swapaxes(psi, -1, -2) @ B), vector - np.swapaxes(psi, -1, -2) @ D
    s = constant - 0.5 * np.swapaxes(offset, -1, -2) @ D
    return -0.5 * inverse, B, C, D[..., 0], E[..., 0], s[..., 0, 0] - 0.5 * np.linalg.slogdet(2.0 * np.pi * noise)[1]


def cut(z, delta, order):
    """The series after the power `order`; all terms beyond it are its remainder."""
    coefficients = _recursion(z)
    sizes = _term_sizes(z, coefficients, delta, 1)
    kept = [value(np.stack([series[v] for v in range(order + 1)]), delta) for series in coefficients]
    return Series(*kept, sum(sizes[order + 1 :], sizes[-1] + sizes[-2]))


def single(data, length, order=None):
    """The kernel of one series over an interval, cut after the power `order`, and its remainder."""
    z, delta = schroedinger(data), np.array([length])
    found = power_series(z, delta) if order is None else cut(z, delta, order)
    return [np.asarray(field)[0] for field in kernel_of(transition_of(z, found, delta))], found.remainder.item()
