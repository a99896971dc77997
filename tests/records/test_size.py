import subprocess
import sys

# On Linux a child's ru_maxrss starts at what its parent held, here a whole pytest; VmHWM starts again with each program.
READ = """
import re, sys
from pathlib import Path
from types import SimpleNamespace
from zakai.records import read_record
law = SimpleNamespace(is_gaussian=True)
record = read_record(sys.argv[1], SimpleNamespace(m=2, observation_kind="samples", inputs=(), start=0.0, observation_law=law))
status = Path("/proc/self/status")
peak = re.search(r"VmHWM:\\s*(\\d+) kB", status.read_text()) if status.exists() else None
if peak:
    kilobytes = int(peak[1])
else:
    import resource
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // (1024 if sys.platform == "darwin" else 1)
print(len(record), kilobytes // 1024)
"""


def test_a_million_rows_are_read_in_seconds_and_little_memory(tmp_path):
    rows = (f"{k / 100},{k * 0.618 % 1 - 0.5},{'' if k % 7 == 0 else k * 0.414 % 1 - 0.5}\n" for k in range(1_000_000))
    (tmp_path / "record.csv").write_text("time,y1,y2\n" + "".join(rows))
    done = subprocess.run(
        [sys.executable, "-c", READ, tmp_path / "record.csv"], capture_output=True, text=True, check=True
    )
    rows, megabytes = map(int, done.stdout.split())
    assert rows == 1_000_000 and megabytes < 400
