"""Formulas that a kernel evaluates, against SymPy; a flow that a kernel integrates, against a closed form."""

import numpy as np
import sympy

from zakai.methods.space.functions import PointFunction
from zakai.models import Model

FORMULAS = [
    "sin(x) + cos(v)*tan(x/3) - asin(x/4) + acos(v/5) + atan(x*v) + atan2(x, v)",
    "sinh(x) + cosh(v) + tanh(x - v) + exp(-x**2) + log(1 + x**2) + erf(a*x)",
    "sqrt(x**2 + 1)**3/(1 + v**2) - abs(x - v)**(1/3) + x**-3 - 2**-3*v**7 + sign(v)",
    "t**2*x/(3*v) + pi*a/7 + log(cosh(3*x)) + x**2.5",
    "2*min(x, v) - max(x, t) + floor(x)",
]


def test_the_kernel_agrees_with_sympy():
    model = Model(state=["x", "v"], drift=["0", "0"], observation=FORMULAS, parameters={"a": 0.3})
    function = PointFunction(list(model.observation), model, (5,))
    assert function.formulas(model.theta()) is not None
    points = np.array([[0.7, -1.2], [1.3, 0.4], [2.9, 1.5]] * 60)
    found = function(points, 0.6, model.theta())
    for x, row in zip(points[:3], found[177:], strict=True):
        values = dict(zip((*model.x, model.t, *model.parameter_symbols), (*x, 0.6, 0.3), strict=True))
        values = {symbol: sympy.Rational(str(value)) for symbol, value in values.items()}
        exact = [float(h.subs(values).evalf(30)) for h in model.observation[:4, :]]
        exact.append(2 * min(x) - max(x[0], 0.6) + np.floor(x[0]))
        assert np.allclose(row, exact, rtol=1e-13, atol=1e-14)


def test_a_flow_gives_up_points_that_leave_its_window_and_integrates_the_others():
    model = Model(state=["x", "y"], drift=["cos(t)*x", "-2*y"], observation=["x"])
    function = PointFunction([*model.drift, sympy.cos(model.t) - 2], model, (3,))
    formulas = function.formulas(model.theta())
    points = np.array([[1.0, 1.0], [-0.5, 2.0], [9.0, 1.0]])
    moved = formulas.flow(points, 0.0, 1.0, 64, np.zeros(2), np.eye(2), np.full(2, 8.0))
    exact = points * np.exp([np.sin(1.0), -2.0]) - points
    assert np.allclose(moved[:2, :2], exact[:2], rtol=1e-7)
    assert np.allclose(moved[:2, 2], np.sin(1.0) - 2.0, rtol=1e-7)
    assert np.isnan(moved[2]).all()
