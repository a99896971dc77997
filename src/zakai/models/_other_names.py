"""Names of functions in other languages, and what the grammar of formulas has in their place."""

from __future__ import annotations

_INSTEAD = {
    "ln": "log(x)",
    "log10": "log(x)/log(10)",
    "log2": "log(x)/log(2)",
    "pow": "x**y",
    "power": "x**y",
    "square": "x**2",
    "cbrt": "x**(1/3)",
    "arcsin": "asin(x)",
    "arccos": "acos(x)",
    "arctan": "atan(x)",
    "arctan2": "atan2(y, x)",
    "fabs": "abs(x)",
    "gamma": "exp(lgamma(x))",
    "gammaln": "lgamma(x)",
    "loggamma": "lgamma(x)",
    "sigmoid": "1/(1 + exp(-x))",
    "expit": "1/(1 + exp(-x))",
    "logit": "log(x/(1 - x))",
    "relu": "max(x, 0)",
    "step": "heaviside(x)",
    "sgn": "sign(x)",
    "sec": "1/cos(x)",
    "csc": "1/sin(x)",
    "cot": "1/tan(x)",
    "ceil": "-floor(-x)",
    "round": "floor(x + 1/2)",
    "mod": "x - y*floor(x/y)",
    "fmod": "x - y*floor(x/y)",
    "minimum": "min(x, y)",
    "maximum": "max(x, y)",
    "clip": "min(max(x, low), high)",
    "e": "exp(1)",
} | dict.fromkeys(
    ("if", "else", "where", "piecewise", "Piecewise", "ite", "iif", "switch"),
    "heaviside(a - b), which is 1 where a > b and else 0, or max and min",
)


def instead_of(name: str) -> str:
    """Return what to write in the place of a name of another language, or nothing."""
    found = _INSTEAD.get(name) or _INSTEAD.get(name.lower() if len(name) > 1 else name)
    return f"; write {found}" if found else ""
