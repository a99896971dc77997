"""What the system is: formulas, models, model files, the gallery, compilation."""

from zakai.models.files import load_model
from zakai.models.model import Model

__all__ = ["Model", "load_model"]
