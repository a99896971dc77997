"""What a belief is: Gaussian mixtures, densities on a lattice, points, products of independent blocks, behind one protocol."""

from zakai.densities._density import Density
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity
from zakai.densities.points import PointMasses
from zakai.densities.product import ProductDensity

__all__ = ["Density", "GaussianMixture", "GridDensity", "PointMasses", "ProductDensity"]
