"""Inputs, families, domains, tables and state-dependent noise: how they are read, written, and refused."""

import math

import numpy as np
import pytest
import sympy

import zakai
from zakai.cli import main
from zakai.errors import ConditionError, InputError
from zakai.models import load_model
from zakai.models.files import read_model
from zakai.models.numeric import numpy_function, program_of

BASE = {
    "state": '["x"]',
    "drift": '["-x"]',
    "observation": '["x"]',
    "observation_kind": '"samples"',
    "prior": '{kind = "gaussian", mean = [0.5], cov = [0.001]}',
}
LOG_DENSITY = {"observation": None, "observation_log_density": '"-(z - x)**2"', "observed": '["z"]'}
FAULTS = [
    ({"inputs": '"u"'}, "inputs", "a list of names"),
    ({"inputs": '["x"]'}, "inputs", "already a state"),
    ({"inputs": '["u"]', "input_hold": '"liner"'}, "input_hold", "did you mean 'linear'"),
    ({"input_hold": '"zero"'}, "input_hold", "no inputs"),
    ({"drift": '["-x + u"]'}, "drift", "unknown name 'u'"),
    ({"inputs": '["u"]', "process_noise": '[["u**2"]]'}, "process_noise", "'u'; it may"),
    ({"process_noise": '[["x**2"]]'}, "process_noise", "multiply the column of diffusion"),
    ({"inputs": '["u"]', "prior": '{kind = "density", log_density = "-u*x**2"}'}, "prior", "unknown name 'u'"),
    ({"cross_noise": '[["0.5"]]'}, "cross_noise", "increments, path and rates"),
    ({"observation_kind": '"increments"', "cross_noise": '[["0.5", "0"]]'}, "cross_noise", "1 rows (one a noise) of 1 formulas"),
    ({"observation_kind": '"increments"', "cross_noise": '[["1.5"]]'}, "cross_noise", "larger than process_noise"),
    ({"observation_kind": '"increments"', "cross_noise": '[["x"]]'}, "cross_noise", "depends on the state 'x'"),
    ({"observation_kind": '"increments"', "observation_noise": '[["exp(x)"]]'}, "observation_noise", "depends on the state 'x'"),
    ({"observation_family": '"poison"'}, "observation_family", "did you mean 'poisson'"),
    ({"observation_family": '["poisson", "gaussian"]'}, "observation_family", "a list of 1"),
    ({"observation_family": '"poisson"', "observation_kind": '"rates"'}, "observation_family", "is for samples"),
    ({"observation_family": '"poisson"', "observation_noise": '[["2"]]'}, "observation_noise", "no noise of its own"),
    ({"observation_family": '"student-t"'}, "degrees_of_freedom", "missing"),
    ({"observation_family": '"student-t"', "degrees_of_freedom": "-3"}, "degrees_of_freedom", "positive"),
    ({"degrees_of_freedom": "3"}, "degrees_of_freedom", "goes with the family student-t"),
    ({"observation_family": '"von-mises"'}, "concentration", "missing"),
    ({**LOG_DENSITY, "observation": '["x"]'}, "observation", "as observation_log_density does"),
    ({**LOG_DENSITY, "observed": None}, "observed", "1 to 64 names"),
    ({**LOG_DENSITY, "observed": '["x"]'}, "observed", "already a state"),
    ({**LOG_DENSITY, "observed": '["w"]'}, "observation_log_density", "unknown name 'z'"),
    ({**LOG_DENSITY, "observation_log_density": '"-x**2"'}, "observation_log_density", "does not contain z"),
    ({**LOG_DENSITY, "observation_kind": '"path"'}, "observation_log_density", "is for samples"),
    ({"observed": '["z"]'}, "observed", "goes with observation_log_density"),
    ({"domain": "{y = {lower = 0}}"}, "domain", "is not a state"),
    ({"domain": "{x = {}}"}, "domain: x", "lower: missing"),
    ({"domain": "{x = {lower = 1, upper = 1}}"}, "domain: x", "not less than upper"),
    ({"domain": "{x = {lower = 0, below = 1}}"}, "domain: x", "unknown key"),
    ({"domain": '{x = {lower = 0, boundary = "wall"}}'}, "domain: x", "natural, reflecting"),
    ({"domain": "{x = {lower = 0.45}}"}, "prior", "outside of the domain of 'x'"),
    ({"tables": "{d = 3}"}, "tables: d", "got the number"),
    ({"tables": '{d = {file = "none.csv"}}'}, "tables: d", "none.csv: there is no such file"),
    ({"tables": '{d = {file = "bad.csv"}}'}, "tables: d", "bad.csv, row 3: 'two' is not a number"),
    ({"tables": '{d = {file = "wide.csv"}}'}, "tables: d", "wide.csv, row 1: 4 columns"),
    ({"tables": '{d = {file = "grid.csv"}}'}, "tables: d", "no full grid"),
    ({"tables": '{d = {file = "good.csv", kind = "cubic"}}'}, "tables: d", "at least 4 values"),
    ({"tables": '{d = {file = "good.csv", kind = "spline"}}'}, "tables: d", "linear, cubic"),
    ({"tables": "{d = {x = [0, 0], values = [1, 2]}}"}, "tables: d", "increase strictly"),
    ({"tables": "{d = {x = [0, 1], values = [1, 2, 3]}}"}, "tables: d", "a list of 2 numbers"),
    ({"tables": '{sin = {file = "good.csv"}}'}, "tables", "already has a meaning"),
    ({"tables": '{x = {file = "good.csv"}}'}, "tables", "already a state"),
    ({"tables": '{d = {file = "good.csv"}}', "drift": '["d(x, 1)"]'}, "drift", "d takes 1 argument, got 2"),
    ({"drift": '["atan2(x)"]'}, "drift", "atan2 takes 2 arguments, got 1"),
    ({"drift": '["min(x)"]'}, "drift", "min takes 2 to 64 arguments, got 1"),
    ({"periodic": '["x"]', "drift": '["sin(x)"]', "observation": '["sin(x)"]', "diffusion": '[["1 + x**2"]]'}, "diffusion",
     "not 2*pi-periodic"),
]  # fmt: skip
FILES = {
    "bad.csv": "x,d\n0,1\n1,two\n",
    "wide.csv": "1,2,3,4\n",
    "grid.csv": "0,0,1\n0,1,2\n1,0,3\n",
    "good.csv": "x,d\n0,1\n2,5\n1,2\n",
}


