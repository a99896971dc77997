"""The exponential function of arrays in kernels, in steps that a processor takes for several numbers at once.

    exp(x) = 2^k exp(r),   k = round(x / log 2),   |r| <= log(2) / 2,

with a Taylor polynomial of degree 13 for exp(r).  The relative error is at most 4e-16.
"""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper

Array = NDArray[Any]

_SMALLEST = -708.0  # exponent below which the result is zero
_LARGEST = 709.0  # exponent above which it is infinite
_ROUND = 1.5 * 2.0**52  # a number to which k is added, so that its last bits are those of k
_PER_LOG = 1.0 / np.log(2.0)
_HIGH, _LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # log 2, in two parts
_BITS = 1023 - int(np.float64(_ROUND).view(np.int64))
_C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11, _C12, _C13 = (1.0 / factorial(n) for n in range(2, 14))


@helper
def exponentiate(values: Array) -> None:
    """Replace numbers (N,) by their exponentials."""
    power = np.empty(values.size)
    bits = power.view(np.int64)
    for j in range(values.size):
        given = values[j]
        x = _SMALLEST if given < _SMALLEST else (_LARGEST if given > _LARGEST else given)
        power[j] = x * _PER_LOG + _ROUND
        k = power[j] - _ROUND
        r = (x - k * _HIGH) - k * _LOW
        low = 1.0 + r * (1.0 + r * (_C2 + r * (_C3 + r * (_C4 + r * (_C5 + r * (_C6 + r * (_C7 + r * (_C8 + r * _C9))))))))
        square = r * r
        fourth = square * square
        found = low + fourth * fourth * square * (_C10 + r * (_C11 + r * (_C12 + r * _C13)))
        found = 0.0 if given < _SMALLEST else found
        values[j] = np.inf if given > _LARGEST else found
    for j in range(values.size):
        bits[j] = (bits[j] + _BITS) << 52
    for j in range(values.size):
        values[j] *= power[j]
