"""Nonlinear filtering with the Duncan-Mortensen-Zakai equation: the conditional density itself, in real time.

    import zakai

    model = zakai.load_model("system.toml")
    record = zakai.read_record("observations.csv", model)
    result = zakai.filter(model, record)

Each public name is loaded when it is first used, so that `import zakai` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_PUBLIC = {
    "Model": "zakai.models.model",
    "load_model": "zakai.models.files",
    "gallery": "zakai.models.gallery",
    "simulate": "zakai.simulation.simulate",
    "Analysis": "zakai.algebra.analysis",
    "analyze": "zakai.algebra.analysis",
    "Truth": "zakai.records",
    "Record": "zakai.records",
    "Inputs": "zakai.records",
    "read_record": "zakai.records",
    "filter": "zakai.engine.driver",
    "FilterResult": "zakai.engine.results",
    "smooth": "zakai.engine.smoother",
    "SmoothingResult": "zakai.engine.smoother",
    "prepare": "zakai.engine.prepared",
    "Prepared": "zakai.engine.prepared",
    "online": "zakai.engine.online",
    "Estimate": "zakai.engine.estimate",
    "log_likelihood": "zakai.engine.likelihood",
    "fit": "zakai.inference.fit",
    "Fit": "zakai.inference.fit",
    "sample": "zakai.inference.bayes",
    "compare": "zakai.diagnostics.compare",
    "Comparison": "zakai.diagnostics.compare",
    "widget": "zakai.report.widget",
    "load_result": "zakai.engine.stored",
    "cite": "zakai.citations",
    "Density": "zakai.densities",
    "load_density": "zakai.records.density_files",
    "ZakaiError": "zakai.errors",
    "InputError": "zakai.errors",
    "ConditionError": "zakai.errors",
}

__version__ = "0.3.0"
__all__ = [*_PUBLIC, "__version__"]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'zakai' has no attribute '{name}'")
    if name == "gallery":
        return import_module(_PUBLIC[name])
    value = getattr(import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
