"""One-state grid filters of models with tables, counts, inputs, state-dependent noise: against dense Bayes in plain NumPy.

The references share no code with the package: a transition is the exponential of a difference operator of sixth order on a fine
grid, or a known kernel, and an observation is a factor that is written out.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import gammaln, i0
from scipy.stats import ncx2
from scipy.stats import t as student

import zakai


def model_of(drift="-x", observation="x", **keys):
    keys = {"prior": {"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]}, "observation_kind": "samples", **keys}
    if observation is not None:
        keys["observation"] = [observation]
    return zakai.Model(state=["x"], drift=[drift], **keys)


def difference_matrices(size, spacing):
    """First and second derivative of eighth order; the density is negligible at the ends."""
    first = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    second = {1: 8 / 5, 2: -1 / 5, 3: 8 / 315, 4: -1 / 560}
    D1, D2 = np.zeros((size, size)), -205 / 72 * np.eye(size)
    for k in first:
        D1 += first[k] * (np.eye(size, k=k) - np.eye(size, k=-k))
        D2 += second[k] * (np.eye(size, k=k) + np.eye(size, k=-k))
    return D1 / spacing, D2 / spacing**2


def dense(x, f, G, likelihoods, lengths, prior, reset=None):
    """Mean, variance and log-likelihood increment after each sample; f, G (N,) or functions of the interval's number."""
    D1, D2 = difference_matrices(len(x), x[1] - x[0])
    known, rows = {}, []
    p = prior(x) / np.sum(prior(x))
    for k, (length, likelihood) in enumerate(zip(lengths, likelihoods, strict=True)):
        drift, diffusion = (a(k) if callable(a) else a for a in (f, G))
        key = round(length, 12), k if callable(f) or callable(G) else 0
        if key not in known:
            known[key] = expm(length * (0.5 * D2 * diffusion - D1 * drift))
        p = known[key] @ p
        p = p * likelihood(x)
        mass = p.sum()
        p = p / mass
        mean = x @ p
        rows.append((mean, (x - mean) ** 2 @ p, np.log(mass)))
    return np.array(rows)


def normal(mean, variance):
    return lambda x: np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)


def error(result, expected):
    """The largest error of mean and deviation in deviations, and of the log-likelihood increments."""
    deviation = np.sqrt(expected[:, 1])
    mean = np.abs(result.mean[1:, 0] - expected[:, 0]) / deviation
    spread = np.abs(np.sqrt(result.variance[1:, 0]) / deviation - 1)
    return max(mean.max(), spread.max(), np.abs(result.log_likelihood_increments[1:] - expected[:, 2]).max())


def samples(times, values, inputs=None):
    return zakai.Record(times, np.array(values, float).reshape(len(times), -1), "samples", inputs)


TIMES = np.cumsum([0.1, 0.25, 0.1, 0.5, 0.04, 0.5, 0.25])
X = np.linspace(-6, 6, 241)

