"""Keeps a number of workers busy until every episode is there, whatever happens to the workers.

A worker that dies, or says nothing for too long, is replaced; its unfinished episodes are played
again, by whoever is free. Since an episode is a function of its scenario alone, nobody can tell.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Final, Self

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.sim.scenario import Scenario
from egovcp_collect.backend import Backend, Report, Worker

#: An episode that ends its worker this often is not bad luck.
ATTEMPTS: Final = 3
_POLL: Final = 0.25  # s


@dataclass
class _Post:
    """A worker, what it has to do, and when it last gave a sign of life."""

    worker: Worker
    heard: float = field(default_factory=time.monotonic)
    todo: dict[int, Scenario] = field(default_factory=dict)


class Crew:
    """Workers of a backend. As a context manager it ends them all on leaving."""

    def __init__(
        self,
        backend: Backend,
        workers: int,
        scenarios: Iterable[Scenario],
        robots: int,
        timeout: float,
    ) -> None:
        """Nothing is started yet.

        Args:
            backend: starts workers.
            workers: how many.
            scenarios: the episodes to play, in this order.
            robots: how many each worker plays side by side.
            timeout: seconds without a report after which a worker counts as hung.
        """
        self._backend = backend
        self._waiting = deque(scenarios)
        self._robots = robots
        self._timeout = timeout
        self._count = max(1, min(workers, -(-len(self._waiting) // robots)))
        self._posts: list[_Post] = []
        self._lost: Counter[int] = Counter()
        self._invalid: Counter[int] = Counter()
        self.replaced = 0
        """Workers that died or hung."""

    @property
    def over(self) -> bool:
        """Whether every episode has been reported."""
        return not self._waiting and not any(post.todo for post in self._posts)

    def __enter__(self) -> Self:
        for _ in range(self._count):
            self._hire()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with ExitStack() as stack:  # one that fails to end does not keep the others
            stack.callback(self._backend.close)
            for post in self._posts:
                stack.callback(post.worker.kill)

    def poll(self) -> list[Report]:
        """Wait a moment for reports, replace whom it takes, and hand out work.

        Raises:
            DataError: an episode came out invalid twice.
            EnvironmentFailure: an episode has ended its worker several times.
            Exception: what a worker failed with, a full disk for instance.
        """
        self._backend.wait(_POLL)
        reports = [report for post in list(self._posts) for report in self._hear(post)]
        for post in self._posts:
            self._supply(post)
        return reports

    def _hear(self, post: _Post) -> list[Report]:
        alive = post.worker.alive  # asked first: the last words of a worker that has died count
        reports = post.worker.reports()
        for report in reports:
            post.heard = time.monotonic()
            for brief in report.done:
                post.todo.pop(brief.number, None)
            if report.failure is not None:
                self._replace(post, report.failure)
                return reports
        if not alive:
            self._replace(post, None)
        elif post.todo and time.monotonic() - post.heard > self._timeout:
            self._replace(post, TimeoutError(f"gave no sign of life for {self._timeout:.0f} s"))
        return reports

    def _replace(self, post: _Post, cause: Exception | None) -> None:
        """Another worker for one that is gone, and its episodes first in line again."""
        post.worker.kill()
        self._posts.remove(post)
        if cause is not None and not isinstance(cause, DataError | TimeoutError):
            raise cause
        if isinstance(cause, DataError):
            self._count_invalid(post, cause)
        else:
            self._count_lost(post, cause)
        self.replaced += 1
        self._waiting.extendleft(reversed(post.todo.values()))
        self._hire()

    def _count_invalid(self, post: _Post, cause: DataError) -> None:
        """Raise if the episode at fault came out invalid before; the worker's others are blameless.

        If it is not known which one it was, any of them may have been.
        """
        suspects = [n for n in post.todo if cause.episode in (None, n)]
        self._invalid.update(suspects)
        if not suspects or max(self._invalid[number] for number in suspects) > 1:
            raise cause

    def _count_lost(self, post: _Post, cause: Exception | None) -> None:
        """Raise if the episodes of this post have met the same fate too often."""
        self._lost.update(post.todo.keys())
        attempts = max((self._lost[number] for number in post.todo), default=0)
        if attempts >= ATTEMPTS:
            first, last = min(post.todo), max(post.todo)
            reason = str(cause) if cause else "was killed (out of memory? try fewer --num_workers)"
            raise EnvironmentFailure(
                f"a worker {reason}, {attempts} times in a row, while it simulated episodes "
                f"{first} to {last}"
            )

    def _hire(self) -> None:
        """Start a worker, with a fair share of what waits to begin with."""
        share = -(-len(self._waiting) // max(1, self._count - len(self._posts)))
        post = _Post(self._backend.start())
        self._posts.append(post)
        self._give(post, min(2 * self._robots, share))

    def _supply(self, post: _Post) -> None:
        """Keep all robots of a worker busy, with the next episodes at hand until the end nears."""
        fair = -(-(len(self._waiting) + len(post.todo)) // self._count)
        wanted = min(2 * self._robots, max(self._robots, fair)) - len(post.todo)
        count = min(wanted, len(self._waiting))
        if count >= min(self._robots // 4, len(self._waiting)):
            self._give(post, count)

    def _give(self, post: _Post, count: int) -> None:
        scenarios = [self._waiting.popleft() for _ in range(min(count, len(self._waiting)))]
        if scenarios:
            if not post.todo:
                post.heard = time.monotonic()  # idle until now, which is no reason to worry
            post.todo.update({scenario.episode: scenario for scenario in scenarios})
            post.worker.give(scenarios)
