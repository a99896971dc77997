"""Elementary functions of rows of numbers, in loops without branches that the compiler vectorises.

The functions of the C library take one number at a time, and several times as long.  Errors are below two units in the last
place.  Arguments for which the short way does not hold (NaN, infinity, zero, large angles) are computed one by one afterwards.

References:
    Cody and Waite 1980, Software manual for the elementary functions (reductions of the argument).
    Moshier 1989, Methods and programs for mathematical functions (coefficients).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from zakai.numerics.compiled import helper

Array = Any
_ROUND = 6755399441055744.0  # 1.5 * 2^52: what is added leaves a whole number in the last bits
_LN2_HIGH, _LN2_LOW = 6.93145751953125e-1, 1.42860682030941723212e-6
_HALF_PI = (1.5707963109016418457, 1.5893254712295856735e-8, 6.1232339957367660359e-17)
_WIDE = 1e5  # of an angle, up to which the reduction is exact enough
_SMALLEST = 2.2250738585072014e-308
_SIGN = np.int64(-0x8000000000000000)
_MANTISSA, _ONE = np.int64(0x000FFFFFFFFFFFFF), np.int64(0x3FF0000000000000)


_compiled: Any = intrinsic


@_compiled
def _bits(context: Any, x: Any) -> Any:
    """Return the bits of a float64 as an int64."""
    return types.int64(types.float64), lambda _, builder, __, args: builder.bitcast(args[0], ir.IntType(64))


@_compiled
def _number(context: Any, x: Any) -> Any:
    """Return the float64 with the bits of an int64."""
    return types.float64(types.int64), lambda _, builder, __, args: builder.bitcast(args[0], ir.DoubleType())


@helper
def _with_sign(value: float, u: float) -> float:
    """Return a number that is not negative with the sign of u."""
    return _number(_bits(value) | (_bits(u) & _SIGN))


@helper
def _exp(u: float) -> float:
    """Return exp(u)."""
    x = min(max(u, -746.0), 710.0)
    shifted = x * 1.4426950408889634 + _ROUND
    k = shifted - _ROUND
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    s = r * r
    p = r * ((1.26177193074810590878e-4 * s + 3.02994407707441961300e-2) * s + 9.99999999999999999910e-1)
    q = ((3.00198505138664455042e-6 * s + 2.52448340349684104192e-3) * s + 2.27265548208155028766e-1) * s + 2.0
    whole = _bits(shifted) - _bits(_ROUND)
    half = whole >> 1
    value = (1.0 + 2.0 * (p / (q - p))) * _number((half + 1023) << 52) * _number((whole - half + 1023) << 52)
    return value if u == u else u


@helper
def exp_row(a: Array, out: Array) -> None:
    """Write exp(a)."""
    for i in range(out.size):
        out[i] = _exp(a[i])


@helper
def tanh_row(a: Array, out: Array) -> None:
    """Write tanh(a)."""
    for i in range(out.size):
        u = a[i]
        z = u * u
        p = (-9.64399179425052238628e-1 * z - 9.92877231001918586564e1) * z - 1.61468768441708447952e3
        q = ((z + 1.12811678491632931402e2) * z + 2.23548839060100448583e3) * z + 4.84406305325125486048e3
        far = _with_sign(1.0 - 2.0 / (_exp(2.0 * abs(u)) + 1.0), u)
        out[i] = u + u * (z * p / q) if abs(u) < 0.625 else far


@helper
def log_row(a: Array, out: Array) -> None:
    """Write log(a)."""
    odd = 0
    for i in range(out.size):
        u = a[i]
        fine = (u >= _SMALLEST) & (u < np.inf)
        odd += 0 if fine else 1
        bits = _bits(u if fine else 1.0)
        m = _number((bits & _MANTISSA) | _ONE)
        # An exponent as a float64: its bits are the last ones of 1.5 * 2^52.
        e = _number((bits >> 52) + _bits(_ROUND)) - (_ROUND + 1023.0)
        large = m > 1.4142135623730951
        m = 0.5 * m if large else m
        e = e + 1.0 if large else e
        x = m - 1.0
        z = x * x
        p = ((((1.01875663804580931796e-4 * x + 4.97494994976747001425e-1) * x + 4.70579119878881725854e0) * x
              + 1.44989225341610930846e1) * x + 1.79368678507819816313e1) * x + 7.70838733755885391666e0  # fmt: skip
        q = ((((x + 1.12873587189167450590e1) * x + 4.52279145837532221105e1) * x + 8.29875266912776603211e1) * x
             + 7.11544750618563894466e1) * x + 2.31251620126765340583e1  # fmt: skip
        y = x * (z * p / q) - e * 2.121944400546905827679e-4 - 0.5 * z
        out[i] = x + y + e * 0.693359375
    if odd:
        for i in range(out.size):
            u = a[i]
            if not (_SMALLEST <= u < np.inf):
                out[i] = math.log(u)


@helper
def sin_row(a: Array, quarter: int, out: Array) -> None:
    """Write sin(a + quarter pi / 2): the sine for quarter 0, the cosine for quarter 1."""
    odd = 0
    for i in range(out.size):
        u = a[i]
        fine = abs(u) <= _WIDE
        odd += 0 if fine else 1
        u = u if fine else 0.0
        shifted = u * 0.6366197723675814 + _ROUND
        k = shifted - _ROUND
        x = ((u - k * _HALF_PI[0]) - k * _HALF_PI[1]) - k * _HALF_PI[2]
        turn = _bits(shifted) + quarter
        z = x * x
        s = ((((1.58962301576546568060e-10 * z - 2.50507477628578072866e-8) * z + 2.75573136213857245213e-6) * z
              - 1.98412698295895385996e-4) * z + 8.33333333332211858878e-3) * z - 1.66666666666666307295e-1  # fmt: skip
        c = ((((-1.13585365213876817300e-11 * z + 2.08757008419747316778e-9) * z - 2.75573141792967388112e-7) * z
              + 2.48015872888517045348e-5) * z - 1.38888888888730564116e-3) * z + 4.16666666666665929218e-2  # fmt: skip
        value = (1.0 - 0.5 * z) + z * z * c if turn & 1 else x + x * z * s
        out[i] = -value if turn & 2 else value
    if odd:
        for i in range(out.size):
            u = a[i]
            if not abs(u) <= _WIDE:
                out[i] = math.cos(u) if quarter else math.sin(u)


@helper
def _arc(x: float) -> float:
    """Return atan(x) for x from 0 to 1."""
    large = x > 0.66
    x = (x - 1.0) / (x + 1.0) if large else x
    z = x * x
    p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z
         - 1.228866684490136173410e2) * z - 6.485021904942025371773e1  # fmt: skip
    q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z
         + 4.853903996359136964868e2) * z + 1.945506571482613964425e2  # fmt: skip
    value = x + x * (z * p / q)
    return value + 7.85398163397448309616e-1 if large else value


@helper
def atan_row(a: Array, out: Array) -> None:
    """Write atan(a)."""
    for i in range(out.size):
        u = abs(a[i])
        value = _arc(min(u, 1.0 / u) if u > 0.0 else u)
        out[i] = _with_sign(1.5707963267948966 - value if u > 1.0 else value, a[i])


@helper
def atan2_row(a: Array, b: Array, out: Array) -> None:
    """Write atan2(a, b)."""
    odd = 0
    for i in range(out.size):
        y, x = abs(a[i]), abs(b[i])
        low, high = min(x, y), max(x, y)
        fine = (high > _SMALLEST) & (x < np.inf) & (y < np.inf)
        odd += 0 if fine else 1
        value = _arc(low / (high if fine else 1.0))
        value = 1.5707963267948966 - value if y > x else value
        out[i] = _with_sign(math.pi - value if b[i] < 0.0 else value, a[i])
    if odd:
        for i in range(out.size):
            y, x = abs(a[i]), abs(b[i])
            if not (max(x, y) > _SMALLEST and x < np.inf and y < np.inf):
                out[i] = math.atan2(a[i], b[i])


@helper
def sqrt_row(a: Array, out: Array) -> None:
    """Write the square root of a."""
    for i in range(out.size):
        out[i] = np.sqrt(a[i])


@helper
def abs_row(a: Array, out: Array) -> None:
    """Write the absolute value of a."""
    for i in range(out.size):
        out[i] = abs(a[i])


@helper
def floor_row(a: Array, out: Array) -> None:
    """Write the largest whole number up to a."""
    for i in range(out.size):
        out[i] = np.floor(a[i])


@helper
def square_row(a: Array, exponent: int, out: Array) -> None:
    """Write a^2, a^3 or a^4."""
    for i in range(out.size):
        u = a[i]
        square = u * u
        out[i] = square if exponent == 2 else square * (u if exponent == 3 else square)


@helper
def add_rows(out: Array, factors: Array, rows: Array, size: int) -> None:
    """Add the sum of rows (J, size or more) times factors (J,) to a row, four at a time."""
    count = factors.size
    for j in range(0, count - 3, 4):
        a, b, c, d = factors[j], factors[j + 1], factors[j + 2], factors[j + 3]
        if a == 0.0 and b == 0.0 and c == 0.0 and d == 0.0:
            continue
        for i in range(size):
            out[i] += (a * rows[j, i] + b * rows[j + 1, i]) + (c * rows[j + 2, i] + d * rows[j + 3, i])
    for j in range(count - count % 4, count):
        a = factors[j]
        if a != 0.0:
            for i in range(size):
                out[i] += a * rows[j, i]
