"""The Gaussian-sum method for time-invariant Yau systems: the survey of Chen and Dong, Theorems 2 and 3, Algorithm 2.

Its ordinary differential equations (31) for the exponent x'A x + B.x + C of each Gaussian,

    A' = 2 A G A - (A D + D'A) + Q,   B' = 2 A G B - D'B - 2 A d + p,   C' = tr(G A) + B'G B / 2 - d.B + r,

are the case of constant coefficients of the equation that `general_direct` solves.
"""

from __future__ import annotations

from dataclasses import replace

from zakai.algebra.theorems import gaussian_sum as theorem
from zakai.methods.sums import general_direct

METHOD = replace(
    general_direct.METHOD,
    name="gaussian-sum",
    source="Chen and Dong, A survey of direct methods for Yau filtering systems, Theorems 2 and 3, Algorithm 2",
    theorem=theorem,
)
