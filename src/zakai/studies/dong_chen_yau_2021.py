"""Dong, Chen and Yau (2021): finite filters in four dimensions with linear rank one, Examples 3.4 to 3.6 and Wong's system.

The paper computes algebras, Omega matrices and the equations of a filter, and simulates nothing.  The algebras are computed
again; the printed Omega and equations are compared with them entry by entry.  The filter of Theorem 4.1 is run on a member of
the class that does not explode, beside the Kalman-Bucy filter of the part that is observed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import sympy as sp
from scipy.integrate import solve_ivp

from zakai.algebra.analysis import analyze
from zakai.engine.driver import filter as filter_record
from zakai.methods._options import whole_number
from zakai.models.files import load_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.records import Record
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import OURS, PALE, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, by_computation

BASIS = "L0, D1, x1, 1"
STEP, TIME, FAR = 1e-3, 1.0, 1e3
# What is printed of Omega below its diagonal: (25), (27) read by its rows, and (30).
PRINTED = {
    "3-4": ("(25)", {
        (3, 2): "3*x2**2 - 3*x3**2 + x2 + x3 - 6", (4, 2): "-3*x2**2 + 3*x4**2 + 3", (4, 3): "-3*x3**2 - 3*x4**2 + x3 + x4 - 9",
    }),
    "3-5": ("(27)", {
        (3, 2): "5*x2**8*x3**4 + 8*x2**7*x3**5 + 8*x2**7 - 7*x3**6", (4, 2): "-8*x2**7 + 7*x4**6",
        (4, 3): "6*x3**5*x4**3 + 3*x3**6*x4**2 - 7*x3**6 - 7*x4**6",
    }),
}  # fmt: skip
PRINTED_30 = {
    (2, 3): "-(k + 3)*x2**(k + 1)*x3**(k + 2) - (k + 1)*x2**k*x3**(k + 3) - (k + 2)*x2**(k + 1) + k*x3**(k - 1)",
    (2, 4): "(k + 2)*x2**(k + 1) - k*x4**(k - 1)",
    (3, 4): "-k*x3**(k + 5)*x4**(k - 1) - (k + 5)*x3**(k + 4)*x4**k + k*x3**(k - 1) + k*x4**(k - 1)",
}


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    largest: int = 6,
    paths: int = 1000,
    observations: int = 5,
    seed: int = 1,
) -> Reproduction:
    """Every example.

    progress: called with the work done and all of it. pictures: where they go. largest: Example 3.6 is computed for k = 1 to
    this. paths: of Example 3.4, simulated for the share that explodes. observations: of the record on which the filter of Theorem
    4.1 is run; 0 leaves it out. seed: of the paths and the record.
    """
    whole_number("largest", largest, 1, 12)
    whole_number("paths", paths, 2, 10**6)
    whole_number("observations", observations, 0, 50)
    whole_number("seed", seed, 0, 2**31)
    pictures = pictures or Pictures()
    work = Progress(progress, 5)
    comparisons = examples(largest)
    work.add()
    comparisons += filters_equations()
    work.add()
    comparisons += misprints()
    work.add()
    times, exploded = explosions(paths, seed)
    share, error = float(exploded[-1]), float(np.sqrt(exploded[-1] * (1 - exploded[-1]) / paths))
    said = "not said in the paper; its densities lose mass, so that no time may be long"
    comparisons.append(Comparison(f"Example 3.4: share of paths that explode before t = {TIME:g}", None, share, error, said))
    pictures.add("explosion", partial(draw, times, exploded, paths))
    work.add()
    if observations:
        comparisons.append(filtered(observations, seed))
    work.add()
    return reproduction(comparisons, {"largest": largest, "paths": paths, "observations": observations, "seed": seed})


def verdict(model: Model) -> str:
    """The dimension and the basis of a finite algebra, or the word for another one."""
    algebra = analyze(model).algebra
    return ", ".join(map(str, algebra.basis)) if algebra.verdict == "finite" else algebra.verdict


def examples(largest: int) -> list[Comparison]:
    """Basis, linear rank, Omega and eta of Examples 3.4 to 3.6, and of Wong's system."""
    found = []
    names = {"3-4": "Example 3.4", "3-5": "Example 3.5"}
    names |= {"3-6" if k == 1 else f"3-6-k{k}": f"Example 3.6, k = {k}" for k in range(1, largest + 1)}
    for key, name in names.items():
        model = load_model(f"gallery:dong-chen-yau-{key}")
        analysis = analyze(model)
        basis, rank = verdict(model), analysis.algebra.linear_rank
        holds = basis == BASIS and rank == 1
        found.append(by_computation(f"{name}: basis, linear rank", f"{BASIS}; 1", f"{basis}; {rank}", holds))
        number, printed = omega_of(key)
        right = sum(matches(analysis.omega, pair, text, model) for pair, text in printed.items())
        assert analysis.omega is not None
        zeros = all(analysis.omega[0, j] == 0 for j in range(4))
        what = f"{name}: entries of Omega {number} that are right"
        found.append(by_computation(what, "3", str(right), right == 3 and zeros, "an entry is misprinted"))
    model = load_model("gallery:dong-chen-yau-3-4")
    (c,) = model.parameter_symbols
    eta = analyze(model).eta
    assert eta is not None
    square = sp.expand(eta).coeff(model.x[0], 2)
    because = "h = c x1 adds the square of c"
    found.append(by_computation("Examples: coefficient of x1^2 in eta", "4", str(square), square == 4, because))
    of_wong, basis = "L0, D2 - D3, x2 - x3, 1", verdict(load_model("gallery:wong"))
    return [*found, by_computation("Wong's system (11): basis", of_wong, basis, basis == of_wong)]


