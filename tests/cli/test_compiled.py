"""Where the command keeps what it compiled."""

from __future__ import annotations

import os

import pytest

from zakai import _compiled

NAMES = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES")


@pytest.fixture
def kept(monkeypatch, tmp_path):
    """The folder that is named to JAX, in an environment of its own."""
    monkeypatch.setattr(os, "environ", {"XDG_CACHE_HOME": str(tmp_path)})

    def keep(**more):
        os.environ.update(more)
        _compiled.keep()
        return os.environ.get("JAX_COMPILATION_CACHE_DIR")

    return keep


def test_the_users_cache_folder_is_made_and_named(kept, tmp_path):
    assert kept() == str(tmp_path / "zakai" / "compiled") and (tmp_path / "zakai" / "compiled").is_dir()
    assert all(name in os.environ for name in NAMES)


def test_a_folder_that_somebody_named_is_left_alone(kept, tmp_path):
    assert kept(JAX_COMPILATION_CACHE_DIR="elsewhere") == "elsewhere"
    assert not list(tmp_path.iterdir())


def test_an_empty_name_keeps_nothing(kept, tmp_path):
    assert kept(ZAKAI_CACHE="") is None and not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_stops_nothing(kept, tmp_path):
    (tmp_path / "zakai").write_text("a file in the way")
    assert kept() is None


def test_the_oldest_goes_when_there_is_too_much(kept, tmp_path, monkeypatch):
    monkeypatch.setattr(_compiled, "MOST_BYTES", 100)
    folder = tmp_path / "own"
    folder.mkdir()
    for age, name in enumerate(("new", "middle", "old")):
        (folder / name).write_bytes(b"x" * 40)
        os.utime(folder / name, (1e9 - age, 1e9 - age))
    assert kept(ZAKAI_CACHE=str(folder)) == str(folder)
    assert [path.name for path in folder.iterdir()] == ["new"]
