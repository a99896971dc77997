"""The folder of a study: what it is a study of, and every finished batch as a file of its own, whole or not there.

    manifest.json        the key of the study, the versions of the libraries, and the study itself for whoever looks
    batches/00000.nc     one finished batch
    .lock                held by the process that works in the folder, for as long as it lives
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import xarray

from zakai.engine.versions import versions
from zakai.errors import InputError
from zakai.records.writing import atomic_write, shown
from zakai.studies.specification import Study

FORMAT = "zakai study 1"


class Store:
    """The folder of one study; closing it lets another process in."""

    def __init__(self, folder: str | os.PathLike[str], study: Study):
        """Open the folder, and make it where it is not there.

        Raises InputError where it holds another study, or the same begun with other versions, or something else, or where
        another process is at work in it.
        """
        self.folder, self.study, self.count = Path(folder), study, len(study.batches)
        self.parts = self.folder / "batches"
        self._lock: int | None = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._refuse_others()
            self._lock = _locked(self.folder)
            self._claim()
            self.parts.mkdir(exist_ok=True)
            for left in (*self.parts.glob(".*.part*"), *self.folder.glob(".*.part*")):
                left.unlink(missing_ok=True)  # of a process that was killed as it wrote
        except BaseException as error:
            self.close()
            if not isinstance(error, OSError):
                raise
            raise InputError(f"{shown(folder)}: the folder cannot be used: {error.strerror}; choose another") from None

    def close(self) -> None:
        """Let go of the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _refuse_others(self) -> None:
        """Nothing is written into a folder of something else."""
        names = sorted(entry.name for entry in self.folder.iterdir() if not entry.name.startswith("."))
        if names and "manifest.json" not in names:
            raise InputError(f"{shown(self.folder)}: holds {names[0]!r} and no study; give a new or an empty folder")

    def _claim(self) -> None:
        path, own = self.folder / "manifest.json", versions()
        if not path.exists():
            study = asdict(self.study) | {"records": [one.label for one in self.study.records]}
            text = {"format": FORMAT, "key": self.study.key(), "versions": own, "study": study}
            with atomic_write(path) as temporary:
                temporary.write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")
            return
        try:
            manifest: Any = json.loads(path.read_text(encoding="utf-8"))
            form, key, begun = manifest["format"], manifest["key"], dict(manifest["versions"])
        except (ValueError, KeyError, TypeError):
            raise InputError(f"{shown(path)}: is damaged; give a new folder") from None
        if (form, key) != (FORMAT, self.study.key()):
            raise InputError(f"{shown(self.folder)}: holds another study (its manifest.json says which); give a new folder")
        for name, version in own.items():
            if begun.get(name) != version:
                library, old = name.removeprefix("version_"), begun.get(name)
                fault = f"the study was begun with {library} {old}, and here is {version}"
                raise InputError(f"{shown(self.folder)}: {fault}; install {library} {old}, or give a new folder")

    def path(self, index: int) -> Path:
        return self.parts / f"{index:05d}.nc"

    def missing(self) -> list[int]:
        """The batches that are still to be run, in order."""
        there = {entry.name for entry in self.parts.iterdir()}
        return [index for index in range(self.count) if self.path(index).name not in there]

    def write(self, index: int, batch: xarray.Dataset) -> None:
        """Keep a finished batch: on the disk before it has its name."""
        content = batch.to_netcdf(engine="h5netcdf")
        with atomic_write(self.path(index)) as temporary:
            temporary.write_bytes(content)

    def read(self) -> list[xarray.Dataset] | None:
        """All batches in order; None if one was damaged, which is then missing."""
        found = []
        for index in range(self.count):
            path = self.path(index)
            try:
                found.append(xarray.load_dataset(BytesIO(path.read_bytes()), engine="h5netcdf", decode_times=False))
            except (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError):
                path.unlink(missing_ok=True)
                return None
        return found


def _locked(folder: Path) -> int | None:
    """A lock that ends with this process, however it ends; None where the system has none."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    handle = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise InputError(f"{shown(folder)}: another zakai is at work in this folder; wait for it, or give another") from None
    return handle
