"""Benes' filter in any dimension: f = L x + l + G grad F with F = log cosh(q.x + delta), affine h.

With u = cosh(q.x + delta) v and v Gaussian, N(m, P), the density u is a sum of two Gaussians, and with th = tanh(q.m + delta)

    mean = m + P q th,   cov = P + (1 - th^2) P q q'P,   log-mass = log cosh(q.m + delta) + q'P q / 2

(Benes 1981; Bain and Crisan 2009, chapter 6).  The prior divided by cosh is put on nodes along q, once; every step is exact.
"""

from __future__ import annotations

from dataclasses import replace

from zakai.algebra.exact_theorems import benes as theorem
from zakai.methods.gaussian import kalman_bucy
from zakai.models.features import INPUTS

METHOD = replace(
    kalman_bucy.METHOD,
    name="benes",
    source="Benes 1981; any prior: Makowski 1986",
    exactness="exact for y that is linear between observations, and for samples; the prior to 1e-12",
    theorem=theorem,
    handles=frozenset({INPUTS}),
    variant=None,
)
