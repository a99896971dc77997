"""How long a user waits: the first answer of a fresh process, for every model of the gallery with a prior and fifteen others.

    python benchmarks/first_answer.py [--only WORD ...] [--timeout 60] [--json FILE] [--write]

For each system a new process imports zakai, reads a model file and a record, and filters it with the default settings; the time
runs from the start of the process to the last mean.  Then it filters a second record of the same times.  The same is done with a
bootstrap particle filter of 10,000 particles in plain NumPy (Euler substeps, systematic resampling below half), which shares no
code with zakai.  `apart` is the largest distance of the last means of the two filters, in posterior standard deviations; by
chance it is some hundredths.  Kernels that zakai compiles once per machine are compiled before.  The table is Markdown; with
`--write` it replaces that of docs/reference/figures.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from first_answer_systems import SYSTEMS, System  # noqa: E402

import zakai  # noqa: E402

PAGE = Path(__file__).parents[1] / "docs/reference/figures.md"
PARTICLES = 10_000
COLUMNS = (
    ("system", "system"), ("method", "method"), ("states", "states"), ("observations", "observations"),
    ("first answer, s", "first_s"), ("second call, µs an observation", "second_us"),
    ("particles: first answer, s", "particles_first_s"), ("second call, µs an observation", "particles_second_us"),
    ("apart", "apart"), ("warnings", "warnings"),
)  # fmt: skip


def make_records(system: System, folder: Path) -> dict[str, Any]:
    """Write the model, two records, and the arrays that the particle filter reads."""
    from zakai.records import write_record

    model, times, arrays = system.loaded(), system.times(), {}
    (folder / "model.toml").write_text(model.to_toml())
    for number in (1, 2):
        record = system.record(model, times, number)
        write_record(folder / f"record-{number}.csv", record)
        arrays[f"values_{number}"] = record.values
        if record.inputs is not None:
            table = np.column_stack([record.inputs.times, record.inputs.values])
            np.savetxt(folder / "inputs.csv", table, delimiter=",", header=",".join(["time", *model.inputs]), comments="")
    np.savez(folder / "arrays.npz", times=times, kind=model.observation_kind, **arrays)
    return {"states": model.n, "observations": len(times), "kind": model.observation_kind}


def record_of(model: zakai.Model, folder: Path, number: int) -> zakai.Record:
    """Return a record of those that `make_records` wrote."""
    from zakai.records import read_inputs, read_record

    record = read_record(folder / f"record-{number}.csv", model)
    if not model.inputs:
        return record
    return zakai.Record(record.times, record.values, record.kind, inputs=read_inputs(folder / "inputs.csv", model))


def answer_of_zakai(folder: Path, started: float) -> None:
    """Print a line of JSON for the first call and one for the second."""
    model = zakai.load_model(folder / "model.toml")
    result = zakai.filter(model, record_of(model, folder, 1))
    said = {"first_s": time.time() - started, "method": result.method, "warnings": len(result.warnings)}
    print(json.dumps(said | {"mean": result.mean[-1].tolist(), "std": np.sqrt(result.variance[-1]).tolist()}), flush=True)
    record = record_of(model, folder, 2)
    begin = time.perf_counter()
    zakai.filter(model, record)
    print(json.dumps({"second_us": 1e6 * (time.perf_counter() - begin) / len(record)}), flush=True)


def answer_of_particles(system: System, folder: Path, started: float) -> None:
    """Print the same for the particle filter."""
    arrays = np.load(folder / "arrays.npz")
    times, kind = arrays["times"], str(arrays["kind"])
    mean = particle_filter(system, times, arrays["values_1"], kind)
    print(json.dumps({"particles_first_s": time.time() - started, "particles_mean": mean.tolist()}), flush=True)
    begin = time.perf_counter()
    particle_filter(system, times, arrays["values_2"], kind)
    print(json.dumps({"particles_second_us": 1e6 * (time.perf_counter() - begin) / len(times)}), flush=True)


def particle_filter(system: System, times: np.ndarray, values: np.ndarray, kind: str, seed: int = 0) -> np.ndarray:
    """Return the last mean (n,) of a bootstrap particle filter.

    Samples weight by N(z; h, R), increments of a path by N(dy; int h dt, int S dt) along each particle, since the last
    observation of the coordinate.
    """
    rng = np.random.default_rng(seed)
    x = np.ascontiguousarray(system.prior(rng, PARTICLES).T, float)
    m, logs = values.shape[1], np.zeros(PARTICLES)
    gathered, noise, before = np.zeros((m, PARTICLES)), np.zeros((m, m)), np.zeros(m)
    t = 0.0
    for stop, value in zip(times, values, strict=True):
        count = max(1, int(np.ceil((stop - t) / system.substep - 1e-9)))
        step = (stop - t) / count
        for _ in range(count):
            if kind != "samples":
                gathered += step * np.array(system.observation(x, t))
                noise = noise + step * np.asarray(system.noise(t + step / 2))
            x = x + step * np.array(system.drift(x, t)) + np.sqrt(step) * noise_of(system, x, t, rng)
            t += step
        t, seen = stop, ~np.isnan(value)
        if seen.any() and system.law is not None:
            logs += system.law(value, x)
        elif seen.any():
            if kind == "samples":
                expected, spread, target = np.array(system.observation(x, t)), np.asarray(system.noise(t)), value
            else:
                expected, spread, target = gathered, noise, value - before if kind == "path" else value
            residual = target[seen, None] - expected[seen]
            logs -= 0.5 * np.sum(residual * np.linalg.solve(spread[np.ix_(seen, seen)], residual), axis=0)
        renewed = seen if kind == "path" else np.ones(m, bool)
        gathered[renewed], before = 0.0, np.where(seen, value, before)
        noise[renewed], noise[:, renewed] = 0.0, 0.0
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        if 1 / np.sum(weights**2) < PARTICLES / 2:
            chosen = np.searchsorted(np.cumsum(weights), (rng.random() + np.arange(PARTICLES)) / PARTICLES).clip(0, PARTICLES - 1)
            x, gathered, logs = x[:, chosen], gathered[:, chosen], np.zeros(PARTICLES)
            weights = np.full(PARTICLES, 1 / PARTICLES)
    mean = x @ weights
    for i in system.angles:
        mean[i] = np.arctan2(np.sin(x[i]) @ weights, np.cos(x[i]) @ weights)
    return mean


def noise_of(system: System, x: np.ndarray, t: float, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the noise of the state (n, N) in a unit of time."""
    root = np.asarray(system.root(x, t) if callable(system.root) else system.root, float)
    drawn = rng.standard_normal((root.shape[1], PARTICLES))
    return np.einsum("nrN,rN->nN", root, drawn) if root.ndim == 3 else root @ drawn


