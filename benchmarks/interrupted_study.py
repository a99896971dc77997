"""A study that is killed ten times at random moments, against the same study left alone: the files must be the same bytes.

    python benchmarks/interrupted_study.py [--kills 10] [--runs 100] [--seconds 1] [--seed 0]

Each life ends, by SIGKILL, at a random moment of the `--seconds` after its first batch.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

STUDY = """
name = "killed again and again"
models = ["gallery:kalman-bucy-1d"]
reference = "kalman-bucy"
batch = 2
[seeds]
count = {runs}
[times]
until = 0.5
step = 0.05
[methods.kalman-bucy]
[methods.extended]
method = "extended-kalman-bucy"
[methods.extended-euler]
method = "extended-kalman-bucy"
options = {{ riccati = "euler" }}
"""
PROGRAM = "import sys; from zakai.cli import main; sys.exit(main(sys.argv[1:]))"
COMMAND = [sys.executable, "-c", PROGRAM, "study", "study.toml", "-o"]
FILES = ("study.nc", "summary.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("kills", 10), ("runs", 100), ("seconds", 1), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    chance = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        (folder / "study.toml").write_text(STUDY.format(runs=given.runs))
        subprocess.run([*COMMAND, "whole"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        there = []
        for _ in range(given.kills):
            process = subprocess.Popen([*COMMAND, "killed"], cwd=folder, stdout=subprocess.DEVNULL)
            before = finished(folder)
            while finished(folder) == before and process.poll() is None:
                time.sleep(0.01)
            time.sleep(chance.uniform(0.0, given.seconds))
            process.kill()
            process.wait()
            there.append(finished(folder))
        subprocess.run([*COMMAND, "killed"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        same = {name: digest(folder / "whole" / name) == digest(folder / "killed" / name) for name in FILES}
    print(json.dumps({"kills": given.kills, "batches after each": there, "same bytes": same}, indent=1))
    sys.exit(0 if all(same.values()) else 1)


def finished(folder: Path) -> int:
    return len(list((folder / "killed").glob("batches/[0-9]*.nc")))


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
