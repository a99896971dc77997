"""Conditional densities: Gaussian mixtures, densities on a grid, weighted points, products of blocks; one protocol."""

from zakai.densities._density import Density
from zakai.densities.conditional import ConditionalParticleDensity
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity
from zakai.densities.interval import IntervalDensity
from zakai.densities.logarithmic import LogarithmicDensity
from zakai.densities.mapped import MappedDensity
from zakai.densities.particles import ParticleDensity
from zakai.densities.points import PointMasses
from zakai.densities.product import ProductDensity
from zakai.densities.tensor_train import TensorTrainDensity

__all__ = [
    "ConditionalParticleDensity", "Density", "GaussianMixture", "GridDensity", "IntervalDensity", "LogarithmicDensity",
    "MappedDensity", "ParticleDensity", "PointMasses", "ProductDensity", "TensorTrainDensity",
]  # fmt: skip
