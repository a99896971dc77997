"""Random numbers that are functions of a key and a counter, so that they do not depend on order, threads or restarts.

A 64-bit counter is hashed twice with the finalizer of SplitMix64 under a key of two words; a uniform number gives a normal one by
the inverse distribution function.

References:
    Steele, Lea and Flood 2014, Fast splittable pseudorandom number generators.
    Wichura 1988, Algorithm AS 241: the percentage points of the normal distribution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BLOCK
from zakai.numerics.particles.elementary import log_row

Array = Any
KEY = types.uint64[::1]
_MASK = 2**64 - 1
_GOLDEN = 0x9E3779B97F4A7C15


def _mixed(z: int) -> int:
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return z ^ (z >> 31)


def key_of(*numbers: int) -> Array:
    """Return the key (2,) of whole numbers, such as a seed, the number of an interval and that of a use."""
    first, second = 0x243F6A8885A308D3, 0x13198A2E03707344
    for number in numbers:
        first = _mixed((first + (number & _MASK) + _GOLDEN) & _MASK)
        second = _mixed((second ^ first) + _GOLDEN & _MASK)
    return np.array([first, second], np.uint64)


@helper
def hashed(key: Array, counter: Any) -> Any:
    """Return 64 random bits (uint64) for a counter (uint64)."""
    z = counter * np.uint64(0x9E3779B97F4A7C15) + key[0]
    for _ in range(2):
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31)) ^ key[1]
    return z


@helper
def uniform(key: Array, counter: Any) -> float:
    """Return a number in (0, 1) for a counter (uint64)."""
    return (float(hashed(key, counter) >> np.uint64(12)) + 0.5) * 2.0**-52


@helper
def _central(p: float) -> float:
    """Return the quantile of the standard normal distribution for a probability from 0.075 to 0.925."""
    q = p - 0.5
    r = 0.180625 - q * q
    above = ((((((2.5090809287301226727e3 * r + 3.3430575583588128105e4) * r + 6.7265770927008700853e4) * r
               + 4.5921953931549871457e4) * r + 1.3731693765509461125e4) * r + 1.9715909503065514427e3) * r
             + 1.3314166789178437745e2) * r + 3.3871328727963666080e0  # fmt: skip
    below = ((((((5.2264952788528545610e3 * r + 2.8729085735721942674e4) * r + 3.9307895800092710610e4) * r
               + 2.1213794301586595867e4) * r + 5.3941960214247511077e3) * r + 6.8718700749205790830e2) * r
             + 4.2313330701600911252e1) * r + 1.0  # fmt: skip
    return q * above / below


@helper
def _outer(r: float) -> float:
    """Return the quantile for the probability 1 - exp(-r^2), from 0.925 to where float64 ends."""
    near = r <= 5.0
    s = r - 1.6
    above = ((((((7.74545014278341407640e-4 * s + 2.27238449892691845833e-2) * s + 2.41780725177450611770e-1) * s
               + 1.27045825245236838258e0) * s + 3.64784832476320460504e0) * s + 5.76949722146069140550e0) * s
             + 4.63033784615654529590e0) * s + 1.42343711074968357734e0  # fmt: skip
    below = ((((((1.05075007164441684324e-9 * s + 5.47593808499534494600e-4) * s + 1.51986665636164571966e-2) * s
               + 1.48103976427480074590e-1) * s + 6.89767334985100004550e-1) * s + 1.67638483018380384940e0) * s
             + 2.05319162663775882187e0) * s + 1.0  # fmt: skip
    t = r - 5.0
    above_far = ((((((2.01033439929228813265e-7 * t + 2.71155556874348757815e-5) * t + 1.24266094738807843860e-3) * t
                   + 2.65321895265761230930e-2) * t + 2.96560571828504891230e-1) * t + 1.78482653991729133580e0) * t
                 + 5.46378491116411436990e0) * t + 6.65790464350110377720e0  # fmt: skip
    below_far = ((((((2.04426310338993978564e-15 * t + 1.42151175831644588870e-7) * t + 1.84631831751005468180e-5) * t
                   + 7.86869131145613259100e-4) * t + 1.48753612908506148525e-2) * t + 1.36929880922735805310e-1) * t
                 + 5.99832206555887937690e-1) * t + 1.0  # fmt: skip
    return (above if near else above_far) / (below if near else below_far)


@helper
def fill_row(key: Array, row: int, first: int, size: int, out: Array) -> None:
    """Write one row (size,) of standard normal numbers for the particles from `first` on; row and particle are the counter."""
    counter, p = (np.uint64(row) << np.uint64(32)) + np.uint64(first), np.empty(size)
    for i in range(size):
        p[i] = uniform(key, counter + np.uint64(i))
    write_quantiles(p, size, out)


@helper
def write_quantiles(p: Array, size: int, out: Array) -> None:
    """Write the quantiles (size,) of the standard normal distribution for probabilities (size,)."""
    found, far, places = np.empty(size), np.empty(size), np.empty(size, np.int64)
    # Loops without branches are vectorised: most numbers are central, and the others are put together.
    for i in range(size):
        found[i] = _central(p[i])
    count = 0
    for i in range(size):
        places[count] = i
        count += abs(p[i] - 0.5) > 0.425
    for j in range(count):
        far[j] = 0.5 - abs(p[places[j]] - 0.5)
    log_row(far[:count], far[:count])
    for j in range(count):
        far[j] = _outer(np.sqrt(-far[j]))
    for j in range(count):
        q = p[places[j]]
        found[places[j]] = -far[j] if q < 0.5 else far[j]
    for i in range(size):
        out[i] = found[i]


@kernel(types.void(KEY, types.int64, types.int64, types.float64[:, ::1]))
def normals(key: Array, low: int, high: int, out: Array) -> None:
    """Write the columns from `low` to `high` of standard normal numbers (d, N)."""
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        for j in range(out.shape[0]):
            fill_row(key, j, first, size, out[j, first : first + size])


def uniform_number(key: Array) -> float:
    """Return one number in (0, 1) for a key, the one of counter zero."""
    z = int(key[0])
    for _ in range(2):
        z = _mixed(z) ^ int(key[1])
    return ((z >> 12) + 0.5) * 2.0**-52
