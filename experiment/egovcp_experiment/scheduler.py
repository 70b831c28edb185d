"""Runs the cells that have no result yet, several at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from egovcp.entry_point import INTERRUPTED
from egovcp.errors import EnvironmentFailure
from egovcp.workers import stop_on_signal
from egovcp_experiment.cell import Cell
from egovcp_experiment.local_runner import CellProcess, commit, machine
from egovcp_experiment.store import CellStore

_POLL_S: Final = 0.05


class CellScheduler:
    """Runs the cells of an experiment and stores their results.

    Args:
        cells: each after those it needs.
        log: called with each line of progress.

    Raises:
        UsageError: a stored result has other settings.
    """

    def __init__(
        self, cells: Sequence[Cell], store: CellStore, jobs: int, log: Callable[[str], None]
    ) -> None:
        self._cells, self._store, self._jobs, self._log = cells, store, jobs, log
        self.records = store.records
        self.failed: dict[str, str] = {}
        self._running: list[CellProcess] = []
        self._stopping = False
        for cell in self._cells:  # refuses other settings before anything runs
            if self._has_inputs(cell):
                store.load(cell)

    def run(self) -> None:
        """Run what is missing; a failed cell stops only the cells that need it.

        Raises:
            UsageError: a stored result has other settings, found once its inputs are known.
            EnvironmentFailure: cells failed; all cells that do not need them are complete.
            KeyboardInterrupt: after SIGINT or SIGTERM, once the commands have ended.
        """
        with stop_on_signal() as stopped:
            try:
                while not stopped and (self._start_ready() or self._running):
                    self._collect()
                    time.sleep(_POLL_S)
                if stopped:
                    self._stop(stopped)
            finally:
                for process in self._running:
                    process.kill()
                self._running = []
        if self.failed:
            raise EnvironmentFailure(self._failure_message())

    @property
    def outlook(self) -> str:
        """How many cells are left, and about how long they take: the estimates of their commands,
        which are for one cell at a time, or scaled by the times of complete cells of a command."""
        factors = {}
        for command in dict.fromkeys(cell.command for cell in self._cells):
            done = [c for c in self._cells if c.command is command and c.name in self.records]
            estimated = sum(command.minutes(cell.flags) for cell in done)
            measured = sum(self.records[cell.name]["minutes"] for cell in done)
            factors[command.prog] = measured / estimated if estimated else float(self._jobs)
        left = [cell for cell in self._cells if cell.name not in self.records]
        if not left:
            return "all done"
        minutes = sum(c.command.minutes(c.flags) * factors[c.command.prog] for c in left)
        spent = sum(process.minutes for process in self._running)
        return f"{len(left)} to go, {_in_words(max(0.0, minutes - spent) / self._jobs)}"

    def _has_inputs(self, cell: Cell) -> bool:
        return all(name in self.records for name in cell.needs)

    def _ready(self) -> list[Cell]:
        """Cells that could start now, exclusive ones last: they wait for all others."""
        done = {*self.records, *self.failed, *(process.cell.name for process in self._running)}
        ready = [c for c in self._cells if c.name not in done and self._has_inputs(c)]
        return sorted(ready, key=lambda cell: cell.command.exclusive)

    def _start_ready(self) -> bool:
        """Start cells while there is room; returns whether any are still ready."""
        for cell in self._ready():
            if not self._has_room(cell):
                return True
            if not self._store.load(cell):
                argv = self._store.prepare(cell)
                self._progress(cell, "begins")
                used = {process.slot for process in self._running}
                slot = next(k for k in range(self._jobs) if k not in used)
                log = self._store.log(cell)
                jobs = 1 if cell.command.exclusive else self._jobs  # alone: all cores
                self._running.append(CellProcess(cell, argv, log, slot, jobs))
        return bool(self._ready())

    def _has_room(self, cell: Cell) -> bool:
        busy = [process.cell.command for process in self._running]
        if cell.command.exclusive or any(command.exclusive for command in busy):
            return not busy
        return len(busy) < self._jobs

    def _collect(self) -> None:
        """Store the results of commands that have ended."""
        for process in list(self._running):
            cell, code = process.cell, process.ended()
            if code is None:
                continue
            self._running.remove(process)
            minutes = process.minutes
            if code == 0:
                date = datetime.now(UTC).isoformat(timespec="seconds")
                facts = {"minutes": minutes, "date": date, "commit": commit(), **machine()}
                self._store.save(cell, process.argv, facts)
                self._progress(cell, f"done in {minutes:.1f} min")
            elif code == INTERRUPTED and self._stopping:
                self._progress(cell, f"stopped after {minutes:.1f} min")
            else:
                message = _last_line(self._store.log(cell)) or f"exit code {code}"
                self.failed[cell.name] = message
                self._progress(cell, f"failed after {minutes:.1f} min: {message}")

    def _progress(self, cell: Cell, event: str) -> None:
        number = self._cells.index(cell) + 1
        self._log(f"cell {number} of {len(self._cells)}, {cell.name}: {event}; {self.outlook}")

    def _stop(self, stopped: Sequence[int]) -> None:
        """Interrupt all commands and wait for them, until a second signal."""
        self._stopping = True
        self._log(f"stopping {len(self._running)} processes; once more to kill them")
        for process in self._running:
            process.interrupt()
        while self._running and len(stopped) < 2:
            self._collect()
            time.sleep(_POLL_S)
        raise KeyboardInterrupt

    def _failure_message(self) -> str:
        name, message = next(iter(self.failed.items()))
        log = self._store.log(next(c for c in self._cells if c.name == name))
        more = f" (and {len(self.failed) - 1} more)" if len(self.failed) > 1 else ""
        return (
            f"cell {name}{more} failed: {message}; see {log}. All cells that do not need it are "
            "complete; once the cause is fixed, the same command continues from here"
        )


def _in_words(minutes: float) -> str:
    return f"about {minutes / 60:.1f} h" if minutes >= 90 else f"about {max(1, minutes):.0f} min"


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else ""