def model_file(tmp_path, **changes):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    path = tmp_path / "model.toml"
    path.write_text("\n".join(f"{key} = {value}" for key, value in {**BASE, **changes}.items() if value is not None))
    return path


@pytest.mark.parametrize(("changes", "key", "words"), FAULTS, ids=lambda part: part if isinstance(part, str) else "")
def test_a_wrong_key_is_one_line_that_names_file_and_key(changes, key, words, tmp_path, capsys):
    path = model_file(tmp_path, **changes)
    assert main(["analyze", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith(f"error: {path}: {key}") and words in said


FULL = {
    "state": ["x", "a"], "drift": ["u*depth(x) - x", "sin(a) + slope(x, w)"],
    "diffusion": [["0.1*x", "0"], ["0", "1 + 0.2*cos(a)"]],
    "inputs": ["u", "w"], "input_hold": "linear", "periodic": ["a"],
    "observation": ["x**2", "a", "x"], "observation_kind": "samples",
    "observation_family": ["poisson", "von-mises", "student-t"], "degrees_of_freedom": "nu", "concentration": 4,
    "observation_noise": [["1", "0", "0"], ["0", "1", "0"], ["0", "0", "0.1*exp(x)"]],
    "parameters": {"nu": 5}, "domain": {"x": {"lower": 0, "upper": 10, "boundary": "reflecting"}},
    "tables": {"depth": ([0, 1, 2], [1, 2, 5]), "slope": ([0, 1], [0, 2], [[0, 1], [2, 5]])},
    "prior": {"kind": "density", "log_density": "cos(a) - (x - 1)**2"},
}  # fmt: skip


def test_a_model_with_every_key_is_written_and_read_again():
    model = zakai.Model(**FULL)
    again = read_model(model.to_toml(), "again")
    assert again.to_toml() == model.to_toml()
    for key in ("inputs", "input_hold", "observation_family", "domain", "periodic"):
        assert getattr(again, key) == getattr(model, key)
    x, u = np.array([[0.3, 1.0], [1.7, -2.0]]), np.array([2.0, 0.5])
    for key in ("drift", "diffusion", "observation_noise"):
        values = [numpy_function(getattr(one, key), one)(x, 0.0, one.theta(), u) for one in (model, again)]
        np.testing.assert_array_equal(*values)
    np.testing.assert_allclose(numpy_function(model.drift, model)(x, 0.0, model.theta(), u)[:, 0], [2 * 1.3 - 0.3, 2 * 4.1 - 1.7])
    with pytest.raises(InputError, match="inputs: the values of u, w are missing"):
        numpy_function(model.drift, model)(x, 0.0, model.theta())


@pytest.mark.parametrize(
    "keys", [{"periodic": ["x"]}, {"domain": {"x": {"lower": -1.0, "upper": 2.0, "boundary": "reflecting"}}}]
)
def test_a_uniform_prior_is_the_constant_density(keys):
    keys = {"state": ["x"], "drift": ["cos(x)"], "observation": ["sin(x)"], "observation_kind": "samples", **keys}
    uniform = zakai.Model(**keys, prior={"kind": "uniform"})
    constant = zakai.Model(**keys, prior={"kind": "density", "log_density": "0"})
    record = zakai.Record([0.1, 0.7], [0.3, -0.2], "samples")
    assert read_model(uniform.to_toml(), "again").prior.log_density == 0
    assert np.array_equal(zakai.filter(uniform, record).mean, zakai.filter(constant, record).mean)


def test_a_log_density_is_given_as_text_or_as_an_expression():
    x, z = sympy.symbols("x z")
    keys = {"state": ["x"], "drift": ["0"], "observed": ["z"], "observation_kind": "samples"}
    models = [zakai.Model(**keys, observation_log_density=given) for given in ("-abs(z - x)", -sympy.Abs(z - x))]
    for model in models:
        again = read_model(model.to_toml(), "again")
        value = again.observation_law.log_density([0.5], np.array([[0.0], [2.0]]), 0.0, again.theta())
        np.testing.assert_allclose(value, [-0.5, -1.5])


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("atan2(x, -1)", lambda x: math.atan2(x, -1)),
        ("min(x, 1, 2 - x)", lambda x: min(x, 1, 2 - x)),
        ("max(x, -x**2)", lambda x: max(x, -(x**2))),
        ("sign(x - 1)", lambda x: math.copysign(1, x - 1)),
        ("floor(3*x)", lambda x: math.floor(3 * x)),
        ("heaviside(x)", lambda x: float(x > 0)),
        ("log1p(1e-9*x)", lambda x: math.log1p(1e-9 * x)),
        ("2*expm1(1e-9*x)", lambda x: 2 * math.expm1(1e-9 * x)),
        ("sinc(5*x)", lambda x: math.sin(5 * x) / (5 * x)),
        ("sinc(0)*x", lambda x: x),
        ("erfc(-2*x)", lambda x: math.erfc(-2 * x)),
        ("lgamma(3 + x**2)", lambda x: math.lgamma(3 + x**2)),
        ("3 + lgamma(1/4 - x)", lambda x: 3 + math.lgamma(0.25 - x)),
    ],
)  # fmt: skip
def test_new_functions_agree_with_the_standard_library(formula, expected):
    model = zakai.Model(state=["x"], drift=[formula], observation=["x"])
    assert zakai.Model(state=["x"], drift=[model.drift[0]], observation=["x"]).drift == model.drift
    evaluate, points = numpy_function(model.drift, model), np.array([[-2.3], [-0.4], [1e-9], [0.7], [3.1]])
    wanted = np.array([[expected(x)] for x in points[:, 0]])
    np.testing.assert_allclose(evaluate(points, 0.0, []), wanted, rtol=1e-14, atol=1e-300)
    np.testing.assert_allclose(evaluate(points + 0j, 0.0, []), wanted, rtol=1e-14, atol=1e-300)
    scalar = program_of(list(model.drift), model, stable=True).scalar([])
    np.testing.assert_allclose([scalar([x], 0.0)[0] for x in points[:, 0]], wanted[:, 0], rtol=1e-14)
    step = 1e-6 if "1e-9" not in formula else 1e-3
    smooth = points[np.abs(points[:, 0]) > 0.1]
    slope = (evaluate(smooth + step, 0.0, []) - evaluate(smooth - step, 0.0, [])) / (2 * step)
    np.testing.assert_allclose(evaluate(smooth + 1e-150j, 0.0, []).imag / 1e-150, slope, rtol=1e-6, atol=1e-9)
    if "sign" not in formula and "heaviside" not in formula:
        derivative = numpy_function([model.drift[0].diff(model.x[0])], model)
        np.testing.assert_allclose(derivative(smooth, 0.0, []), slope, rtol=1e-6, atol=1e-9)


