"""Where compiled kernels are kept."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import zakai

PRINTED = """
from zakai.numerics import kernel_cache
from zakai.numerics.line import loop
from zakai.numerics.trains import kernels
print(*(kernel_cache.folder_of(module.__name__) for module in (loop, kernels)))
"""


def test_kernels_are_compiled_again_where_a_module_that_they_import_has_changed(tmp_path):
    source = tmp_path / "zakai"
    shutil.copytree(Path(zakai.__file__).parent, source, ignore=shutil.ignore_patterns("__pycache__"))
    settings = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}

    def folders():
        command = [sys.executable, "-c", PRINTED]
        return subprocess.run(command, env=settings, capture_output=True, text=True, check=True).stdout.split()

    before = folders()
    assert before == folders() and len(set(before)) == 2 and all(Path(one).is_dir() for one in before)
    imported = source / "numerics" / "line" / "resolution.py"  # by modules that the loop imports
    imported.write_text(imported.read_text() + "\nANOTHER = 1.0\n")
    after = folders()
    assert after[0] != before[0] and after[1] == before[1]
