"""What the system is: formulas, models, model files, the gallery, simulation, and compilation to NumPy and JAX."""

from zakai.models.files import load_model
from zakai.models.model import Model

__all__ = ["Model", "load_model"]