def test_erfc_and_lgamma_are_functions_of_every_method():
    prior = {"kind": "gaussian", "mean": [0.5], "cov": [[0.3]]}
    keys = {"observation_kind": "samples", "observation_noise": [["0.1"]], "prior": prior}
    record = zakai.Record([0.2, 0.5, 0.7], [0.9, 0.4, 0.8], "samples")
    near = {"erfc(x)": "1 - erf(x)", "lgamma(2 + x/4)": "log(1 + x/4) + lgamma(1 + x/4)", "x": "x"}
    for formula, equal in near.items():
        pair = [zakai.Model(state=["x"], drift=["-x"], observation=[one], **keys) for one in (formula, equal)]
        one, other = (zakai.filter(model, record, "yau-yau") for model in pair)
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-8)
        assert zakai.filter(pair[0], record).log_likelihood == pytest.approx(other.log_likelihood, abs=1e-2)
    with pytest.raises(InputError, match="lgamma of a whole number that is not positive"):
        zakai.Model(state=["x"], drift=["lgamma(0)"], observation=["x"])
    model = zakai.Model(state=["x"], drift=["-erfc(x)"], observation=["lgamma(1 + x**2)"])
    latex = sympy.latex(model.drift[0]) + sympy.latex(model.observation[0].diff(model.x[0]))
    assert r"\operatorname{erfc}" in latex and r"\psi" in latex
    two = zakai.Model(
        state=["x", "y"], drift=["-erfc(x)/4", "-y"], observation=["x + y"], **{**keys, "prior": {
            "kind": "gaussian", "mean": [0, 0], "cov": [[1, 0], [0, 1]]}},
    )  # fmt: skip
    same = zakai.Model(**{"state": ["x", "y"], "drift": ["(erf(x) - 1)/4", "-y"], "observation": ["x + y"], **keys, "prior": {
        "kind": "gaussian", "mean": [0, 0], "cov": [[1, 0], [0, 1]]}})  # fmt: skip
    means = [zakai.filter(one, record, "yau-yau").mean for one in (two, same)]
    np.testing.assert_allclose(*means, atol=1e-8)


