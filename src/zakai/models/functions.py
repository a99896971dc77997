"""Functions that SymPy lacks, or evaluates in ways that a filter cannot use: min, max, floor, sinc, lgamma, erfc and tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.models.table import Table

NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
NEAR = 8.0  # |x| up to which the integral of sinc is taken; the recursion loses digits for small |x|


class _Real(sympy.Function):  # type: ignore[misc]
    """A function with real values that SymPy neither simplifies nor rewrites."""

    def _eval_is_extended_real(self) -> bool:
        return True


class Minimum(_Real):
    """min(a, b); its derivative at a = b is the mean of the two."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        own, other = self.args if argindex == 1 else reversed(self.args)
        return (1 + sympy.sign(other - own)) / 2


class Maximum(_Real):
    """max(a, b); its derivative at a = b is the mean of the two."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        own, other = self.args if argindex == 1 else reversed(self.args)
        return (1 + sympy.sign(own - other)) / 2


class Floor(_Real):
    """The largest whole number that is at most a; its derivative is zero between the jumps."""

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return sympy.Integer(0)


class Sinc(_Real):
    """The derivative of order k of sin(x) / x, as Sinc(x, k)."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return Sinc(self.args[0], self.args[1] + 1)


class LogGamma(_Real):
    """The derivative of order k of log |Gamma(x)|, as LogGamma(x, k)."""

    nargs = 2

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return LogGamma(self.args[0], self.args[1] + 1)

    def _latex(self, printer: Any, exp: str | None = None) -> str:
        order = int(self.args[1])
        name = r"\log\Gamma" if order == 0 else r"\psi" if order == 1 else rf"\psi^{{\left({order - 1}\right)}}"
        return rf"{name}{{\left({printer.doprint(self.args[0])}\right)}}" + ("" if exp is None else f"^{{{exp}}}")


class ComplementaryError(_Real):
    """erfc(x) = 1 - erf(x), which SymPy would rewrite where digits are lost."""

    nargs = 1

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return -2 * sympy.exp(-(self.args[0] ** 2)) / sympy.sqrt(sympy.pi)

    def _latex(self, printer: Any, exp: str | None = None) -> str:
        power = "" if exp is None else f"^{{{exp}}}"
        return rf"\operatorname{{erfc}}{power}{{\left({printer.doprint(self.args[0])}\right)}}"


class TableFunction(_Real):
    """A table as a function; `table` and the orders of the derivatives belong to the class, one for each table and orders."""

    table: Table
    orders: tuple[int, ...]

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        orders = tuple(order + (place == argindex - 1) for place, order in enumerate(self.orders))
        if orders[argindex - 1] > self.table.degree:
            return sympy.Integer(0)
        return table_function(self.table, orders)(*self.args)

    def _sympystr(self, printer: Any) -> str:
        # SymPy would look for a method of the printer by the name, and find another for a table named `level` or `Add`.
        return f"{type(self).__name__}({', '.join(map(printer.doprint, self.args))})"

    def _latex(self, printer: Any, exp: str | None = None) -> str:
        name = printer.doprint(sympy.Symbol(type(self).__name__))
        power = "" if exp is None else f"^{{{exp}}}"
        return rf"\operatorname{{{name}}}{power}{{\left({', '.join(map(printer.doprint, self.args))}\right)}}"


def table_function(table: Table, orders: tuple[int, ...] | None = None) -> Any:
    """Return the class of functions that evaluate a table or its derivative of these orders."""
    orders = orders or (0,) * len(table.axes)
    if orders not in table.functions:
        name = table.name + "".join(f"_d{place + 1}" * order for place, order in enumerate(orders))
        table.functions[orders] = type(name, (TableFunction,), {"table": table, "orders": orders, "nargs": len(orders)})
    return table.functions[orders]


def sinc(x: Any, order: int) -> NDArray[Any]:
    """Return the derivative of some order of sin(x) / x; complex x keeps a derivative.

    S_k(x) = int_0^1 s^k cos(x s + k pi/2) ds, and x S_k = sin(x + k pi/2) - k S_(k-1) where |x| is large.
    """
    x = np.asarray(x)
    near = np.abs(x.real) <= NEAR + 2 * order
    nodes, weights = (NODES + 1) / 2, WEIGHTS / 2
    small = np.where(near, x, 0.0)[..., None]
    integral = (np.cos(small * nodes + order * np.pi / 2) * (weights * nodes**order)).sum(axis=-1)
    large = np.where(near, 1.0, x)
    recursion = np.sin(large) / large
    for k in range(1, order + 1):
        recursion = (np.sin(large + k * np.pi / 2) - k * recursion) / large
    return np.asarray(np.where(near, integral, recursion))


def without_jumps(formula: sympy.Expr, symbol: sympy.Symbol) -> sympy.Expr:
    """Return the derivative of a formula almost everywhere: apart from its jumps."""
    return sympy.diff(formula, symbol).replace(sympy.DiracDelta, lambda *_: sympy.S.Zero)


def log_gamma(x: Any, order: int) -> NDArray[Any]:
    """Return the derivative of some order of log |Gamma(x)|; complex x keeps a derivative."""
    from scipy.special import gammaln, polygamma

    def real(k: int) -> NDArray[Any]:
        return np.asarray(gammaln(np.real(x)) if k == 0 else polygamma(k - 1, np.real(x)))

    return real(order) + 1j * np.imag(x) * real(order + 1) if np.iscomplexobj(x) else real(order)


def complementary_error(x: Any) -> NDArray[Any]:
    """Return erfc(x); complex x keeps a derivative."""
    from scipy.special import erfc

    if not np.iscomplexobj(x):
        return np.asarray(erfc(x))
    return erfc(np.real(x)) - 1j * np.imag(x) * 2.0 / np.sqrt(np.pi) * np.exp(-(np.real(x) ** 2))


def pairwise(function: Callable[[Any, Any], Any], arguments: list[Any]) -> Any:
    """Return f(f(a, b), c) and so on: a function of two arguments, of several."""
    result = arguments[0]
    for argument in arguments[1:]:
        result = function(result, argument)
    return result
