import os
import pickle

import numpy as np
import pytest
import sympy

from zakai.errors import InputError
from zakai.models import Model, gallery, load_model
from zakai.models.files import read_model

GOOD = {
    "state": '["x", "v"]',
    "drift": '["v", "-a*x"]',
    "diffusion": '[["0"], ["1"]]',
    "process_noise": '[["1"]]',
    "observation": '["x", "sin(x)"]',
    "observation_noise": '[["1", "0"], ["0", "2"]]',
    "observation_kind": '"samples"',
    "start": "0.5",
    "periodic": "[]",
    "functions": "[]",
    "parameters": "{a = 0.1}",
    "prior": '{kind = "gaussian", mean = [0, 0], cov = [1, 2]}',
}


def text(**changes):
    keys = {**GOOD, **changes}
    return "\n".join(f"{key} = {value}" for key, value in keys.items() if value is not None)


MIXTURE = 'kind = "mixture", means = [[0, 0], [1, 1]], covs = [[1, 1], [1, 1]]'
FAULTS = [
    ("state", None, "missing"),
    ("drift", None, "missing"),
    ("observation", None, "missing"),
    ("state", "[]", "1 to 1024 names"),
    ("state", '"x"', "a list of names, got the text 'x'"),
    ("state", '["x", "x"]', "given twice"),
    ("state", '["x", 1]', "a name in quotes"),
    ("state", '["x", "pi"]', "already has a meaning"),
    ("state", '["x", "t"]', "already has a meaning"),
    ("state", '["x", "sin"]', "already has a meaning"),
    ("state", '["x", "lambda"]', "keyword of Python"),
    ("state", '["x", "v w"]', "not a name"),
    ("state", '["x", "\u03b8"]', "not a name"),
    ("drift", '["v"]', "a list of 2 formulas (one a state), got a list of 1"),
    ("drift", '"v"', "a list of 2 formulas"),
    ("drift", '["v", true]', "[1]: expected a formula in quotes or a number, got a boolean"),
    ("drift", '["v", ["x"]]', "[1]: expected a formula"),
    ("drift", '["v", "-b*x"]', "[1]: column 2: unknown name 'b'"),
    ("drift", '["v", "1/0"]', "division by zero"),
    ("drift", '["v", nan]', "finite number"),
    ("diffusion", '["1", "1"]', "2 rows (one a state)"),
    ("diffusion", '[["1"]]', "2 rows (one a state)"),
    ("diffusion", '[["1", "0"], ["1"]]', "[1]: expected 2 rows"),
    ("diffusion", '[["1/(a - 0.1)"], ["1"]]', "not finite"),
    ("process_noise", '[["1", "0"], ["0", "1"]]', "1 rows of 1 formulas"),
    ("process_noise", '[["-1"]]', "not positive semidefinite"),
    ("process_noise", '[["v"]]', "depends on the state 'v'"),
    ("observation", "[]", "formulas (one a sensor)"),
    ("observation", '["y", "x"]', "[0]: column 1: unknown name 'y'"),
    ("observation_noise", '[["1", "0"]]', "2 rows of 2 formulas (one a sensor)"),
    ("observation_noise", '[["1", "0.5"], ["0", "1"]]', "not symmetric"),
    ("observation_noise", '[["1", "2"], ["2", "1"]]', "not positive definite"),
    ("observation_noise", '[["1", "0"], ["0", "0"]]', "not positive definite"),
    ("observation_kind", '"rate"', "did you mean 'rates'"),
    ("observation_kind", "3", "got the number"),
    ("start", '"now"', "expected a number"),
    ("start", "true", "got a boolean"),
    ("start", "inf", "finite number"),
    ("start", "1e999", "finite number"),
    ("periodic", '["w"]', "not a state"),
    ("periodic", '["x"]', "drift[1]: -a*x is not 2*pi-periodic in 'x'"),
    ("functions", '["x"]', "already a state"),
    ("functions", '["exp"]', "already has a meaning"),
    ("parameters", "{a = 0.1, x = 2}", "already a state"),
    ("parameters", "{a = true}", "a: expected"),
    ("parameters", "{a = nan}", "a: expected a finite number"),
    ("parameters", '{a = "x"}', "a: column 1: unknown name"),
    ("parameters", '{a = "sqrt(2)"}', "a: expected a rational number"),
    ("parameters", "3", "a table of names"),
    ("name", "3", "expected a text"),
    ("prior", "3", "expected a table"),
    ("prior", "{}", "kind: expected one of gaussian, mixture, density, uniform, grid, interval; it is missing"),
    ("prior", '{kind = "gausian"}', "did you mean 'gaussian'"),
    ("prior", '{kind = "uniform"}', "kind: uniform is for angles and for domains with two ends, and 'x' has neither"),
    ("prior", '{kind = "gaussian", mean = [0, 0]}', "cov: missing"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [1, 1], weights = [1]}', "unknown key 'weights'"),
    ("prior", '{kind = "gaussian", mean = [0], cov = [1, 1]}', "mean: expected a list of 2 numbers"),
    ("prior", '{kind = "gaussian", mean = [0, "a"], cov = [1, 1]}', "mean: entry 2: expected a number"),
    ("prior", '{kind = "gaussian", mean = [0, true], cov = [1, 1]}', "mean: entry 2: expected a number"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [1, -1]}', "cov: is not positive semidefinite"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [[1, 2], [2, 1]]}', "cov: is not positive semidefinite"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [[1, 2], [0, 9]]}', "cov: is not symmetric"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [[1, 2]]}', "2 x 2"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [1e308, 1]}', "cov: expected numbers of at most 1e+150 in size, got"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [[1, 1e308], [-1e308, 1]]}', "cov: expected numbers of at most 1e+150"),
    ("prior", '{kind = "gaussian", mean = [0, -1e151], cov = [1, 1]}', "mean: expected numbers of at most 1e+150"),
    ("prior", '{kind = "gaussian", mean = [0, 0], cov = [[1e-300, 1e9], [1e9, 1e-300]]}', "cov: is not positive semidefinite"),
    ("prior", f"{{{MIXTURE}, weights = [1e308, 1e308]}}", "weights: expected numbers of at most 1e+150"),
    ("prior", f"{{{MIXTURE}, weights = [1, -1]}}", "weights: expected a list of positive numbers"),
    ("prior", f"{{{MIXTURE}, weights = [1]}}", "means: expected 1 lists of 2 numbers"),
    ("prior", '{kind = "density", log_density = "-x**2 - t"}', "log_density: column 9: unknown name 't'"),
    ("drfit", "[]", "unknown key 'drfit'; did you mean 'drift'"),
    ("obs_noise", "[]", "unknown key 'obs_noise'; did you mean 'observation_noise'"),
    ("_source", '"x"', "unknown key"),
    ("self", "1", "unknown key"),
]


