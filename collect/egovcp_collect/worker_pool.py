"""Runs episodes on a pool of processes until all are finished.

A worker that dies or stops reporting is replaced, and its unfinished episodes are simulated again.
An episode depends on its scenario only, so the data do not depend on replacements.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Final

from egovcp.data import Episode
from egovcp.data.staging import StagingDir, encode
from egovcp.errors import EnvironmentFailure
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers, is_picklable
from egovcp_collect.config import CollectConfig
from egovcp_collect.simulation import Simulation

MAX_ATTEMPTS: Final = 3
"""Number of lost workers with the same unfinished episode at which the collection stops."""
_POLL_S: Final = 0.25
_REPORT_S: Final = 0.25
_MAX_PENDING: Final = 32  # episodes in memory that wait for the disk


class WorkerPool:
    """Assigns episodes to workers, and replaces workers that are lost.

    Args:
        start: creates a worker.
        workers: number of processes; fewer if there are few episodes.
        scenarios: episodes to play, in order.
        num_envs: episodes that each worker simulates in parallel.
        timeout: seconds without a report after which a worker is replaced.
    """

    def __init__(
        self,
        start: Callable[[], Worker],
        workers: int,
        scenarios: Iterable[Scenario],
        num_envs: int,
        timeout: float,
    ) -> None:
        self._start = start
        self._waiting = deque(scenarios)
        self._num_envs = num_envs
        self._timeout = timeout
        self._count = max(1, min(workers, -(-len(self._waiting) // num_envs)))
        self._workers: list[Worker] = []
        self._lost: Counter[int] = Counter()

    @property
    def done(self) -> bool:
        """Whether every episode has been reported."""
        return not self._waiting and not any(worker.unfinished for worker in self._workers)

    def close(self) -> None:
        """End all workers."""
        with ExitStack() as stack:  # an error while one worker ends does not leave the others
            for worker in self._workers:
                stack.callback(worker.kill)

    def poll(self) -> list[WorkerReport]:
        """Start missing workers, wait briefly for reports, and assign waiting episodes.

        Raises:
            EnvironmentFailure: an episode ended its worker `MAX_ATTEMPTS` times.
            Exception: an error of a worker, such as a full disk or an invalid episode.
        """
        while len(self._workers) < self._count:
            self._start_worker()
        wait([each for worker in self._workers for each in worker.waitables], timeout=_POLL_S)
        reports = [report for worker in list(self._workers) for report in self._poll_worker(worker)]
        for worker in self._workers:
            self._refill(worker)
        return reports

    def _poll_worker(self, worker: Worker) -> list[WorkerReport]:
        alive = worker.alive  # read first: reports sent before the death still count
        reports = worker.poll()
        for report in reports:
            worker.last_report = time.monotonic()
            for number in report.finished:
                worker.unfinished.pop(number, None)
            if report.error is not None:
                raise report.error
        if not alive:
            self._replace(worker, worker.death)
        elif worker.unfinished and time.monotonic() - worker.last_report > self._timeout:
            self._replace(worker, f"sent no report for {self._timeout:.0f} s")
        return reports

    def _replace(self, worker: Worker, reason: str) -> None:
        """End a worker; its unfinished episodes go to the front of the queue.

        Raises if one of them has ended `MAX_ATTEMPTS` workers.
        """
        worker.kill()
        self._workers.remove(worker)
        self._lost.update(worker.unfinished.keys())
        attempts = max((self._lost[number] for number in worker.unfinished), default=0)
        if attempts >= MAX_ATTEMPTS:
            first, last = min(worker.unfinished), max(worker.unfinished)
            raise EnvironmentFailure(
                f"{attempts} workers were lost with the same unfinished episodes ({first} to "
                f"{last}); the last one {reason}"
            )
        self._waiting.extendleft(reversed(worker.unfinished.values()))

    def _start_worker(self) -> None:
        """Start a worker with an equal share of the waiting episodes."""
        share = -(-len(self._waiting) // (self._count - len(self._workers)))
        worker = self._start()
        self._workers.append(worker)
        self._assign(worker, min(2 * self._num_envs, share))

    def _refill(self, worker: Worker) -> None:
        """Keep up to two episodes per robot of a worker assigned; the last ones are shared equally.

        Waits until a quarter of the robots has none, so that messages are few.
        """
        share = -(-(len(self._waiting) + len(worker.unfinished)) // self._count)
        wanted = min(2 * self._num_envs, max(self._num_envs, share)) - len(worker.unfinished)
        count = min(wanted, len(self._waiting))
        if count >= min(self._num_envs // 4, len(self._waiting)):
            self._assign(worker, count)

    def _assign(self, worker: Worker, count: int) -> None:
        scenarios = [self._waiting.popleft() for _ in range(min(count, len(self._waiting)))]
        if scenarios:
            if not worker.unfinished:
                worker.last_report = time.monotonic()  # an idle worker sends no reports
            worker.unfinished.update({scenario.episode: scenario for scenario in scenarios})
            worker.assign(scenarios)


@dataclass(frozen=True)
class WorkerReport:
    """What a worker did since its last report."""

    steps: int
    """Planner ticks."""
    finished: tuple[int, ...] = ()
    """Numbers of the episodes that it finished."""
    error: Exception | None = None
    """The error that ended the worker; this is its last report."""


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
        """Assigned episodes that it has not reported as finished, by number."""

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
        """Reports since the last call; waits at most 1 s if the process is ending."""
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

    @property
    def death(self) -> str:
        """How the process ended."""
        self.process.join(timeout=1)
        code = self.process.exitcode
        hint = " (out of memory? try fewer --num_workers)" if code == -signal.SIGKILL else ""
        return f"ended with exit code {code}{hint}"

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
        text = "".join(traceback.format_exception_only(error)).strip()
        pipe.send(WorkerReport(0, error=error if is_picklable(error) else RuntimeError(text)))


def _stage(staging: StagingDir, number: int, episode: Episode) -> int:
    """Write an episode to the disk; returns its number."""
    staging.put(number, encode(episode, f"episode {number}"))
    return number
