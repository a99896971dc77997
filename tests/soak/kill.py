"""`zakai stream` killed at random moments, again and again: what it prints is what it prints when nobody kills it.

    python tests/soak/kill.py [--kills 200] [--model gallery:cubic-sensor] [--method yau-yau] [--every 1]

The stream is fed to the command a line at a time, a random number of milliseconds apart.  After every SIGKILL the command is
started again with its checkpoint and a stream that begins some lines earlier than it need.  The lines that were printed, without
those that are printed twice, must be those of one uninterrupted run, to the byte; a line printed twice must be the same twice.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

COMMAND = [sys.executable, "-c", "import sys; from zakai.cli import main; sys.exit(main())", "stream"]


def lines(model_observations: int, count: int, chance: random.Random) -> list[str]:
    found, at = [], 0.0
    for _ in range(count):
        at += chance.choice([0.01, 0.01, 0.01, 0.05])
        values = [chance.gauss(0, 0.1) if chance.random() > 0.05 else None for _ in range(model_observations)]
        found.append(json.dumps({"time": round(at, 6), "y": values}))
    return found


def feed(process: subprocess.Popen, given: list[str], pause: float) -> None:
    try:
        for line in given:
            process.stdin.write(line.encode() + b"\n")
            process.stdin.flush()
            time.sleep(pause)
        process.stdin.close()
    except OSError:
        pass  # it was killed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--model", default="gallery:cubic-sensor")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--observations", type=int, default=1)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    given = lines(arguments.observations, 12 * arguments.kills + 100, chance)
    command = [*COMMAND, arguments.model, "--method", arguments.method]
    whole = subprocess.run(command, input="\n".join(given).encode(), capture_output=True, check=True).stdout.decode().splitlines()
    places = {json.loads(line)["time"]: k for k, line in enumerate(whole)}
    printed: dict[int, str] = {}
    killed = wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        saved = [*command, "--checkpoint", str(Path(folder) / "state"), "--checkpoint-every", str(arguments.every)]
        reached = 0  # the last line that is known to be in the checkpoint, or none
        while killed <= arguments.kills:
            last = killed == arguments.kills
            begin = 0 if last else max(0, reached - arguments.every - chance.randrange(20))
            process = subprocess.Popen(saved, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
            pause = 0.0 if last else chance.choice([0.0, 0.001, 0.005])
            feeder = threading.Thread(target=feed, args=(process, given[begin:], pause))
            feeder.start()
            if not last:
                for _ in range(chance.randrange(1, 20)):
                    line = process.stdout.readline().decode()
                    if line.endswith("\n"):
                        wrong += check(line.rstrip("\n"), whole, places, printed)
                time.sleep(chance.random() * 0.02)
                process.kill()
                killed += 1
            for line in process.stdout.read().decode().splitlines(keepends=True):
                if line.endswith("\n"):
                    wrong += check(line.rstrip("\n"), whole, places, printed)
            feeder.join()
            said = process.stderr.read().decode()
            process.wait()
            if "error" in said or "Traceback" in said:
                print(said, file=sys.stderr)
                wrong += 1
            reached = max(printed, default=0)
            if last:
                break
            if reached >= len(given) - 60:
                (Path(folder) / "state").unlink()
                reached, printed = 0, {}
    complete = sorted(printed) == list(range(len(whole)))
    print(json.dumps({"kills": killed, "wrong": wrong, "complete": complete, "lines": len(whole)}))
    return 0 if not wrong and complete else 1


def check(line: str, whole: list[str], places: dict[float, int], printed: dict[int, str]) -> int:
    """One if the line is none of the uninterrupted run."""
    place = places.get(json.loads(line)["time"])
    if place is None or line != whole[place]:
        print(f"wrong: {line}\nnot:   {whole[place] if place is not None else None}", file=sys.stderr)
        return 1
    printed[place] = line
    return 0


if __name__ == "__main__":
    sys.exit(main())