@pytest.mark.parametrize(("key", "value", "words"), FAULTS)
def test_a_wrong_key_is_one_line_that_names_file_and_key(key, value, words, tmp_path):
    path = tmp_path / "vane.toml"
    path.write_text(text(**{key: value}), encoding="utf-8")
    with pytest.raises(InputError) as error:
        load_model(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and message.isprintable() and len(message) < 500
    named = message.removeprefix(f"{path}: ")
    assert named.startswith(key) or f"'{key}'" in named or key == "periodic" and named.startswith("drift")
    assert words in message


def test_the_good_file_is_good(tmp_path):
    (tmp_path / "good.toml").write_text(text())
    assert load_model(tmp_path / "good.toml").start == 0.5


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"state = [", "is not TOML"),
        (b"\xff\xfe", "byte 1 is not UTF-8"),
        (b"state = 'x'\x00", "is not TOML"),
        (b"#" * (1 << 20) + b"#", "larger than 1 MiB"),
        (b"drift = " + b"[" * 100_000, "nested too deep"),
        (b"a" + b".a" * 400_000, "nine or more parts"),
        (b"start = " + b"9" * 100_000, "cannot be read"),
        (b"", "state: missing"),
    ],
)
def test_a_file_that_is_no_model_is_one_line_that_names_it(content, words, tmp_path):
    path = tmp_path / "odd.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as error:
        load_model(path)
    assert str(error.value).startswith(str(path)) and str(error.value).isprintable()


def test_a_byte_order_mark_and_windows_line_ends_are_accepted(tmp_path):
    path = tmp_path / "windows.toml"
    path.write_bytes(b"\xef\xbb\xbf" + text().replace("\n", "\r\n").encode())
    assert load_model(path).state == ("x", "v")