def omega_of(key: str) -> tuple[str, dict[tuple[int, int], str]]:
    """The number of the printed Omega and its entries."""
    if key in PRINTED:
        return PRINTED[key]
    k = int(key.partition("-k")[2] or 1)
    return "(30)", {pair: text.replace("k", str(k)) for pair, text in PRINTED_30.items()}


def matches(omega: Any, pair: tuple[int, int], text: str, model: Model) -> bool:
    """Whether an entry of Omega is this polynomial."""
    printed = Model(state=list(model.state), drift=[text, "0", "0", "0"], observation=["0"])
    expected = printed.drift[0].subs(dict(zip(printed.x, model.x)))
    return sp.expand(omega[pair[0] - 1, pair[1] - 1] - expected) == 0


def filters_equations() -> list[Comparison]:
    """(34) and (53) beside the equations of Wei and Norman that the computed algebra gives."""
    model = load_model("gallery:dong-chen-yau-3-4")
    (c,), found = model.parameter_symbols, analyze(model).algebra.wei_norman
    assert found is not None
    (r2, r1, _), (y,) = found.statistics, found.path
    computed = list(found.robust.values())

    def of(a2: Any) -> list[Any]:
        return [r1 + c * y, a2 * r2, r1**2 / 2 + a2 * r2**2 / 2 + c * y * r1 + c**2 * y**2 / 2]

    def same(printed: list[Any]) -> bool:
        return all(sp.expand(a - b) == 0 for a, b in zip(computed, printed, strict=True))

    by_34, by_53 = same(of(4 + c**2)), same(of(4))
    because = "a_2 is 4 + c^2; r0' has half of that"
    return [
        by_computation("Theorem 4.1 (34), a_2 the coefficient of x1^2: equations", "3", "3" if by_34 else "others", by_34),
        by_computation("(53), Example 3.4: r1'", "4 r2", f"({sp.diff(computed[1], r2)}) r2", by_53, because),
    ]


def misprints() -> list[Comparison]:
    """Two drifts as the text prints them, whose algebras are infinite."""
    model = load_model("gallery:dong-chen-yau-3-4")
    x2, x3 = model.x[1], model.x[2]
    drift = [str(entry) for entry in (*model.drift[:2], sp.expand(model.drift[2] + x2**3 - x3**3), model.drift[3])]
    printed = verdict(Model(state=list(model.state), drift=drift, observation=["x1"]))
    introduction = ["x1 + x2 + x3 + gamma(x1 + x2 + x3)", "x1 + x3", "x2 - x3"]
    equation_11 = ["x1 + x2 + x3 + gamma(x1, x2, x3)", "x1 + x3", "x1 + x2"]

    def wong(drift: list[str]) -> str:
        return verdict(Model(state=["x1", "x2", "x3"], drift=drift, observation=["x2 - x3"], functions=["gamma"]))

    return [
        by_computation(what, "finite", ours, ours != "infinite", because)
        for what, ours, because in (
            ("Example 3.4 with phi_3 of the text", printed, "-x3^3 is -x2^3, as in (26)"),
            ("Wong's system with f_3 of the introduction", wong(introduction), "x2 - x3 is x1 + x2, as in (11)"),
            ("Wong's system with gamma(x1, x2, x3)", wong(equation_11), "gamma is a function of x1 + x2 + x3"),
        )
    ]


