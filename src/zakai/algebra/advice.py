"""What to do where no method holds: the nearest one, and a change of the model for which a method holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import sympy as sp

from zakai import _display
from zakai.algebra._readable import readable
from zakai.algebra.conditions import Condition, all_hold
from zakai.algebra.order import in_order
from zakai.algebra.theorems import NOT_HANDLED, conditions_of
from zakai.errors import ZakaiError
from zakai.models.features import DOMAIN, STATE_DEPENDENT_DIFFUSION
from zakai.models.model import Model

Conditions = tuple[Condition, ...]
_PARTICLES = "guided-particles"
_MOST_STATES = 8  # of a model that is rewritten
_WIDTH = sp.Rational(1, 10)
_MOST_CHARACTERS = 90  # of a formula in a sentence


def nearest(considered: Mapping[str, Conditions]) -> str:
    """Return the method with the fewest assumptions that fail, of equals the most general.

    Of a method that does not handle a feature of the model no other assumption was checked: it comes last.
    """

    def distance(name: str) -> tuple[bool, int, int]:
        failing = [condition for condition in considered[name] if condition.holds is False]
        return any(one.source == NOT_HANDLED for one in failing), len(failing), -list(considered).index(name)

    return min(considered, key=distance)


def what_to_do(model: Model, method: str) -> str:
    """Return a sentence: a method that holds, or a rewriting of the model for which one does, or where to read on."""
    parts = []
    other = _first(model)
    if method != "auto" and other:
        parts.append(f'{other} holds: method="auto" takes it')
    # Particles hold for any model: a rewriting for which another method holds is worth a sentence beside them.
    searched = other in (None, _PARTICLES)
    for words, rewritten in _rewritings(model):
        named = method != "auto" and _holds(rewritten, method)
        if found := method if named else _first(rewritten, without=_PARTICLES) if searched else None:
            parts.append(f"{words}, for which {found} holds")
            break
    if not parts and all_hold(conditions_of("extended-kalman-bucy", model)) is True:
        parts.append('method="extended-kalman-bucy" approximates any smooth system')
    return "; ".join([*parts, "`zakai methods MODEL` lists every assumption"])


def _holds(model: Model, method: str) -> bool:
    return all_hold(conditions_of(method, model)) is True


def _first(model: Model, without: str = "") -> str | None:
    """Return the first method of "auto" that holds, apart from one."""
    return next((name for name in in_order(model) if name != without and _holds(model, name)), None)


def _rewritings(model: Model) -> Iterator[tuple[str, Model]]:
    """Yield changed models, with the words that describe the change."""
    if model.n > _MOST_STATES or model.functions:
        return
    for change in (_logarithms, _without_periodic, _without_jumps):
        try:
            found = change(model)
        except (ZakaiError, ArithmeticError, ValueError):
            continue
        if found is not None:
            yield found


def _without_periodic(model: Model) -> tuple[str, Model] | None:
    """Return the model with angles that are not wrapped."""
    if not model.periodic:
        return None
    return f"leave out periodic = {list(model.periodic)}", Model(**{**_keys(model), "periodic": None})


def _without_jumps(model: Model) -> tuple[str, Model] | None:
    """Return the model with tanh(a / w) for sign(a), of which heaviside is made, in f and g; w is for the user to choose."""
    keys, found = _keys(model), set[sp.Expr]()

    def smooth(formula: Any) -> sp.Expr:
        calls = [call for call in formula.atoms(sp.sign) if call.has(*model.x)]
        found.update(call.args[0] for call in calls)
        return formula.subs({call: sp.tanh(call.args[0] / _WIDTH) for call in calls})

    keys["drift"] = [smooth(formula) for formula in keys["drift"]]
    keys["diffusion"] = [[smooth(entry) for entry in row] for row in keys["diffusion"]]
    if not found:
        return None
    a = min(map(str, map(readable, found)), key=len)
    ratio = f"{a}/w" if a.isidentifier() else f"({a})/w"
    calls = f"tanh({ratio}) for sign({a}), (1 + tanh({ratio}))/2 for heaviside({a})"
    words = f"write {calls} with a small w (the error is of order w**2; halve w until the answer stays)"
    return words, Model(**keys)


def _logarithms(model: Model) -> tuple[str, Model] | None:
    """Return the model in z = log x for each state whose noise is proportional to it, by Ito's formula.

    dx = f dt + x s dv  gives  dz = (f / x - G / (2 x^2)) dt + s dv,  G = g Q g'.
    """
    if STATE_DEPENDENT_DIFFUSION not in model.features:
        return None
    covariance, states = model.covariance, set(model.x)
    names, values = list(model.state), dict(zip(model.x, model.x, strict=True))
    drift, diffusion, changed = list(model.drift), model.diffusion.as_mutable(), []
    for i, x in enumerate(model.x):
        row = [sp.cancel(entry / x) for entry in model.diffusion.row(i)]
        if not model.diffusion.row(i).free_symbols & states or any(entry.free_symbols & states for entry in row):
            continue
        names[i] = f"log_{model.state[i]}"
        values[x] = sp.exp(sp.Symbol(names[i], real=True))
        drift[i] = drift[i] / x - covariance[i, i] / (2 * x**2)
        diffusion[i, :] = sp.Matrix([row])
        changed.append(i)
    if not changed or len({*names, *model.parameters, *model.inputs}) < len(names) + len(model.parameters) + len(model.inputs):
        return None

    def substituted(formula: Any) -> sp.Expr:
        return sp.expand(sp.simplify(formula.subs(values, simultaneous=True)))

    keys = {
        **_keys(model),
        "state": names,
        "drift": [substituted(formula) for formula in drift],
        "observation": [substituted(formula) for formula in model.observation],
        "diffusion": [[substituted(entry) for entry in row] for row in diffusion.tolist()],
        "domain": {name: interval.keys() for name, interval in model.domain.items() if model.state.index(name) not in changed},
    }
    if DOMAIN in model.features and not keys["domain"]:
        keys.pop("domain")
    rewritten = Model(**keys)
    first = changed[0]
    formula = str(readable(rewritten.drift[first]))
    shown = formula if len(formula) <= _MOST_CHARACTERS else formula[: _MOST_CHARACTERS - 3] + "..."
    if len(changed) == 1:
        what = f"{names[first]} = log({model.state[first]})"
    else:
        what = f"the logarithms of {_display.short_names([model.state[i] for i in changed])}"
    words = f"write the model in {what}: d{names[first]} = ({shown}) dt + ..."
    return words, rewritten


def _keys(model: Model) -> dict[str, Any]:
    """Return the keywords of the same model, without its prior and name."""
    matrices = ("diffusion", "process_noise", "observation_noise")
    keys: dict[str, Any] = {
        "state": list(model.state),
        "drift": list(model.drift),
        "observation_kind": model.observation_kind,
        "parameters": dict(model.parameters),
        "periodic": list(model.periodic) or None,
        **{name: getattr(model, name).tolist() for name in matrices},
        **model.keys_of_features,
    }
    if model.log_density is None:
        keys["observation"] = list(model.observation)
    return keys
