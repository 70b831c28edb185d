"""The output folder: a result for every finished cell, which is never made twice.

cells/NAME.json   the result: settings, figures, minutes, command, hashes
work/NAME/        what the command wrote
logs/NAME.log     what it printed
"""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from egovcp.data.destination import writer_lock
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.files import write_json
from egovcp_experiment.cell import Cell, Found, Given, Output, Reference, filled, written
from egovcp_experiment.tools import given_digest, read_json

type Record = Mapping[str, Any]
"""The result of a cell."""

_CELLS: Final = "cells"
_PACKAGES: Final = ("egovcp", "torch", "numpy", "mujoco")


def versions() -> dict[str, str]:
    """What decides about figures beside the flags: package -> version."""
    return {name: version(name) for name in _PACKAGES}


class Store:
    """The results of cells in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Create the folder, and keep others from working in it.

        Raises:
            UsageError: it holds something else.
            EnvironmentFailure: another process works in it, or it cannot be made.
        """
        folder = self.folder
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"--output_dir={folder} is a file; name a folder")
        if folder.exists() and any(folder.iterdir()) and not (folder / _CELLS).is_dir():
            raise UsageError(
                f"--output_dir={folder} holds something other than experiments; name a new folder"
            )
        try:
            (folder / _CELLS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EnvironmentFailure(f"cannot create {folder}: {error.strerror}") from error
        with writer_lock(folder, folder / _CELLS):
            yield

    def work(self, cell: Cell) -> Path:
        """The folder of a cell's command."""
        return self.folder / "work" / cell.name

    def log(self, cell: Cell) -> Path:
        """What the command of a cell printed."""
        return self.folder / "logs" / f"{cell.name}.log"

    def kept(self, cell: Cell, known: Mapping[str, Record]) -> Record | None:
        """The result of a cell, if it is there.

        Args:
            known: results of the cells that it needs.

        Raises:
            UsageError: it was made with other settings.
        """
        path = self._path(cell)
        if not path.exists():
            return None
        record: Record = read_json(path)
        settings = self.settings(cell, known)
        if record["settings"] != settings:
            raise UsageError(
                f"{path} was made with other settings: {_difference(record['settings'], settings)}"
                "; name another --output_dir, or remove that file to run the cell again"
            )
        return record

    def settings(self, cell: Cell, known: Mapping[str, Record]) -> dict[str, Any]:
        """All that the figures of a cell depend on; folders count by what is in them."""

        def identity(reference: Reference) -> Any:
            if isinstance(reference, Output):
                made = known[reference.cell]["sha256"]
                return {"cell": reference.cell, "path": reference.path, "sha256": made}
            if isinstance(reference, Given):
                return {"sha256": given_digest(reference.path)}
            return _figure(known, reference)

        settings = {
            "module": cell.tool.module,
            "flags": filled(cell.flags, identity),
            "extra": list(cell.extra),
            "versions": versions(),
        }
        through_json: dict[str, Any] = json.loads(json.dumps(settings))
        return through_json

    def prepare(self, cell: Cell, known: Mapping[str, Record]) -> list[str]:
        """The arguments of a cell's command; what an attempt left is continued or removed."""

        def place(reference: Reference) -> Any:
            if isinstance(reference, Output):
                return str(self.folder / "work" / reference.cell / reference.path)
            if isinstance(reference, Given):
                return reference.path
            return _figure(known, reference)

        work = self.work(cell)
        more = cell.tool.continued(work)
        if more is None:
            shutil.rmtree(work, ignore_errors=True)
        work.parent.mkdir(parents=True, exist_ok=True)
        self.log(cell).parent.mkdir(parents=True, exist_ok=True)
        flags = {cell.tool.output: str(work)} | dict(filled(cell.flags, place)) | dict(more or {})
        return [*written(flags), *cell.extra]

    def keep(
        self,
        cell: Cell,
        known: Mapping[str, Record],
        argv: list[str],
        minutes: float,
        surroundings: Mapping[str, Any],
    ) -> Record:
        """Write the result of a cell whose command has ended well."""
        settings = self.settings(cell, known)
        work = self.work(cell)
        prog = [cell.tool.prog] if cell.tool.prog else ["python", "-m", cell.tool.module]
        record = {
            "cell": cell.name,
            "settings": settings,
            "settings_sha256": _hash(settings),
            "sha256": cell.tool.digest(work),
            "command": shlex.join([*prog, *argv]),
            "minutes": minutes,
            **surroundings,
            "figures": cell.tool.figures(work),
        }
        write_json(self._path(cell), record)
        return record

    def _path(self, cell: Cell) -> Path:
        return self.folder / _CELLS / f"{cell.name}.json"


def _figure(known: Mapping[str, Record], wanted: Found) -> Any:
    value: Any = known[wanted.cell]["figures"]
    for key in wanted.keys:
        value = value[key]
    return value


def _hash(settings: Any) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def _difference(before: Any, now: Any, place: str = "") -> str:
    """The first value that differs, ``flags.steps was 600, is 800``."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in dict.fromkeys([*before, *now]):
            if before.get(name) != now.get(name):
                inner = f"{place}.{name}" if place else name
                return _difference(before.get(name), now.get(name), inner)
    return f"{place} was {json.dumps(before)}, is {json.dumps(now)}"
