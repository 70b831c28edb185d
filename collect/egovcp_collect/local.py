"""Workers as processes of this machine, which put their episodes into the spool themselves."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import traceback
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Final

from egovcp.data import Episode
from egovcp.data.staging import StagedEpisode, StagingDir
from egovcp.hardware import available_cores
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers
from egovcp_collect.backend import Brief, Report, encode_numbered, portable
from egovcp_collect.config import CollectConfig
from egovcp_collect.simulation import Simulation

_REPORT_EVERY: Final = 0.25  # s
_UNSEALED: Final = 32  # episodes that may wait for a slow disk before the simulation does


class LocalWorker:
    """A process at the other end of a pipe."""

    def __init__(self, config: CollectConfig, spool: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(theirs, config, spool, os.getpid()), daemon=True
        )
        with inherited_by_workers():
            self.process.start()
        theirs.close()

    def give(self, scenarios: Sequence[Scenario]) -> None:
        """More episodes; lost, and given to another, if the process is dying."""
        try:
            self.pipe.send(list(scenarios))
        except OSError:
            self.process.join(timeout=1)

    def reports(self) -> list[Report]:
        """What lies in the pipe."""
        found: list[Report] = []
        try:
            while self.pipe.poll():
                found.append(self.pipe.recv())
        except (EOFError, OSError, pickle.UnpicklingError):
            self.process.join(timeout=1)
        return found

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process.is_alive()

    def kill(self) -> None:
        """SIGKILL: what it was simulating is lost, what it has sealed is not."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


class LocalBackend:
    """Starts `LocalWorker`s."""

    def __init__(self, config: CollectConfig, spool: Path) -> None:
        self._config = config
        self._spool = spool
        self._workers: list[LocalWorker] = []

    @property
    def cores(self) -> int:
        """Processor cores that this process may use."""
        return available_cores()

    def start(self) -> LocalWorker:
        """A new process."""
        self._workers = [worker for worker in self._workers if not worker.pipe.closed]
        self._workers.append(LocalWorker(self._config, self._spool))
        return self._workers[-1]

    def wait(self, seconds: float) -> None:
        """Until one has written into its pipe or has died."""
        open_ones = [worker for worker in self._workers if not worker.pipe.closed]
        wait([thing for w in open_ones for thing in (w.pipe, w.process.sentinel)], timeout=seconds)

    def close(self) -> None:
        """Nothing is held."""


def _serve(pipe: Connection, config: CollectConfig, spool: Path, parent: int) -> None:
    """Runs in the process, until the pipe or the parent is gone."""
    try:
        simulation, sealer = Simulation(config), _Sealer(StagingDir(spool))
        while os.getppid() == parent:
            _receive(pipe, simulation)
            progress = simulation.advance(_REPORT_EVERY)
            for number, episode in progress.episodes:
                sealer.seal(number, episode)
            pipe.send(Report(progress.steps, sealer.finished(wait=simulation.idle)))
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:  # noqa: BLE001 - whatever it is, the collection must hear of it
        error.add_note(traceback.format_exc())
        pipe.send(Report(0, failure=portable(error)))


def _receive(pipe: Connection, simulation: Simulation) -> None:
    """Take the episodes that have come in; wait for some if there is nothing to do."""
    while pipe.poll(None if simulation.idle else 0):
        simulation.add(pipe.recv())


class _Sealer:
    """Seals episodes on a thread: the simulation goes on while the disk flushes."""

    def __init__(self, spool: StagingDir) -> None:
        self._spool = spool
        self._pool = ThreadPoolExecutor(1)
        self._pending: deque[Future[Brief]] = deque()

    def seal(self, number: int, episode: Episode) -> None:
        """Begin."""
        self._pending.append(self._pool.submit(self._put, number, episode))

    def _put(self, number: int, episode: Episode) -> Brief:
        encoded = encode_numbered(number, episode)
        self._spool.put(StagedEpisode.of(number, encoded))
        return Brief.of(number, encoded)

    def finished(self, wait: bool) -> tuple[Brief, ...]:
        """Those that have been sealed since the last call; all of them if ``wait``, and with a
        slow disk as many as it takes to bound the memory.

        Raises:
            DataError: an episode is not valid.
            OSError: the disk is full.
        """
        out = []
        while self._pending and (wait or len(self._pending) > _UNSEALED or self._pending[0].done()):
            out.append(self._pending.popleft().result())
        return tuple(out)