def test_a_missing_file_and_a_folder_are_one_line(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        load_model(tmp_path / "none.toml")
    with pytest.raises(InputError, match="is a folder; give a model file"):
        load_model(tmp_path)


def test_a_pipe_and_a_device_are_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(InputError, match="is not a regular file; give a model file"):
            load_model(path)


@pytest.mark.parametrize("key", ["name", "start", "observation_kind", "drift", "periodic", "functions", "parameters", "prior"])
def test_an_integer_of_a_million_digits_is_one_short_line(tmp_path, key):
    keys = {"state": "['x']", "drift": "['x']", "observation": "['x']"} | {key: "0x" + "f" * 900_000}
    (tmp_path / "m.toml").write_text("\n".join(f"{name} = {value}" for name, value in keys.items()))
    with pytest.raises(InputError, match=rf"m.toml: {key}(\[0\])?: ") as error:
        load_model(tmp_path / "m.toml")
    assert len(str(error.value)) < 300


@pytest.mark.parametrize("name", gallery.names())
def test_every_model_of_the_gallery_loads_and_survives_being_written(name):
    model = load_model(f"gallery:{name}")
    assert model.source == f"gallery:{name}" and model.text.startswith("#")
    again = read_model(model.to_toml(), "again")
    for key in ("state", "drift", "diffusion", "observation", "observation_noise", "process_noise", "parameters",
                "periodic", "start", "observation_kind"):  # fmt: skip
        assert getattr(again, key) == getattr(model, key)
    assert again.to_toml() == model.to_toml()
    assert 20 < len(gallery.describe(name)) < 140


@pytest.mark.parametrize("k", [1, 2, 6, 40])
def test_the_example_that_is_a_family_has_a_member_for_every_exponent(k):
    model = load_model(f"gallery:dong-chen-yau-3-6-k{k}")
    x1, x2, x3, x4 = model.x
    assert model.drift[1] == x1 - x2 - x3**k + x4**k + x2 ** (k + 1) * x3 ** (k + 3)
    # The terms of degree more than one of the last three cancel in their sum.
    assert sympy.expand(sum(model.drift)) == 4 * x1
    assert model.name.endswith(f"k = {k}") and gallery.describe(f"dong-chen-yau-3-6-k{k}").count(f"k = {k}:") == 1
    if k == 1:
        assert model.drift == load_model("gallery:dong-chen-yau-3-6").drift


def test_the_gallery_holds_the_promised_models():
    promised = {"spiral-sensor", "falling-body", "kalman-bucy-1d", "kalman-bucy-2d", "benes", "cubic-sensor",
                "encoder", "wind-vane", "wind-vane-rate", "wong", "dong-chen-yau-3-4", "dong-chen-yau-3-5",
                "dong-chen-yau-3-6", "passive-drift", "benes-2d", "unobserved-double-well", "silent-double-well",
                "lorenz"}  # fmt: skip
    assert promised <= set(gallery.names())
    with pytest.raises(InputError, match="did you mean 'spiral-sensor'"):
        load_model("gallery:spiral-senor")


def test_python_keys_may_be_sympy_numpy_and_numbers():
    x, a = sympy.symbols("x a")
    model = Model(
        state=["x"],
        drift=sympy.Matrix([-a * x + 0.1]),
        observation=[sympy.Abs(x) * sympy.exp(1), x / 3],
        observation_noise=np.diag([0.25, 4.0]),
        parameters={"a": sympy.Rational(1, 3)},
    )
    assert model.drift[0] == -model.parameter_symbols[0] * model.x[0] + sympy.Rational(1, 10)
    assert model.observation_noise[0, 0] == sympy.Rational(1, 4)
    again = read_model(model.to_toml(), "again")
    assert again.observation == model.observation and again.parameters == model.parameters
    with pytest.raises(InputError, match=r"drift\[0\]: .*unknown function 'gamma'"):
        Model(state=["x"], drift=[sympy.gamma(x)], observation=["x"])


def test_a_model_is_immutable_and_can_be_pickled():
    model = load_model("gallery:encoder")
    with pytest.raises(AttributeError):
        model.name = "other"
    assert pickle.loads(pickle.dumps(model)).drift == model.drift


def test_with_parameters_changes_values_and_nothing_else():
    model = load_model("gallery:wind-vane")
    other = model.with_parameters(sigma=0.7)
    sigma, r = model.theta()
    assert other.theta().tolist() == [0.7, r] and sigma != 0.7
    assert other.drift == model.drift and "sigma = 0.7" in other.text
    with pytest.raises(InputError, match="unknown parameter 'sigm'; did you mean 'sigma'"):
        model.with_parameters(sigm=1)
    with pytest.raises(InputError, match="gallery:wind-vane: observation_noise: is not positive definite"):
        model.with_parameters(r=0)


def test_decimals_of_a_file_are_exact_and_weights_are_normalised():
    prior = f"{{{MIXTURE}, weights = [1, 3]}}"
    model = read_model(text(parameters="{a = 0.1234567890123456789012345}", prior=prior), "file")
    assert model.parameters["a"] == sympy.Rational(1234567890123456789012345, 10**25)
    assert model.prior.weights.tolist() == [0.25, 0.75]


def test_a_prior_at_the_bound_is_read_as_it_stands():
    model = read_model(text(prior='{kind = "gaussian", mean = [1e150, 0], cov = [[1e150, 1e70], [1e70, 1e-10]]}'), "file")
    assert model.prior.mean.tolist() == [1e150, 0] and model.prior.cov.tolist() == [[1e150, 1e70], [1e70, 1e-10]]


def test_models_do_not_import_jax():
    import subprocess
    import sys

    code = "import sys, zakai.simulation.simulate, zakai.models.gallery as g; g.load('benes'); assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_matrix_is_a_covariance_whatever_its_units():
    Model(state=["x"], drift=["0"], observation=["x", "x"], observation_noise=[["1e-200", "0"], ["0", "1e200"]])


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("ln(x)", r"unknown function 'ln'; write log\(x\)"),
        ("pow(x, 2)", r"write x\*\*y"),
        ("arcsin(x)", r"write asin\(x\)"),
        ("log10(x)", r"write log\(x\)/log\(10\)"),
        ("x > 0", r"write heaviside\(a - b\) for a > b, or max"),
        ("1 if x > 0 else 2", r"there is no if: write heaviside"),
        ("if(x, 1, 2)", r"there is no if: write heaviside"),
        ("where(x, 1, 2)", r"write heaviside"),
        ("x % 2", r"write a - b\*floor\(a/b\)"),
        ("relu(x)", r"write max\(x, 0\)"),
    ],
)
def test_what_other_languages_have_is_named_with_what_to_write(formula, words):
    with pytest.raises(InputError, match=words):
        Model(state=["x"], drift=[formula], observation=["x"])


