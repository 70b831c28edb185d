"""The output folder of experiments, with one result per complete cell.

cells/NAME.json   result: settings, metrics, minutes, command, hashes
work/NAME/        output of the command
logs/NAME.log     standard output and error of the command
"""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, Final

from egovcp.data.destination import writer_lock
from egovcp.decode import DecodeError, require_type
from egovcp.errors import DataError, EnvironmentFailure, UsageError
from egovcp.files import UnsafeFileError, read_json, write_json
from egovcp.values import differences
from egovcp_experiment.cell import (
    Cell,
    CellMetric,
    CellOutput,
    ExternalPath,
    Record,
    Reference,
    external_digest,
    resolve,
    to_argv,
)
from egovcp_experiment.local_runner import versions

_CELLS: Final = "cells"
_LIMIT_BYTES: Final = 1 << 28  # of a result, which may hold images and maps
#: Entries of a result that are read.
_ENTRIES: Final[Mapping[str, Any]] = {
    "settings": dict[str, Any],
    "sha256": str,
    "metrics": dict[str, Any],
    "minutes": float,
}


class CellStore:
    """Results of cells in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.records: dict[str, Record] = {}
        """The known results by name of the cell."""
        self._prepared: dict[str, dict[str, Any]] = {}
        """Settings at the start of a cell's command, by name of the cell."""

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Create the folder and lock it against other experiments.

        Raises:
            UsageError: the folder has other content.
            EnvironmentFailure: another process uses it, or it cannot be created.
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

    def log(self, cell: Cell) -> Path:
        """The log file of a cell."""
        return self.folder / "logs" / f"{cell.name}.log"

    def load(self, cell: Cell) -> bool:
        """Read the result of a cell into `records`, after those of the cells that it needs; returns
        whether it exists.

        Raises:
            UsageError: the stored result has other settings.
            DataError: it is damaged.
        """
        path = self._path(cell)
        if not path.exists():
            return False
        record = _read_record(path)
        settings = self.settings(cell)
        if record["settings"] != settings:
            name, (before, now) = next(differences(record["settings"], settings))
            raise UsageError(
                f"{path} was made with other settings: {name} was {json.dumps(before)}, is "
                f"{json.dumps(now)}; name another --output_dir, or remove that file to run the "
                "cell again"
            )
        self.records[cell.name] = record
        return True

    def settings(self, cell: Cell) -> dict[str, Any]:
        """All that the metrics of a cell depend on; folders are identified by their hashes."""

        def identity(reference: Reference) -> Any:
            match reference:
                case CellOutput(name, path):
                    return {"cell": name, "path": path, "sha256": self.records[name]["sha256"]}
                case ExternalPath(path):
                    return {"sha256": external_digest(path)}
                case CellMetric():
                    return self._metric(reference)

        settings = {
            "module": cell.command.module,
            "flags": resolve(cell.flags, identity),
            "extra": list(cell.extra),
            "versions": versions(),
        }
        through_json: dict[str, Any] = json.loads(json.dumps(settings))
        return through_json

    def prepare(self, cell: Cell) -> list[str]:
        """Arguments of a cell's command; an interrupted run is resumed, or else removed. Its result
        will have the settings of now."""

        def location(reference: Reference) -> Any:
            match reference:
                case CellOutput(name, path):
                    return str(self._work(name) / path)
                case ExternalPath(path):
                    return path
                case CellMetric():
                    return self._metric(reference)

        self._prepared[cell.name] = self.settings(cell)
        work = self._work(cell.name)
        resume_flags = cell.command.resume_flags(work)
        if resume_flags is None:
            shutil.rmtree(work, ignore_errors=True)
        for folder in (work.parent, self.log(cell).parent):
            folder.mkdir(parents=True, exist_ok=True)
        flags = {cell.command.output: str(work), **resolve(cell.flags, location)}
        return [*to_argv({**flags, **(resume_flags or {})}), *cell.extra]

    def save(self, cell: Cell, argv: Sequence[str], facts: Mapping[str, Any]) -> None:
        """Write the result of a cell whose command has succeeded, with ``facts`` of the run."""
        settings = self._prepared[cell.name]
        work = self._work(cell.name)
        text = json.dumps(settings, sort_keys=True)
        record = {
            "cell": cell.name,
            "settings": settings,
            "settings_sha256": hashlib.sha256(text.encode()).hexdigest(),
            "sha256": cell.command.digest(work),
            "command": f"{cell.command.prog} {shlex.join(argv)}",
            **facts,
            "metrics": cell.command.metrics(work),
        }
        write_json(self._path(cell), record)
        self.records[cell.name] = record

    def _path(self, cell: Cell) -> Path:
        return self.folder / _CELLS / f"{cell.name}.json"

    def _work(self, name: str) -> Path:
        return self.folder / "work" / name

    def _metric(self, reference: CellMetric) -> Any:
        return reduce(getitem, reference.keys, self.records[reference.cell]["metrics"])


def _read_record(path: Path) -> Record:
    try:
        require_type(record := read_json(path, _LIMIT_BYTES), dict[str, Any], "the result")
        for name, kind in _ENTRIES.items():
            require_type(record.get(name), kind, name)
    except (UnsafeFileError, DecodeError) as error:
        raise DataError(f"{path} is damaged: {error}; remove it to run its cell again") from error
    found: Record = record
    return found
