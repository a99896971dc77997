"""A drift with waves much shorter than a broad prior is not lost between the points of the grid that resolves the prior.

Reference: the Kolmogorov forward equation on a uniform chain of birth and death rates, by implicit steps, extrapolated in the
spacing.
"""

import numpy as np
import pytest
from scipy.linalg import solve_banded

import zakai

STEPS = 400


def expected(*case):
    """Return the mean, the standard deviation and the evidence after one sample."""
    return (4.0 * after(16000, *case) - after(8000, *case)) / 3.0


def after(count, drift, intensity, deviation, length, value, noise):
    edges = np.linspace(-8.0 * deviation, 8.0 * deviation, count + 1)
    x, spacing = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    diffusion, speed = 0.5 * intensity**2 / spacing, drift(edges[1:-1])
    peclet = speed / diffusion
    onward = diffusion / np.where(np.abs(peclet) < 1e-8, 1.0, -np.expm1(-peclet) / np.where(peclet == 0.0, 1.0, peclet))
    back = onward - speed  # Scharfetter and Gummel
    bands = np.zeros((3, count))
    bands[1, :-1] -= onward / spacing
    bands[2, :-1] += onward / spacing
    bands[1, 1:] -= back / spacing
    bands[0, 1:] += back / spacing
    density = np.exp(-0.5 * (x / deviation) ** 2)
    density /= density.sum() * spacing

    def moved(parts):
        system = -length / parts * bands
        system[1] += 1.0
        found = density
        for _ in range(parts):
            found = solve_banded((1, 1), system, found)
        return found

    density = 2.0 * moved(2 * STEPS) - moved(STEPS)
    density *= np.exp(-0.5 * ((value - x) / noise) ** 2) / (noise * np.sqrt(2.0 * np.pi))
    mass = density.sum() * spacing
    mean = x @ density * spacing / mass
    return np.array([mean, np.sqrt((x - mean) ** 2 @ density * spacing / mass), np.log(mass)])


# The spacing of the prior's grid is a third of its deviation: the period in the first case, where f is zero at all points.
@pytest.mark.parametrize(
    ("formula", "drift", "intensity", "deviation", "length"),
    [
        ("sin(2*pi*x/10)", lambda x: np.sin(2 * np.pi * x / 10), 0.5, 30.0, 1.0),
        ("sin(2*pi*x/5)/2", lambda x: np.sin(2 * np.pi * x / 5) / 2, 0.5, 30.0, 4.0),
        ("3*sin(x)/10 - x/50", lambda x: 0.3 * np.sin(x) - x / 50, 0.5, 30.0, 50.0),
    ],
)
def test_a_wave_shorter_than_the_prior_moves_the_density(formula, drift, intensity, deviation, length):
    model = zakai.Model(
        state=["x"],
        drift=[formula],
        diffusion=[[intensity]],
        observation=["x"],
        observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[deviation**2]]},
    )
    result = zakai.filter(model, zakai.Record([length], [[2.5]], "samples"))
    found = result.mean[-1, 0], np.sqrt(result.cov[-1, 0, 0]), result.log_likelihood
    np.testing.assert_allclose(found, expected(drift, intensity, deviation, length, 2.5, 1.0), atol=1e-3)
