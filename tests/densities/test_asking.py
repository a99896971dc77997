"""What a density cannot be asked is refused in one line."""

import numpy as np
import pytest

import zakai
from zakai.densities import GaussianMixture, GridDensity
from zakai.errors import InputError

PLANE = GaussianMixture.gaussian(np.zeros(2), np.eye(2), ("x", "y"), (False, False))
LINE = GaussianMixture.gaussian(np.zeros(1), np.eye(1), ("x",), (False,))


@pytest.mark.parametrize("density", [PLANE])
@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda d: d.log_density(np.zeros(3)), r"x has shape \(3,\); expected \(\.\.\., 2\)"),
        (lambda d: d.log_density(0.0), r"x has shape \(\); expected \(\.\.\., 2\)"),
        (lambda d: d.sample(0, -1), "count is -1"),
        (lambda d: d.sample(0, 2.5), "count is 2.5"),
        (lambda d: d.marginal([]), "one state or several different ones"),
        (lambda d: d.marginal(["x", "x"]), "one state or several different ones"),
    ],
)
def test_a_question_that_has_no_answer_says_what_was_expected(density, ask, said):
    with pytest.raises(InputError, match=said):
        ask(density)


def test_a_lattice_checks_the_same():
    model = zakai.load_model("gallery:spiral-sensor")
    density = zakai.filter(model, zakai.simulate(model, [0.01], seed=0)[1]).density(1)
    assert isinstance(density, GridDensity)
    with pytest.raises(InputError, match="expected"):
        density.sample(0, -1)
    assert density.log_density([0.0, 0.1]).shape == density.log_density([[0.0], [0.1]]).shape == (2,)


def test_one_state_needs_no_axis_of_its_own():
    assert LINE.log_density(0.0).shape == () and LINE.log_density(np.zeros((4, 1))).shape == LINE.log_density(np.zeros(4)).shape