LAWS = {
    "counts": (
        {"observation": "2*exp(0.7*x)", "observation_family": "poisson"},
        [2, 1, 0, 4, 3, 9, 1],
        lambda z: lambda x: np.exp(z * np.log(2 * np.exp(0.7 * x)) - 2 * np.exp(0.7 * x) - gammaln(z + 1)),
    ),
    "volatility": (
        {"observation": "0", "observation_noise": [["exp(x - 1)"]]},
        [0.3, -1.1, 0.02, 0.7, -0.4, 2.5, 0.0],
        lambda z: lambda x: normal(0.0, np.exp(x - 1))(z),
    ),
    "student-t": (
        {"observation": "x + 0.2*x**2", "observation_noise": [["0.3"]], "observation_family": "student-t",
         "degrees_of_freedom": 3},
        [0.3, -1.1, 0.02, 0.7, 9.0, 1.5, 0.0],
        lambda z: lambda x: student.pdf((z - x - 0.2 * x**2) / np.sqrt(0.3), 3) / np.sqrt(0.3),
    ),
    "von-mises": (
        {"observation": "2*x", "observation_family": "von-mises", "concentration": 4},
        [0.3, -1.1, 0.02, 3.0, -3.0, 1.5, 0.0],
        lambda z: lambda x: np.exp(4 * np.cos(z - 2 * x)) / (2 * np.pi * i0(4.0)),
    ),
    "log density": (
        {"observation": None, "observation_log_density": "-(z - x)**4 - log(1.8128049541109543)", "observed": ["z"]},
        [0.3, -1.1, 0.02, 0.7, -0.4, 1.5, 0.0],
        lambda z: lambda x: np.exp(-((z - x) ** 4)) / 1.8128049541109543,
    ),
    "noise that grows": (
        {"observation": "x", "observation_noise": [["(0.03 + 0.05*tanh(x)**2)**2"]]},
        [0.3, -1.1, 0.02, 0.7, 0.4, 1.1, 0.2],
        lambda z: lambda x: normal(x, (0.03 + 0.05 * np.tanh(x) ** 2) ** 2)(z),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAWS)
def test_laws_of_samples_are_those_of_dense_bayes(name):
    keys, values, law = LAWS[name]
    model = model_of("-0.8*x + 0.3*sin(2*x)", **keys)
    result = zakai.filter(model, samples(TIMES, values), method="yau-yau")
    x = np.linspace(-5, 5, 601) if name.startswith("noise") else X
    lengths = np.diff(np.concatenate([[0.0], TIMES]))
    f = -0.8 * x + 0.3 * np.sin(2 * x)
    expected = dense(x, f, np.ones(len(x)), [law(z) for z in values], lengths, normal(0.2, 0.5))
    assert error(result, expected) < 1e-6
    assert not result.warnings


GROWING = {
    "-x^3 with .5 + .3 sin x": ("-x**3", "0.5 + 0.3*sin(x)", lambda x: -(x**3), lambda x: 0.5 + 0.3 * np.sin(x)),
    "sin x with sqrt(1 + x^2)": ("2*sin(x)", "0.5*sqrt(1 + x**2)", lambda x: 2 * np.sin(x), lambda x: 0.5 * np.sqrt(1 + x**2)),
}


@pytest.mark.parametrize("name", GROWING)
def test_state_dependent_diffusion_is_that_of_a_converged_solution(name):
    f, g, drift, diffusion = GROWING[name]
    model = model_of(f, "x", diffusion=[[g]], observation_noise=[["0.1"]])
    values = [0.3, -0.6, 0.02, 0.7, -0.4, 0.9, 0.0]
    result = zakai.filter(model, samples(TIMES, values), method="yau-yau")
    x = X if name.startswith("-x^3") else np.linspace(-14, 14, 481)
    likelihoods = [normal(z, 0.1) for z in values]
    lengths = np.diff(np.concatenate([[0.0], TIMES]))
    expected = dense(x, drift(x), diffusion(x) ** 2, likelihoods, lengths, normal(0.2, 0.5))
    assert error(result, expected) < 1e-5
    assert not result.warnings


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_inputs_with_times_of_their_own(hold):
    inputs = zakai.Inputs(np.array([0.0, 0.07, 0.2, 0.61, 1.3, 1.8]), np.array([[1.0], [-2.0], [3.0], [0.0], [2.0], [-1.0]]))
    model = model_of(
        "-x**3 + u", "x + 0.1*u", inputs=["u"], input_hold=hold, observation_noise=[["0.1"]], diffusion=[["1 + 0.1*u"]]
    )
    values = [0.3, -0.6, 0.02, 0.7, -0.4, 0.9, 0.0]
    result = zakai.filter(model, samples(TIMES, values, inputs), method="yau-yau")
    # The reference takes midpoints of short steps in which u hardly varies.
    count = 1 if hold == "zero" else 20
    cuts = np.unique(np.concatenate([[0.0], TIMES, inputs.times]))
    ends = np.unique(np.concatenate([np.linspace(a, b, count + 1) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]))
    middle = 0.5 * (ends[1:] + ends[:-1])
    place = np.searchsorted(inputs.times, middle, side="right") - 1
    column = inputs.values[:, 0]
    u = column[place] if hold == "zero" else np.interp(middle, inputs.times, column)
    at = [column[np.searchsorted(inputs.times, t, side="right") - 1] if hold == "zero" else np.interp(t, inputs.times, column)
          for t in TIMES]  # fmt: skip
    nothing = lambda x: np.ones(len(x))  # noqa: E731
    sampled = {t: (lambda x, z=z, v=v: normal(x + 0.1 * v, 0.1)(z)) for t, z, v in zip(TIMES, values, at, strict=True)}
    likelihoods = [sampled.get(end, nothing) for end in ends[1:]]
    x = np.linspace(-4, 4, 121)
    rows = dense(
        x, lambda k: -(x**3) + u[k], lambda k: np.full(len(x), (1 + 0.1 * u[k]) ** 2), likelihoods, np.diff(ends),
        normal(0.2, 0.5),
    )  # fmt: skip
    last = np.searchsorted(ends[1:], TIMES)
    rows[:, 2] = np.cumsum(rows[:, 2])
    expected = rows[last]
    expected[:, 2] = np.diff(np.concatenate([[0.0], expected[:, 2]]))
    assert error(result, expected) < (1e-6 if hold == "zero" else 1e-4)
    assert not result.warnings


def by_transition(x, weights, density, transition, values, law):
    """The same for a transition density (N, N) from column to row on points x with quadrature weights."""
    rows, p = [], density(x) / (weights @ density(x))
    for value in values:
        p = transition @ (weights * p) * law(value)(x)
        mass = weights @ p
        p = p / mass
        mean = weights @ (x * p)
        rows.append((mean, weights @ ((x - mean) ** 2 * p), np.log(mass)))
    return np.array(rows)


def test_cox_ingersoll_ross_against_its_exact_transition():
    model = model_of(
        "1.3*(2 - x)", "x", diffusion=[["0.9*sqrt(x)"]], observation_noise=[["0.04"]], domain={"x": {"lower": 0.0}},
        prior={"kind": "density", "log_density": "3*log(x) - 2*x"},
    )  # fmt: skip
    a, b, s, length = 1.3, 2.0, 0.9, 0.25
    values = [2.3, 1.1, 1.4, 0.6, 0.5, 0.2, 1.0]
    result = zakai.filter(model, samples(length * np.arange(1.0, 8.0), values), method="yau-yau")
    w = np.linspace(-6.5, 2.8, 500)
    x, weights = np.exp(w), np.exp(w) * (w[1] - w[0])
    c = 2 * a / (s**2 * (1 - np.exp(-a * length)))
    transition = 2 * c * ncx2.pdf(2 * c * x[:, None], 4 * a * b / s**2, 2 * c * x * np.exp(-a * length))
    expected = by_transition(x, weights, lambda x: x**3 * np.exp(-2 * x), transition, values, lambda z: normal(z, 0.04))
    assert error(result, expected) < 1e-5
    assert not result.warnings
    density = result.density(3)
    assert density.log_density(np.array([-0.1, 1.0]))[0] == -np.inf
    grid = np.linspace(1e-3, 6, 4001)
    assert np.sum(np.exp(density.log_density(grid))) * (grid[1] - grid[0]) == pytest.approx(1.0, abs=1e-8)
    assert density.mean()[0] == pytest.approx(result.mean[3, 0], abs=1e-9)


def test_a_square_root_without_a_domain_is_filtered_and_smoothed():
    a, b, s, lengths = 1.0, 1.0, 0.3, np.array([0.3, 0.1, 0.9, 0.3])
    keys = {"diffusion": [[f"{s}*sqrt(x)"]], "observation_noise": [["0.1"]]}
    model = model_of(f"{a}*({b} - x)", "x", prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.01]]}, **keys)
    record, law = samples(np.cumsum(lengths), [0.9, 1.3, 0.5, 0.8]), lambda z: normal(z, 0.1)
    x = np.linspace(0.05, 4.0, 1500)
    kernels = []
    for length in lengths:
        c = 2 * a / (s**2 * (1 - np.exp(-a * length)))
        kernels.append(2 * c * ncx2.pdf(2 * c * x[:, None], 4 * a * b / s**2, 2 * c * x * np.exp(-a * length)))
    densities, message = [normal(1.0, 0.01)(x)], np.ones(len(x))
    for kernel, z in zip(kernels, record.values[:, 0], strict=True):
        densities.append(kernel @ densities[-1] * law(z)(x) / np.sum(kernel @ densities[-1] * law(z)(x)))
    products = [densities[-1]]
    for kernel, density, z in zip(kernels[::-1], densities[-2::-1], record.values[::-1, 0], strict=True):
        message = kernel.T @ (message * law(z)(x))
        products.append(density * message)
    for result, found in ((zakai.filter(model, record), densities), (zakai.smooth(model, record), products[::-1])):
        means = [x @ p / p.sum() for p in found]
        assert not result.warnings
        assert np.allclose(result.mean[:, 0], means, atol=1e-5)
        assert np.allclose(
            result.variance[:, 0], [x**2 @ p / p.sum() - m**2 for p, m in zip(found, means, strict=True)], rtol=1e-4
        )


