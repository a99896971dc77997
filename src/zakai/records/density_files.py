"""Files of densities: a mixture, or values on a grid or between two ends, in numbers that are equal to the last bit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from zakai.densities import (
    Density,
    GaussianMixture,
    GridDensity,
    IntervalDensity,
    LogarithmicDensity,
    MappedDensity,
    TensorTrainDensity,
)
from zakai.densities.as_prior import grid_of, mapped, plain
from zakai.errors import InputError
from zakai.numerics.trains.grid import Grid
from zakai.numerics.trains.train import Train
from zakai.records.checkpoint import read_checkpoint, write_checkpoint
from zakai.records.writing import shown

KIND = "density"
_FRAME = ("centre", "basis", "low", "step", "closed")  # of the grid of a tensor train
_PARTS = {
    "mixture": ("weights", "means", "covs"),
    "grid": ("log_values", "centre", "basis"),
    "interval": ("values", "nodes", "rule"),
}


def save_density(density: Density, path: str | os.PathLike[str]) -> None:
    """Write a density to a file, atomically; see `Density.save`."""
    if isinstance(density, TensorTrainDensity):
        grid = density.train.grid
        train = {"kind": "train", "names": list(density.names), "periodic": [bool(angle) for angle in density.periodic]}
        arrays = {name: np.asarray(getattr(grid, name), float) for name in _FRAME}
        arrays |= {f"core {k}": core for k, core in enumerate(density.train.cores)}
        write_checkpoint(path, train, arrays, KIND)
        return
    found = plain(density)
    extra: dict[str, Any] = {}
    if isinstance(found, MappedDensity | LogarithmicDensity):
        found, extra = grid_of(found)
    kind = "interval" if isinstance(found, IntervalDensity) else "grid" if isinstance(found, GridDensity) else "mixture"
    about = {"kind": kind, "names": list(found.names), "periodic": [bool(angle) for angle in found.periodic], **extra}
    write_checkpoint(path, about, {name: getattr(found, name) for name in _PARTS[kind]}, KIND)


def load_density(path: str | os.PathLike[str]) -> Density:
    """Read a density that `Density.save` wrote.

    Args:
        path: the file.

    Returns:
        The density: a Gaussian mixture, a tensor train, or one on a grid or between the ends of a domain.

    Raises:
        InputError: the file is damaged, or holds something else.

    Example:
        >>> import tempfile, pathlib, zakai
        >>> model = zakai.load_model("gallery:kalman-bucy-1d")
        >>> result = zakai.filter(model, zakai.Record([0.1, 0.2], [0.3, 0.1]))
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "end.density"
        >>> result.density(-1).save(path)
        >>> later = model.with_prior(zakai.load_density(path), start=0.2)
        >>> bool(later.prior.mean == result.mean[-1])
        True
    """
    about, arrays = read_checkpoint(path, KIND)
    damaged = InputError(f"{shown(path)}: does not hold a density; give a file that density.save wrote")
    try:
        names, periodic = tuple(about["names"]), tuple(about["periodic"])
        if about["kind"] == "train":
            found = _train(names, periodic, arrays)
            if found is None:
                raise damaged
            return found
        parts = {name: arrays[name] for name in _PARTS[about["kind"]]}
        n, kind = len(names), about["kind"]
        ends = {name: about[name] for name in ("lower", "upper") if name in about}
        fits = all(array.dtype == float for array in parts.values())
        fits &= all(isinstance(name, str) and name.isidentifier() for name in names)
        fits &= len(periodic) == n > 0 and all(isinstance(angle, bool) for angle in periodic)
        fits &= all(isinstance(end, float) and np.isfinite(end) for end in ends.values())
        more: dict[str, Any] = {name: about[name] for name in ("logarithms", *ends) if name in about}
        if not fits:
            raise damaged
        if kind == "grid":
            fits = parts["log_values"].ndim == n and parts["centre"].shape == (n,) and parts["basis"].shape == (n, n)
            fits &= bool(np.isfinite(parts["centre"]).all() and np.linalg.matrix_rank(parts["basis"]) == n)
            fits &= not np.isnan(parts["log_values"]).any() and bool(np.isfinite(parts["log_values"].max()))
            if "logarithms" in more:
                chosen = more["logarithms"]
                fits &= isinstance(chosen, list) and len(chosen) == n and all(isinstance(one, bool) for one in chosen)
                fits &= not ends and not any(one and angle for one, angle in zip(chosen, periodic, strict=True))
            fits &= not ends or (n == 1 and ends.get("lower", -np.inf) < ends.get("upper", np.inf))
        elif kind == "interval":
            count = len(parts["nodes"])
            fits = n == 1 and count > 1 and not periodic[0] and all(array.shape == (count,) for array in parts.values())
            fits &= all(np.isfinite(array).all() for array in parts.values())
            fits &= bool((np.diff(parts["nodes"]) > 0).all() and (parts["rule"] > 0).all())
            fits &= bool(np.sum(parts["values"] * parts["rule"]) > 0)
        else:
            k = len(parts["weights"])
            fits = k > 0 and parts["weights"].shape == (k,)
            fits &= parts["means"].shape == (k, n) and parts["covs"].shape == (k, n, n)
            fits &= bool((parts["weights"] > 0).all()) and all(np.isfinite(array).all() for array in parts.values())
            fits &= bool((np.linalg.eigvalsh(parts["covs"]) >= 0).all())
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError):
        raise damaged from None
    if not fits:
        raise damaged
    if kind == "interval":
        return IntervalDensity(**parts, names=names)
    if kind == "mixture":
        return GaussianMixture(**parts, names=names, periodic=periodic)
    return mapped(GridDensity(**parts, names=names, periodic=periodic), more)


def _train(names: tuple[str, ...], periodic: tuple[bool, ...], arrays: Mapping[str, np.ndarray]) -> TensorTrainDensity | None:
    """Return a tensor train of its arrays, None where they do not fit together."""
    n = len(names)
    cores = tuple(arrays[f"core {k}"] for k in range(n))
    frame = {name: arrays[name] for name in _FRAME}
    fits = n > 1 and len(periodic) == n and all(isinstance(angle, bool) for angle in periodic)
    fits &= all(isinstance(name, str) and name.isidentifier() for name in names)
    fits &= all(array.dtype == float and np.isfinite(array).all() for array in (*cores, *frame.values()))
    fits &= all(core.ndim == 3 and core.size > 0 for core in cores)
    fits &= all(frame[name].shape == (n,) for name in _FRAME if name != "basis") and frame["basis"].shape == (n, n)
    if not fits:
        return None
    ranks = [1, *(core.shape[2] for core in cores)]
    if ranks[-1] != 1 or any(core.shape[0] != rank for core, rank in zip(cores, ranks[:-1], strict=True)):
        return None
    closed = frame["closed"] > 0
    if (closed & ~np.array(periodic)).any() or not (frame["step"] > 0).all() or np.linalg.matrix_rank(frame["basis"]) < n:
        return None
    sizes = np.array([core.shape[1] for core in cores])
    grid = Grid(frame["centre"], frame["basis"], frame["low"], frame["step"], sizes, closed)
    train = Train(grid, cores, np.where(periodic, 2 * np.pi, 0.0))
    return TensorTrainDensity(train, names, periodic) if train.mass > 0 else None
