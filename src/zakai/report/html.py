"""One HTML file about a filtering run: no network, no other file, nothing that must be known beforehand."""

from __future__ import annotations

import platform
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from zakai.densities._values import wrap
from zakai.report import _style, calibration, observed, sections, words
from zakai.report.heatmap import is_periodic, state_names, true_states
from zakai.report.scripts import policy, script
from zakai.report.words import signed


def write_report(result: Any, path: str | Path, truth: Any = None) -> None:
    """Write the HTML report of a filtering run to one file that opens without a network.

    Arguments: `result`, a `FilterResult`; `path`, the file to write, replaced only when the whole report is
    ready; `truth`, the true states where they are known, (K+1, n) or an object with `times` and `values`.
    Raises `InputError` for a truth of the wrong shape.

    Example: `write_report(zakai.filter(model, record), "report.html")`.
    """
    from zakai.records.writing import atomic_write

    text = page(result, truth)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def page(result: Any, truth: Any = None) -> str:
    """The text of the report."""
    states = true_states(truth, result)
    parts = [
        ("posterior", "The posterior over time", sections.posterior(result, states)),
        *([("joint", "The joint density of two states", observed.joint(result, states))] if len(state_names(result)) > 1 else []),
        ("snapshots", "The density at moments of note", sections.snapshots(result, states)),
        *([("observations", "The observations", observed.observations(result))] if result.record is not None else []),
        ("log-likelihood", "Log-likelihood", sections.likelihood(result)),
        ("calibration", "Calibration", calibration.section(result)),
        ("health", "Health of the computation", sections.health(result)),
        ("method", "Which method, and why", sections.method(result)),
        ("model", "The model", sections.model(result)),
    ]
    links = " ".join(f'<a href="#{key}">{key.capitalize()}</a>' for key, _, _ in parts)
    body = "".join(f'<section id="{key}"><h2>{escape(title)}</h2>{text}</section>' for key, title, text in parts)
    name = escape(result.model.name if result.model is not None else "Filtering run")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"{policy()}"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: {words.title(result).lower()}</title><style>{_style.css()}</style></head>\n"
        f'<body><main><header><p class="eyebrow">{words.title(result)}</p><h1>{name}</h1>'
        f'<p class="verdict">{escape(words.verdict(result))}</p>{_warnings(result)}{_facts(result, states)}'
        "<noscript><p>The pictures on this page need JavaScript; the text and the tables do "
        "not.</p></noscript>"
        f"<nav>{links}</nav></header>{body}<footer>{_versions(result)}</footer></main>{script()}</body></html>\n"
    )


def _warnings(result: Any) -> str:
    if not result.warnings:
        return ""
    items = "".join(f"<li>{escape(str(warning))}</li>" for warning in result.warnings)
    return f'<div class="warnings" role="alert"><h2>Warnings</h2><ul>{items}</ul></div>'


def _facts(result: Any, truth: np.ndarray | None) -> str:
    model, times = result.model, result.times
    seen = []
    if model is not None:
        seen = [("observed as", f"{model.m} × {model.observation_kind}" if model.m > 1 else model.observation_kind)]
    facts = [
        ("observations", f"{len(times) - 1:,}"),
        ("time", " to ".join(words.moment(result, k).removeprefix("t = ") for k in (0, -1))),
        ("states", f"{len(state_names(result))}"),
        *seen,
        ("log-likelihood", signed(f"{result.log_likelihood:,.2f}")),
        *words.angles(result),
        *words.errors(result, _errors(result, truth)),
    ]
    return '<dl class="facts">' + "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in facts) + "</dl>"


def _errors(result: Any, truth: np.ndarray | None) -> np.ndarray | None:
    if truth is None:
        return None
    error = truth - np.asarray(result.mean)
    for i in range(error.shape[1]):
        if is_periodic(result, i):
            error[:, i] = wrap(error[:, i])
    return error


def _versions(result: Any) -> str:
    computed = {k.removeprefix("version_"): v for k, v in result.attributes.items() if k.startswith("version_")}
    versions = {**_installed(), **computed}
    return "Made with " + ", ".join(f"{escape(str(name))} {escape(str(value))}" for name, value in versions.items()) + "."


def _installed() -> dict[str, str]:
    found = {}
    for name in ("zakai", "numba", "numpy", "sympy"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {**found, "python": platform.python_version()}