def test_the_derivatives_of_sinc_are_right_near_zero_and_far_away():
    model = zakai.Model(state=["x"], drift=["sinc(x)"], observation=["x"])
    third = numpy_function([model.drift[0].diff(model.x[0], 3)], model, ())
    points = np.array([1e-6, 0.5, 7.9, 13.9, 14.1, 80.0])
    exact = [float(sympy.diff(sympy.sin(model.x[0]) / model.x[0], model.x[0], 3).subs(model.x[0], sympy.Rational(p)).evalf(30))
             for p in points]  # fmt: skip
    np.testing.assert_allclose(third(points[:, None], 0.0, []), exact, rtol=1e-10, atol=1e-14)


def test_tables_interpolate_and_are_constant_outside(tmp_path):
    model = load_model(model_file(tmp_path, tables='{d = {file = "good.csv"}}', drift='["d(x)"]'))
    assert "good.csv" not in model.text and read_model(model.text, "stored").drift[0].args == model.drift[0].args
    values = numpy_function(model.drift, model)(np.array([[-1.0], [0.5], [1.5], [9.0]]), 0.0, [])
    np.testing.assert_allclose(values[:, 0], [1.0, 1.5, 3.5, 5.0])
    x, y = np.linspace(0, 3, 40), np.linspace(-1, 1, 30)
    table = (x, y, np.sin(x)[:, None] * np.exp(y))
    model = zakai.Model(state=["x", "y"], drift=["g(x, y)", "0"], observation=["x"],
                        tables={"g": dict(zip(("x", "y", "values"), table), kind="cubic")})  # fmt: skip
    points = np.array([[0.7, 0.3], [2.2, -0.6]])
    for order, exact in [((0, 0), np.sin), ((1, 0), np.cos), ((1, 1), np.cos)]:
        expr = model.drift[0]
        for symbol, count in zip(model.x, order):
            expr = expr.diff(symbol, count)
        found = numpy_function([expr], model, ())(points, 0.0, [])
        np.testing.assert_allclose(found, exact(points[:, 0]) * np.exp(points[:, 1]), rtol=2e-4)
    moved = numpy_function([model.drift[0]], model, ())(points + 1e-150j, 0.0, []).imag / 1e-150
    np.testing.assert_allclose(moved, np.sin(points[:, 0] + np.pi / 4) * np.sqrt(2) * np.exp(points[:, 1]), rtol=2e-4)