def in_a_fresh_process(what: str, name: str, folder: Path, timeout: float) -> dict[str, Any]:
    """Return what a child prints until it ends or its time is over."""
    command = [sys.executable, __file__, "--child", what, name, str(folder), repr(time.time())]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
        out, fault = done.stdout, done.stderr.strip().splitlines()[-1:] if done.returncode else []
    except subprocess.TimeoutExpired as error:
        out = error.stdout or b""
        out, fault = out.decode() if isinstance(out, bytes) else out, [f"more than {timeout:g} s"]
    found: dict[str, Any] = {}
    for line in out.splitlines():
        found |= json.loads(line)
    return found | ({f"{what}_fault": fault[0][:200]} if fault else {})


def distance(system: System, found: dict[str, Any]) -> float | None:
    """Return the largest distance of the last means in deviations."""
    if "mean" not in found or "particles_mean" not in found:
        return None
    apart = np.array(found["mean"]) - np.array(found["particles_mean"])
    for i in system.angles:
        apart[i] = np.angle(np.exp(1j * apart[i]))
    return float(np.abs(apart / np.array(found["std"])).max())


def shown(row: dict[str, Any], key: str) -> str:
    """Return an entry of the table."""
    value = row.get(key)
    if value is None:
        fault = row.get("particles_fault" if key.startswith("particles") else "zakai_fault", "")
        return fault.split(":")[0] if key in ("first_s", "particles_first_s") else "-"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def processor() -> str:
    """Return the name of the processor, or what Python knows of it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())


def write_table(lines: list[str], name: str) -> None:
    """Replace what stands between the marks of a table in the page of figures."""
    begin, end = f"% begin of the {name}", f"% end of the {name}"
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(f"{begin}\n")
    PAGE.write_text(f"{before}{begin}\n\n" + "\n".join(lines) + f"\n\n{end}{rest.partition(end)[2]}", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], help="systems whose name contains one of these words")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds for each process")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", action="store_true", help="write the table into the page")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        what, name, folder, started = given.child
        if what == "zakai":
            answer_of_zakai(Path(folder), float(started))
        else:
            answer_of_particles(SYSTEMS[name], Path(folder), float(started))
        return
    lines = ["| " + " | ".join(title for title, _ in COLUMNS) + " |", "|" + "---|" * 2 + "---:|" * (len(COLUMNS) - 2)]
    print("\n".join(lines))
    rows = []
    for name, system in SYSTEMS.items():
        if given.only and not any(word in name for word in given.only):
            continue
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            row = {"system": name} | make_records(system, folder)
            row |= in_a_fresh_process("zakai", name, folder, given.timeout)
            row |= in_a_fresh_process("particles", name, folder, given.timeout)
        row["apart"] = distance(system, row)
        rows.append(row)
        lines.append("| " + " | ".join(shown(row, key) for _, key in COLUMNS) + " |")
        print(lines[-1], flush=True)
        if given.json is not None:
            given.json.write_text(json.dumps(rows, indent=1))
    if given.write:
        write_table([*lines, "", f"{os.cpu_count()} cores of {processor()}."], "table of first answers")


if __name__ == "__main__":
    main()
