"""Simulation workers, which are processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import time
import traceback
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from egovcp.data import Episode
from egovcp.data.staging import EncodedEpisode, StagedEpisode, StagingDir, encode
from egovcp.errors import DataError
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers
from egovcp_collect.config import CollectConfig
from egovcp_collect.simulation import Simulation

_REPORT_S: Final = 0.25
_MAX_PENDING: Final = 32  # episodes in memory that wait for the disk


@dataclass(frozen=True)
class WorkerReport:
    """What a worker did since its last report."""

    steps: int
    """Planner ticks."""
    finished: tuple[int, ...] = ()
    """Numbers of the episodes that it finished."""
    error: Exception | None = None
    """The error that ended the worker; this is its last report."""


def encode_episode(number: int, episode: Episode) -> EncodedEpisode:
    """Validate and encode an episode.

    Raises:
        DataError: it is invalid; the error's ``episode`` is ``number``.
    """
    try:
        return encode(episode, f"episode {number}")
    except DataError as error:
        error.episode = number
        raise


def picklable(error: Exception) -> Exception:
    """The error, or a `RuntimeError` with its message if it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - bytes made in this expression
    except Exception:  # noqa: BLE001 - an exception class may raise anything here
        return RuntimeError("".join(traceback.format_exception_only(error)).strip())
    return error


class Worker:
    """A process that stages its episodes on the disk itself; reports come through a pipe."""

    def __init__(self, config: CollectConfig, staging: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, remote = context.Pipe()
        self.process = context.Process(
            target=_run_worker, args=(remote, config, staging, os.getpid()), daemon=True
        )
        with inherited_by_workers():
            self.process.start()
        remote.close()
        self.last_report = time.monotonic()
        self.unfinished: dict[int, Scenario] = {}
        """Its episodes by number."""

    @property
    def waitables(self) -> list[Connection | int]:
        """What `multiprocessing.connection.wait` returns on a report, or on the worker's death."""
        return [self.pipe, self.process.sentinel]

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        """Append episodes to its queue."""
        try:
            self.pipe.send(list(scenarios))
        except OSError:  # the process is dying; the pool assigns the episodes again
            self.process.join(timeout=1)

    def poll(self) -> list[WorkerReport]:
        """Reports since the last call; does not block."""
        reports: list[WorkerReport] = []
        try:
            while self.pipe.poll():
                reports.append(self.pipe.recv())
        except (EOFError, OSError, pickle.UnpicklingError):
            self.process.join(timeout=1)
        return reports

    @property
    def alive(self) -> bool:
        """Whether more reports can follow."""
        return self.process.is_alive()

    def kill(self) -> None:
        """End it immediately; returns when it has ended."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _run_worker(pipe: Connection, config: CollectConfig, staging: Path, parent: int) -> None:
    """Body of the process; it ends with the pipe or with the parent."""
    try:
        simulation, stage = Simulation(config), partial(_stage, StagingDir(staging))
        disk = ThreadPoolExecutor(1)  # so that the simulation does not wait for the disk
        pending: deque[Future[int]] = deque()
        while os.getppid() == parent:
            while pipe.poll(None if simulation.idle else 0):  # an idle worker blocks here
                simulation.add(pipe.recv())
            steps, episodes = simulation.run(_REPORT_S)
            pending.extend(disk.submit(stage, *episode) for episode in episodes)
            finished: list[int] = []
            while pending and (simulation.idle or len(pending) > _MAX_PENDING or pending[0].done()):
                finished.append(pending.popleft().result())
            pipe.send(WorkerReport(steps, tuple(finished)))
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:  # noqa: BLE001 - every error is reported to the collection
        error.add_note(traceback.format_exc())
        pipe.send(WorkerReport(0, error=picklable(error)))


def _stage(staging: StagingDir, number: int, episode: Episode) -> int:
    """Write an episode to the disk; returns its number."""
    staging.put(StagedEpisode.of(number, encode_episode(number, episode)))
    return number