def test_a_periodic_table_repeats_itself_smoothly():
    x = np.linspace(-np.pi, np.pi, 65)
    values = np.append(np.sin(x[:-1]), np.sin(x[0]))
    table = {"x": x, "values": values, "kind": "cubic", "periodic": True}
    model = zakai.Model(state=["x"], periodic=["x"], drift=["d(x)"], observation=["x - x"], tables={"d": table})
    again = read_model(model.text, "stored")
    points = np.array([[-np.pi], [0.4], [3.1], [9.0], [-30.0]])
    for order, exact in enumerate((np.sin, np.cos, lambda x: -np.sin(x))):
        for one in (model, again):
            found = numpy_function([one.drift[0].diff(one.x[0], order) if order else one.drift[0]], one, ())(points, 0.0, [])
            np.testing.assert_allclose(found, exact(points[:, 0]), atol=2e-3)
    for wrong in ({"values": x}, {"y": np.arange(4), "values": np.zeros((65, 4))}):
        with pytest.raises(InputError, match="periodic: a periodic table has one argument, and its last value"):
            zakai.Model(state=["x"], drift=["0"], observation=["x"], tables={"d": table | wrong})


def test_a_table_in_a_file_is_not_read_for_a_text_without_a_place():
    with pytest.raises(InputError, match="tables: d: file: a table in a file is read only with a model file"):
        read_model('state = ["x"]\ndrift = ["d(x)"]\nobservation = ["x"]\ntables = {d = {file = "d.csv"}}', "stored")


WITH_FEATURE = {
    "state-dependent diffusion": {"diffusion": [["1 + x**2"]]},
    "inputs": {"inputs": ["u"], "drift": ["u - x"]},
    "cross noise": {"observation_kind": "increments", "cross_noise": [["0.5"]]},
    "state-dependent observation noise": {"observation_noise": [["1 + x**2"]]},
    "observation family": {"observation_family": "poisson", "observation": ["exp(x)"]},
    "observation log density": {"observation": None, "observation_log_density": "-(z-x)**2", "observed": ["z"]},
    "domain": {"domain": {"x": {"lower": -5, "boundary": "reflecting"}}},
    "tables": {"drift": ["-d(x)"], "tables": {"d": ([-1, 1], [-1, 1])}},
    "kinks": {"drift": ["min(x, 1)"]},
    "jumps": {"observation": ["heaviside(x)"]},
    "sinc": {"observation": ["sinc(x)"]},
}  # fmt: skip


@pytest.mark.parametrize("feature", WITH_FEATURE)
def test_a_method_that_does_not_handle_a_feature_is_refused_with_the_reason(feature):
    from zakai import _registry

    keys = {"state": ["x"], "drift": ["-x"], "observation": ["x"], "observation_kind": "samples",
            "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[0.1]]}, **WITH_FEATURE[feature]}  # fmt: skip
    model = zakai.Model(**{key: value for key, value in keys.items() if value is not None})
    assert list(model.features) == [feature]
    inputs = zakai.Inputs([0.0], [1.0]) if model.inputs else None
    record = zakai.Record([0.1], [[1.0]], model.observation_kind, inputs)
    analysis = zakai.analyze(model)
    for name in _registry.METHODS:
        if feature not in _registry.load(name).handles:
            first = analysis.methods[name][0]
            assert first.holds is False and first.evidence == model.features[feature]
            with pytest.raises(ConditionError, match=f"{name} does not hold: it fails that"):
                zakai.filter(model, record, name)
    assert analysis.eta is None and analysis.algebra.verdict == "undecided" and str(analysis) and analysis.to_latex()


@pytest.mark.parametrize("name", ["level", "Add", "list"])
def test_a_table_may_have_the_name_of_something_in_the_printers_of_sympy(name):
    table = {name: ([0.0, 1.0], [0.0, 2.0])}
    model = zakai.Model(state=["x"], drift=[f"-x + {name}(x)**2"], observation=["x"], tables=table)
    analysis = zakai.analyze(model)
    assert f"{name}(x)" in str(model.drift) and rf"\operatorname{{{name}}}^{{2}}" in analysis.to_latex()
