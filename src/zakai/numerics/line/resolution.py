"""What one state asks of a grid and of a step: the bounds of all of its filters, and the error that a step makes.

A spectrum is resolved where its modulus at the highest frequencies, relative to the mass, is at most `spectrum_bound`; a grid
holds a density that is at most `edge_bound` at its ends, relative to the maximum.  Kernels use the same constants.
"""

from __future__ import annotations

from zakai.numerics.compiled import helper

NOISE = 3e-15  # error of a density relative to its maximum, which matters in its tails
SPECTRUM_FACTOR = 30.0  # times the spectrum that need not be resolved: more needs another grid
SPECTRUM_SHARE = 1e-5  # of the tolerance that a transition may leave at the highest frequencies
GROSS = 1e-4  # spectrum at the highest frequencies from which it is that of what a grid does not resolve, not of noise
LOST_ALIASING = 0.1  # from which the density is lost
RESOLVED = 1e-11  # spectrum or Legendre coefficient at the highest frequencies, end of a grid, and rounding that do not count
EDGE_OF_ALIASING = 4.0  # spectra at the highest frequencies, whose waves reach the ends as well
ROUNDING = 4e-16  # rounding error of a decomposition or an exponential, relative to the norm
RELIABLE = 1e-3  # of the promised error: smaller estimates are not reported
MAGNUS = 0.02  # of the tolerance that one substep of Magnus' series, or of a splitting beside a Gaussian kernel, may leave
TRANSITION_SHARE = 0.1  # of the tolerance that a transition of its own kind may leave, or lose of the mass
SMOOTHER_SHARE = 0.01  # of the error that an interval of a smoother may make: what modes and rounding may leave
SUPPORT = 8.0  # standard deviations to the end of a density
LOST_MASS = 1e-3  # of a transition, beyond which it fails
TRIALS = 8  # grids that are tried for one step or one message


def spectrum_bound(negligible: float, tolerance: float) -> float:
    """Return the largest spectrum at the highest frequencies of a transition that is resolved."""
    return max(SPECTRUM_FACTOR * negligible, SPECTRUM_SHARE * tolerance)


def noise_bound(tolerance: float) -> float:
    """Return the largest spectrum of kinks or noise, which a finer grid does not lower."""
    return max(1e-10, 1e-3 * tolerance)


def edge_bound(aliasing: float) -> float:
    """Return the largest density at the ends of a grid, relative to the maximum, with a spectrum at the highest frequencies."""
    return max(RESOLVED, EDGE_OF_ALIASING * aliasing)


def rounding_bound(tolerance: float) -> float:
    """Return the largest rounding error of a transition."""
    return max(RESOLVED, SPECTRUM_SHARE * tolerance)


def error_made(aliasing: float, edge: float, negative: float, time: float, amplified: float) -> float:
    """Return the error of a step, of the mean in standard deviations and of the log-likelihood.

        2 aliasing + 10 (edge + negative) + time + min(amplified, 1)

    Args:
        aliasing: the spectrum that the grid does not resolve, relative to the mass: both its sides count.
        edge: the density at the ends of the grid, relative to the maximum: what lies beyond counts with its squared distance.
        negative: the negative share of the mass, which counts in the same way.
        time: the errors of the transition in time and of rounding.
        amplified: the error of small values of the density, times its growth by a sample.
    """
    return 2.0 * aliasing + 10.0 * (edge + negative) + time + min(amplified, 1.0)


step_error = helper(error_made)
