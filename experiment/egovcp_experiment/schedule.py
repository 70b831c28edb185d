"""Runs the cells that are missing, some side by side, wherever a `Runner` puts them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.workers import stop_on_signal
from egovcp_experiment.cell import Cell, in_order
from egovcp_experiment.local import LocalRunner
from egovcp_experiment.runner import INTERRUPTED, Run, Runner
from egovcp_experiment.store import Record, Store

_POLL_S: Final = 0.05
_MINUTE: Final = 60.0


@dataclass
class _Running:
    """A cell whose command runs."""

    cell: Cell
    argv: list[str]
    run: Run
    start: float


class Schedule:
    """The cells of an experiment on their way from missing to kept.

    Args:
        cells: every one after those it needs.
        store: where results are kept.
        jobs: cells that run side by side.
        say: takes the lines of progress.
        runner: runs them; None: processes of this machine.

    Raises:
        UsageError: a result is there that was made with other settings.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        store: Store,
        jobs: int = 1,
        say: Callable[[str], None] = print,
        runner: Runner | None = None,
    ) -> None:
        if jobs < 1:
            raise UsageError(f"--jobs={jobs}: expected at least 1")
        self._cells = in_order(cells)
        self._store, self._jobs, self._say = store, jobs, say
        self._runner = runner or LocalRunner(jobs)
        self.records: dict[str, Record] = {}
        self.failed: dict[str, str] = {}
        self._running: list[_Running] = []
        self._stopping = False
        for cell in self._cells:  # before anything runs: all that can be refused
            if all(name in self.records for name in cell.needs):
                self._recall(cell)

    def _recall(self, cell: Cell) -> bool:
        record = self._store.kept(cell, self.records)
        if record is not None:
            self.records[cell.name] = record
        return record is not None

    def run(self) -> Mapping[str, Record]:
        """Run what is missing; a cell that fails keeps only those waiting that need it.

        Raises:
            UsageError: as above, for a cell that could not be looked at earlier.
            EnvironmentFailure: cells failed; all that do not need them are complete.
            KeyboardInterrupt: after SIGINT or SIGTERM, once the commands have ended.
        """
        with stop_on_signal() as stopped:
            try:
                while not stopped and (self._start_some() or self._running):
                    self._collect()
                    time.sleep(_POLL_S)
                if stopped:
                    self._stop(stopped)
            finally:
                self._kill()
        if self.failed:
            raise EnvironmentFailure(self._failures())
        return self.records

    def _start_some(self) -> bool:
        """Start what can be started; whether anything still waits for nothing but room."""
        for cell in self._waiting():
            if not self._has_room(cell):
                return True
            if not self._recall(cell):
                self._start(cell)
        return bool(self._waiting())

    def _has_room(self, cell: Cell) -> bool:
        busy = [running.cell.tool for running in self._running]
        if cell.tool.alone or any(tool.alone for tool in busy):
            return not busy
        return len(busy) < self._jobs

    def _waiting(self) -> list[Cell]:
        """Cells that could begin now; those that must be alone come last, lest the room beside a
        long cell stay empty for them."""
        busy = {running.cell.name for running in self._running}
        ready = [
            cell
            for cell in self._cells
            if cell.name not in self.records
            and cell.name not in self.failed
            and cell.name not in busy
            and all(name in self.records for name in cell.needs)
        ]
        return sorted(ready, key=lambda cell: cell.tool.alone)

    def _start(self, cell: Cell) -> None:
        argv = self._store.prepare(cell, self.records)
        self._progress(cell, "begins")
        run = self._runner.start(cell.tool, argv, self._store.log(cell))
        self._running.append(_Running(cell, argv, run, time.monotonic()))

    def _collect(self) -> None:
        """Keep the results of commands that have ended."""
        for running in list(self._running):
            minutes = (time.monotonic() - running.start) / _MINUTE
            cell = running.cell
            try:
                end = running.run.ended()
            except EnvironmentFailure as error:
                self._running.remove(running)
                self._fail(cell, minutes, str(error))
                continue
            if end is None:
                continue
            self._running.remove(running)
            if end.code == INTERRUPTED and self._stopping:
                self._progress(cell, f"stopped after {minutes:.1f} min")
            elif end.code != 0:
                said = _last_line(self._store.log(cell))
                self._fail(cell, minutes, said or f"exit code {end.code}")
            else:
                now = {"date": datetime.now(UTC).isoformat(timespec="seconds"), **end.machine}
                record = self._store.keep(cell, self.records, running.argv, minutes, now)
                self.records[cell.name] = record
                self._progress(cell, f"done in {minutes:.1f} min")

    def _fail(self, cell: Cell, minutes: float, why: str) -> None:
        self.failed[cell.name] = why
        self._progress(cell, f"failed after {minutes:.1f} min: {why}")

    def _progress(self, cell: Cell, what: str) -> None:
        number = [c.name for c in self._cells].index(cell.name) + 1
        left = len(self._cells) - len(self.records)
        self._say(f"cell {number} of {len(self._cells)}, {cell.name}: {what}; {left} to go")

    def _stop(self, stopped: Sequence[int]) -> None:
        """Interrupt all commands and wait for them; a second signal kills them."""
        self._stopping = True
        self._say(f"stopping {len(self._running)} processes; once more to kill them")
        for running in self._running:
            running.run.interrupt()
        while self._running and len(stopped) < 2:
            self._collect()
            time.sleep(_POLL_S)
        raise KeyboardInterrupt

    def _kill(self) -> None:
        """Leave no process behind."""
        for running in self._running:
            running.run.kill()
        self._running = []

    def _failures(self) -> str:
        name, words = next(iter(self.failed.items()))
        log = self._store.log(next(c for c in self._cells if c.name == name))
        more = f" (and {len(self.failed) - 1} more)" if len(self.failed) > 1 else ""
        return (
            f"cell {name}{more} failed: {words}; see {log}. All that does not need it is "
            "complete; the same command goes on from here once the cause is mended"
        )


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else ""
