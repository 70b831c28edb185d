"""Runs episodes on a pool of workers until all are finished.

A worker that dies or stops reporting is replaced, and its unfinished episodes are simulated again.
An episode depends on its scenario only, so the data do not depend on replacements.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from multiprocessing.connection import wait
from typing import Final

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.sim.scenario import Scenario
from egovcp_collect.workers import Worker, WorkerReport

MAX_ATTEMPTS: Final = 3
"""How many workers may die on the same episode before the collection stops."""
_POLL_S: Final = 0.25


class WorkerPool:
    """Assigns episodes to workers, and replaces workers that are lost.

    Args:
        start: starts a worker.
        workers: how many to start.
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
        self._invalid: Counter[int] = Counter()

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
            DataError: an episode was invalid twice.
            EnvironmentFailure: an episode ended its worker `MAX_ATTEMPTS` times.
            Exception: any other error of a worker, such as a full disk.
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
                self._replace(worker, report.error)
                return reports
        if not alive:
            self._replace(worker, None)
        elif worker.unfinished and time.monotonic() - worker.last_report > self._timeout:
            self._replace(worker, TimeoutError(f"sent no report for {self._timeout:.0f} s"))
        return reports

    def _replace(self, worker: Worker, cause: Exception | None) -> None:
        """End a worker; its unfinished episodes go to the front of the queue."""
        worker.kill()
        self._workers.remove(worker)
        if isinstance(cause, DataError):
            self._count_invalid(worker, cause)
        elif cause is None or isinstance(cause, TimeoutError):
            self._count_lost(worker, cause)
        else:
            raise cause
        self._waiting.extendleft(reversed(worker.unfinished.values()))

    def _count_invalid(self, worker: Worker, cause: DataError) -> None:
        """Raise at the second invalid result of an episode. All unfinished episodes of the worker
        count if the error does not name one."""
        suspects = [n for n in worker.unfinished if cause.episode in (None, n)]
        self._invalid.update(suspects)
        if not suspects or max(self._invalid[number] for number in suspects) > 1:
            raise cause

    def _count_lost(self, worker: Worker, cause: Exception | None) -> None:
        """Raise if an episode of the worker has ended `MAX_ATTEMPTS` workers."""
        self._lost.update(worker.unfinished.keys())
        attempts = max((self._lost[number] for number in worker.unfinished), default=0)
        if attempts >= MAX_ATTEMPTS:
            first, last = min(worker.unfinished), max(worker.unfinished)
            reason = str(cause) if cause else "was killed (out of memory? try fewer --num_workers)"
            raise EnvironmentFailure(
                f"a worker {reason}, {attempts} times in a row, while it simulated episodes "
                f"{first} to {last}"
            )

    def _start_worker(self) -> None:
        """Start a worker with an equal share of the waiting episodes."""
        share = -(-len(self._waiting) // (self._count - len(self._workers)))
        worker = self._start()
        self._workers.append(worker)
        self._assign(worker, min(2 * self._num_envs, share))

    def _refill(self, worker: Worker) -> None:
        """Assign enough episodes to keep all robots of a worker busy, less towards the end."""
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