def test_one_formula_or_number_is_taken_where_there_is_one_state_or_sensor():
    one = Model(
        state=["x"], drift="-x", diffusion=0.5, process_noise=2, observation="2*x", observation_kind="samples",
        observation_noise=0.04, prior={"kind": "gaussian", "mean": 0.5, "cov": 1.0},
    )  # fmt: skip
    full = Model(
        state=["x"], drift=["-x"], diffusion=[[0.5]], process_noise=[[2]], observation=["2*x"], observation_kind="samples",
        observation_noise=[[0.04]], prior={"kind": "gaussian", "mean": [0.5], "cov": [[1.0]]},
    )  # fmt: skip
    assert one.to_toml() == full.to_toml()
    two = {"state": ["x", "y"], "drift": ["-x", "-y"], "observation": ["x", "y"], "observation_kind": "samples"}
    assert Model(**two, observation_noise=[0.1, 0.2]).to_toml() == Model(**two, observation_noise=[[0.1, 0], [0, 0.2]]).to_toml()
    for wrong in (0.1, [0.1], [0.1, 0.2, 0.3]):
        with pytest.raises(InputError, match="observation_noise: expected 2 rows of 2 formulas"):
            Model(**two, observation_noise=wrong)
    with pytest.raises(InputError, match="drift: expected a list of 2 formulas"):
        Model(**{**two, "drift": "-x"})


def test_a_prior_takes_constant_formulas():
    keys = dict(state=["x"], drift=["-x"], observation=["x"], observation_kind="samples")
    model = Model(**keys, prior={"kind": "gaussian", "mean": ["1/4"], "cov": [["0.5**2"]]})
    assert model.prior.mean.tolist() == [0.25] and model.prior.cov.tolist() == [[0.25]]
    single = Model(**keys, prior={"kind": "gaussian", "mean": "sqrt(4)", "cov": "0.25"})
    assert single.prior.mean.tolist() == [2.0] and single.prior.cov.tolist() == [[0.25]]
    with pytest.raises(InputError, match="prior: mean: entry 1: expected a number, got the text 'x'"):
        Model(**keys, prior={"kind": "gaussian", "mean": ["x"], "cov": [1.0]})