@pytest.mark.parametrize("lower", [0.0, -1e6])
def test_geometric_brownian_motion_is_lognormal(lower):
    shifted = "x" if lower == 0 else f"(x + {-lower})"
    model = model_of(
        f"0.2*{shifted}", f"{shifted}", diffusion=[[f"0.4*{shifted}"]], observation_noise=[["0.01"]],
        domain={"x": {"lower": lower}}, prior={"kind": "gaussian", "mean": [lower + 1.5], "cov": [[0.05]]},
    )  # fmt: skip
    values, length = [1.6, 1.4, 1.9, 2.2, 2.1], 0.5
    result = zakai.filter(model, samples(length * np.arange(1.0, 6.0), values), method="yau-yau")
    w = np.linspace(-3, 3, 1001)
    x, weights = np.exp(w), np.exp(w) * (w[1] - w[0])
    transition = normal(w + (0.2 - 0.08) * length, 0.16 * length)(w[:, None]) / x[:, None]
    expected = by_transition(x, weights, normal(1.5, 0.05), transition, values, lambda z: normal(z, 0.01))
    expected[:, 0] += lower
    assert error(result, expected) < 1e-5
    assert not result.warnings


@pytest.mark.parametrize("method", ["yau-yau"])
@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_tables_are_their_formulas_and_warn_beyond_their_range(method, kind):
    points = np.linspace(-6, 6, 13)
    table = {"sensor": {"x": points.tolist(), "values": (points + 0.5 * np.abs(points)).tolist(), "kind": kind}}
    keys = {"observation_noise": [["0.1"]], "prior": {"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]}}
    values = [0.3, -0.6, 0.02, 0.7, -0.4, 0.9, 0.0]
    model = model_of("-x", "sensor(x)", tables=table, **keys)
    result = zakai.filter(model, samples(TIMES, values), method=method)
    if kind == "linear":  # it has its kink at a node
        other = zakai.filter(model_of("-x", "x + 0.5*abs(x)", **keys), samples(TIMES, values), method=method)
        assert result.mean == pytest.approx(other.mean, abs=1e-9)
        assert result.log_likelihood == pytest.approx(other.log_likelihood, abs=1e-9)
    narrow = {"sensor": {"x": [-0.5, 0.0, 0.3, 0.5], "values": [-0.5, 0.0, 0.3, 0.5], "kind": kind}}
    said = zakai.filter(model_of("-x", "sensor(x)", tables=narrow, **keys), samples(TIMES, values), method=method).warnings
    assert any("outside_tables" in sentence for sentence in said)


def test_counts_without_a_law_are_reported():
    model = model_of("-x", "x", observation_family="poisson")
    result = zakai.filter(model, samples(TIMES, [0, 1, 0, 2, 1, 0, 0]), method="yau-yau")
    assert any("without_law" in sentence for sentence in result.warnings)


GRADIENTS = {
    "counts": ({"observation": "c*exp(a*x)", "observation_family": "poisson"}, [2, 1, 0, 4, 3, 9, 1]),
    "volatility": ({"observation": "0", "observation_noise": [["c*exp(a*x)"]]}, [0.3, -1.1, 0.02, 0.7, -0.4, 2.5, 0.0]),
    "diffusion": ({"observation": "x", "diffusion": [["c + a*sin(x)/3"]]}, [0.3, -1.1, 0.02, 0.7, -0.4, 1.5, 0.0]),
    "inputs": ({"observation": "c*x + a*u", "inputs": ["u"]}, [0.3, -1.1, 0.02, 0.7, -0.4, 1.5, 0.0]),
    "domain": (
        {"observation": "x", "drift": "c*(2 - x)", "diffusion": [["a*sqrt(x)"]], "domain": {"x": {"lower": 0.0}},
         "prior": {"kind": "gaussian", "mean": [2.0], "cov": [[0.1]]}},
        [2.3, 1.1, 1.4, 2.6, 1.5, 2.2, 1.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients_are_differences(name):
    keys, values = GRADIENTS[name]
    model = model_of(**{"drift": "-0.8*x" if "inputs" not in keys else "-x**3 + a*u", **keys}, parameters={"a": 0.7, "c": 0.9})
    inputs = zakai.Inputs(np.array([0.0, 0.2, 0.61]), np.array([[1.0], [-2.0], [0.5]])) if "inputs" in keys else None
    record, names = samples(TIMES, values, inputs), ["a", "c"]

    def evidence(parameters):
        return zakai.filter(model.with_parameters(**dict(zip(names, parameters, strict=True))), record, method="yau-yau",
                            tolerance=1e-8).log_likelihood  # fmt: skip

    likelihood = zakai.log_likelihood(model, record, method="yau-yau", tolerance=1e-8)
    value, gradient = likelihood.value_and_gradient([0.7, 0.9])
    point = np.array([0.7, 0.9])
    assert value == pytest.approx(evidence(point), abs=1e-9)
    for i, unit in enumerate(np.eye(2) * 1e-3):
        difference = (evidence(point + unit) - evidence(point - unit)) / 2e-3
        assert gradient[i] == pytest.approx(difference, abs=3e-6 * (1 + abs(difference)))


@pytest.mark.parametrize("name", GRADIENTS)
def test_records_batches_online_filters_and_checkpoints_agree_to_the_bit(name, tmp_path):
    keys, values = GRADIENTS[name]
    model = model_of(**{"drift": "-0.8*x" if "inputs" not in keys else "-x**3 + a*u", **keys}, parameters={"a": 0.7, "c": 0.9})
    inputs = zakai.Inputs(np.array([0.0, 0.2, 0.61]), np.array([[1.0], [-2.0], [0.5]])) if "inputs" in keys else None
    record = samples(TIMES, values, inputs)
    result = zakai.filter(model, record, method="yau-yau")
    shorter = samples(TIMES[:3], values[:3], inputs)
    for one in zakai.filter(model, [shorter, record], method="yau-yau"):
        count = len(one.mean)
        assert np.array_equal(one.mean, result.mean[:count]) and np.array_equal(one.variance, result.variance[:count])
    online = zakai.online(model, method="yau-yau")
    for k, (time, value) in enumerate(zip(TIMES, values, strict=True)):
        if k == 4:
            online.save(tmp_path / "checkpoint")
            online = zakai.online(model, method="yau-yau")
            online.restore(tmp_path / "checkpoint")
        given = {"inputs": inputs} if inputs is not None and k == 0 else {}
        estimate = online.update(time, [float(value)], **given)
        assert np.array_equal(estimate.mean, result.mean[k + 1])
        assert np.array_equal(estimate.cov, result.cov[k + 1])


def test_a_narrow_posterior_with_a_mode_far_away_is_that_of_bayes_rule():
    """A mode of the mass 1e-10 far away makes the grid wide."""
    model = model_of("-0.8*x + 0.3*sin(2*x)", "x", observation_noise=[["(0.03 + 0.05*x**2)**2"]])
    result = zakai.filter(model, samples(TIMES[:1], [0.3]), method="yau-yau")
    predicted = zakai.filter(model, samples(TIMES[:1], [np.nan]), method="yau-yau").density(1)
    x = np.linspace(-6, 6, 400001)
    noise = 0.03 + 0.05 * x**2
    p = np.exp(predicted.log_density(x[:, None]) - 0.5 * ((0.3 - x) / noise) ** 2) / noise
    p /= p.sum()
    mean = p @ x
    deviation = np.sqrt(p @ (x - mean) ** 2)
    assert abs(result.mean[1, 0] - mean) < 1e-7 * deviation
    assert abs(np.sqrt(result.variance[1, 0]) - deviation) < 1e-7 * deviation
    assert not result.warnings


def test_a_log_density_that_depends_on_time_is_that_of_its_time():
    values = [0.3, -1.1, 0.02, 0.7, -0.4, 1.5, 0.0]
    keys = {"observation": None, "observation_log_density": "-(z - x)**2/2 - t*x", "observed": ["z"]}
    result = zakai.filter(model_of(**keys), samples(TIMES, values), method="yau-yau")
    likelihoods = [lambda x, z=z, t=t: np.exp(-((z - x) ** 2) / 2 - t * x) for z, t in zip(values, TIMES, strict=True)]
    expected = dense(X, -X, np.ones(len(X)), likelihoods, np.diff(np.concatenate([[0.0], TIMES])), normal(0.2, 0.5))
    assert error(result, expected) < 1e-6


@pytest.mark.parametrize("observation", ["x", "x**3", "atan(x)"])
@pytest.mark.parametrize("value", [1e8, 1e20, 9.969209968386869e36, -1e150])
def test_a_fill_value_that_is_no_observation_warns(observation, value):
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=[observation], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    record = zakai.Record([0.1, 0.2, 0.9], [[0.1], [value], [0.2]], "samples")
    assert any("tail_depth" in warning for warning in zakai.filter(model, record, "limited-direct").warnings)


def test_an_end_that_is_reached_is_not_natural():
    prior = {"kind": "density", "log_density": "-x"}
    model = model_of(domain={"x": {"lower": 0.0}}, prior=prior)
    with pytest.raises(zakai.InputError, match="reaches the end 0 of 'x'.*reflecting"):
        zakai.filter(model, zakai.Record([0.5], [0.3], "samples"))
    entered = model_of("1/x", domain={"x": {"lower": 0.0}}, prior={"kind": "density", "log_density": "2*log(x) - x**2"})
    assert zakai.filter(entered, zakai.Record([0.5], [0.3], "samples")).mean[-1, 0] > 0