def explosions(paths: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times, and the share of paths of Example 3.4 from the origin that are beyond `FAR` by then, by Heun's steps."""
    model = load_model("gallery:dong-chen-yau-3-4")
    drift, theta = numpy_function(model.drift, model), model.theta()
    rng = np.random.default_rng(seed)
    x, gone, share = np.zeros((paths, 4)), np.zeros(paths, bool), []
    for _ in range(round(TIME / STEP)):
        noise, here = np.sqrt(STEP) * rng.standard_normal((paths, 4))[~gone], x[~gone]
        slope = drift(here, 0.0, theta)
        x[~gone] = here + STEP / 2 * (slope + drift(here + STEP * slope + noise, 0.0, theta)) + noise
        gone |= np.abs(x).max(axis=1) > FAR
        share.append(gone.mean())
    return STEP * np.arange(1, len(share) + 1), np.array(share)


def filtered(observations: int, seed: int) -> Comparison:
    """The mean of x1 by Wei and Norman's filter in three states, against Kalman and Bucy's of (x1, x2 + x3)."""
    model = load_model("gallery:passive-drift")
    times = 0.1 * np.arange(1, observations + 1)
    _, record = simulate(model, times, seed=seed)
    result = filter_record(model, record, "wei-norman", keep="moments")
    means, deviations = kalman_bucy(record)
    worst = float((np.abs(result.mean[1:, 0] - means) / deviations).max())
    what = "Theorem 4.1 on a member of the class: error of E[x1], deviations"
    return by_computation(what, "0", f"{worst:.1e}", worst < 1e-4, "the grid is too coarse")


def kalman_bucy(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation (K,) of x1 by Kalman and Bucy's equations, y running linearly between observations.

        dx1 = (x1 + s) dt + dv,    ds = (2 x1 - s + 1/10) dt + sqrt(2) dv',    dy = 2 x1 dt + dw,    s = x2 + x3
    """
    A, b, G, C = np.array([[1.0, 1.0], [2.0, -1.0]]), np.array([0.0, 0.1]), np.diag([1.0, 2.0]), np.array([2.0, 0.0])
    mean, cov, start = np.zeros(2), np.diag([0.1, 0.2]), 0.0
    means, deviations = [], []
    for stop, increment in zip(record.times, record.values[:, 0], strict=True):
        slope = increment / (stop - start)

        def rate(t: float, flat: np.ndarray, slope: float = slope) -> np.ndarray:
            m, P = flat[:2], flat[2:].reshape(2, 2)
            gain = P @ C
            return np.concatenate([A @ m + b + gain * (slope - C @ m), (A @ P + P @ A.T + G - np.outer(gain, gain)).ravel()])

        flat = solve_ivp(rate, (start, stop), np.concatenate([mean, cov.ravel()]), "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        mean, cov, start = flat[:2], flat[2:].reshape(2, 2), stop
        means.append(mean[0])
        deviations.append(np.sqrt(cov[0, 0]))
    return np.array(means), np.array(deviations)


def reproduction(comparisons: list[Comparison], settings: dict[str, Any]) -> Reproduction:
    """The figures and what they say."""
    return Reproduction(
        "Dong, Chen and Yau 2021: estimation algebras of dimension four and linear rank one in four states",
        "Published are algebras, Omega matrices and the equations of a filter; nothing is simulated. Checked, in exact "
        "arithmetic, are the bases, the linear rank, every entry of Omega and the equations; and, on a system of the class "
        f"whose paths do not explode, the filter on {settings['observations']} observations beside a "
        f"Kalman-Bucy filter that shares no "
        "code with it.",
        tuple(comparisons),
        "the algebras of Examples 3.4 to 3.6 and of Wong's system are those of the paper, every entry of Omega too (the "
        "columns of (27) are set in the wrong places). What differs are misprints: phi_3 in the text of Example 3.4, Wong's "
        "drift in the introduction and its gamma, and 4 for 4 + c^2 in eta and in (53). What is observed is linear: x1 and "
        "the sum of the other states are a linear system by themselves. Paths of Example 3.4 explode, so that its filter is "
        "one for short times.",
        (),
        settings,
    )


def draw(times: np.ndarray, exploded: np.ndarray, paths: int) -> Any:
    """The share of paths of Example 3.4 that have exploded."""
    figure = new_figure(7.0, 3.8)
    panel = plain(figure.subplots())
    error = 2 * np.sqrt(exploded * (1 - exploded) / paths)
    panel.fill_between(times, exploded - error, exploded + error, color=PALE, label="two standard errors")
    panel.plot(times, exploded, color=OURS, linewidth=1.4, label="exploded")
    panel.set_xlabel("t")
    panel.set_ylabel("share of paths")
    panel.legend(frameon=False, fontsize=9)
    figure.suptitle(f"Dong, Chen and Yau 2021, Example 3.4: {paths:,} paths from the origin", fontsize=11)
    return figure
