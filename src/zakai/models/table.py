"""A table: a function of one or two arguments, given by numbers and interpolated."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

KINDS = {"linear": 1, "cubic": 3}


class Table:
    """A function of one or two arguments on a grid: linear, or a cubic spline; constant outside of its range.

    `axes` are the increasing values of each argument, `values` the function on their grid, `degree` 1 or 3. With `periodic` a
    function of one argument repeats itself outside of its range.
    """

    def __init__(self, name: str, axes: tuple[NDArray[Any], ...], values: NDArray[Any], kind: str, periodic: bool = False):
        self.name, self.axes, self.values, self.kind, self.degree = name, axes, values, kind, KINDS[kind]
        self.periodic = periodic
        self.functions: dict[tuple[int, ...], Any] = {}
        self._spline: Any = None

    def __call__(self, *arguments: Any, orders: tuple[int, ...] | None = None) -> NDArray[Any]:
        """Return the values, or a partial derivative; complex arguments keep a derivative to first order."""
        orders = orders or (0,) * len(self.axes)
        points = np.stack(np.broadcast_arrays(*arguments), axis=-1)
        result = self._real(points.real, orders)
        if not np.iscomplexobj(points):
            return result
        change = np.zeros(result.shape)
        for place in range(len(self.axes)):
            raised = tuple(order + (place == i) for i, order in enumerate(orders))
            change = change + self._real(points.real, raised) * points[..., place].imag
        return result + 1j * change

    def _real(self, points: NDArray[Any], orders: tuple[int, ...]) -> NDArray[Any]:
        if max(orders) > self.degree:
            return np.zeros(points.shape[:-1])
        lower = np.array([axis[0] for axis in self.axes])
        upper = np.array([axis[-1] for axis in self.axes])
        if self.periodic:
            points = lower + np.mod(points - lower, upper - lower)
        values = self._interpolant()(np.clip(points, lower, upper), nu=orders)
        outside = (points < lower) | (points > upper)
        flat = np.any(outside & (np.array(orders) > 0), axis=-1)
        return np.where(np.isnan(points).any(axis=-1), np.nan, np.where(flat, 0.0, values))

    def _interpolant(self) -> Any:
        if self._spline is None:
            from scipy.interpolate import NdBSpline, make_interp_spline

            coefficients, knots = self.values, []
            ends = "periodic" if self.periodic and self.degree > 1 else None
            for place, axis in enumerate(self.axes):
                spline = make_interp_spline(axis, coefficients, k=self.degree, axis=place, bc_type=ends)
                coefficients = np.moveaxis(spline.c, 0, place)
                knots.append(spline.t)
            self._spline = NdBSpline(tuple(knots), np.ascontiguousarray(coefficients), self.degree)
        return self._spline

    def pieces(self) -> tuple[list[tuple[NDArray[Any], NDArray[Any]]], NDArray[Any]]:
        """Return for each axis the knots (k) and the polynomials of the B-splines, and the coefficients of their products.

        Between the knots p + degree and p + degree + 1 the splines p, ..., p + degree are polynomials in the distance from the
        former knot, with coefficients (k - 2 degree - 1, degree + 1, degree + 1), that of the highest power first.
        """
        from scipy.interpolate import BSpline, PPoly

        spline, found = self._interpolant(), []
        for knots in spline.t:
            count = len(knots) - self.degree - 1
            splines = [PPoly.from_spline(BSpline(knots, row, self.degree)).c for row in np.eye(count)]
            near = range(self.degree + 1)
            polynomials = [[splines[p + i][:, p + self.degree] for i in near] for p in range(count - self.degree)]
            found.append((knots, np.array(polynomials)))
        return found, spline.c

    def outside(self, *arguments: Any) -> NDArray[np.bool_]:
        """Return where an argument is outside of the range of the table; a periodic table has none."""
        if self.periodic:
            return np.zeros(np.shape(arguments[0]), bool)
        parts = [(np.real(a) < axis[0]) | (np.real(a) > axis[-1]) for a, axis in zip(arguments, self.axes, strict=True)]
        return np.asarray(np.logical_or.reduce(np.broadcast_arrays(*parts)))

    def keys(self) -> dict[str, Any]:
        """Return the table as the keys of a model file, without a file of its own."""
        axes = {name: axis.tolist() for name, axis in zip("xy", self.axes)}
        repeats = {"periodic": True} if self.periodic else {}
        return {"kind": self.kind, **repeats, **axes, "values": self.values.tolist()}
