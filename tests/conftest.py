"""What is compiled is kept on disk, for the commands that tests start and for the workers that share a run, and not in memory."""

from __future__ import annotations

import gc
import os
import shutil
import sys
from pathlib import Path

import pytest

# Before JAX is imported, here or in a process that a test starts.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

MOST_MAPS = 20_000  # Linux gives a process 65,530 of them, and a compiler that finds none crashes
MOST_BYTES = 5 * 2**30


@pytest.fixture(autouse=True, scope="module")
def _forget_what_is_compiled():
    """A worker compiles thousands of functions in its life; to count the maps takes milliseconds."""
    yield
    if "jax" in sys.modules and _crowded():
        sys.modules["jax"].clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def browser():
    """Chromium; it is in Debian's package `chromium`."""
    from playwright.sync_api import sync_playwright

    found = shutil.which("chromium")
    assert found, "chromium is not installed: apt-get install chromium"
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()


def _crowded() -> bool:
    try:
        with open("/proc/self/maps", "rb") as maps, open("/proc/self/statm", "rb") as pages:
            return sum(1 for _ in maps) > MOST_MAPS or int(pages.read().split()[1]) * os.sysconf("SC_PAGESIZE") > MOST_BYTES
    except OSError:
        return False
