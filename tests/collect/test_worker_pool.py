"""Workers that die, hang and fail: the pool finishes every episode."""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from multiprocessing import Pipe
from pathlib import Path

import pytest

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.sim.scenario import Scenario
from egovcp_collect.config import CollectConfig
from egovcp_collect.worker_pool import MAX_ATTEMPTS, Worker, WorkerPool, WorkerReport

_NUM_ENVS = 2

type Behaviour = Callable[["_Worker", int], WorkerReport | None]


class _Worker:
    """Finishes one episode per poll; ``behaviour`` may do something else instead."""

    def __init__(self, behaviour: Behaviour) -> None:
        self._behaviour = behaviour
        self._todo: list[int] = []
        self._pipe, remote = Pipe()
        remote.close()  # the other end is always ready
        self.waitables = [self._pipe]
        self.unfinished: dict[int, Scenario] = {}
        self.last_report = time.monotonic()
        self.alive = True
        self.hung = False
        self.killed = False

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        self._todo += [scenario.episode for scenario in scenarios]

    def poll(self) -> list[WorkerReport]:
        if not self._todo or not self.alive or self.hung:
            return []
        report = self._behaviour(self, self._todo[0])
        if report is not None:
            return [report]
        if not self.alive or self.hung:
            return []
        return [WorkerReport(10, (self._todo.pop(0),))]

    @property
    def death(self) -> str:
        return "ended"

    def kill(self) -> None:
        self.alive, self.killed = False, True


def _run(
    behaviour: Behaviour, episodes: int = 20, workers: int = 2
) -> tuple[list[int], list[_Worker]]:
    """Numbers of the finished episodes in order, and all workers that were started."""
    started: list[_Worker] = []

    def start() -> _Worker:
        started.append(_Worker(behaviour))
        return started[-1]

    scenarios = [Scenario("ball", 0, i) for i in range(episodes)]
    numbers: list[int] = []
    with closing(WorkerPool(start, workers, scenarios, _NUM_ENVS, timeout=0.05)) as pool:
        while not pool.done:
            for report in pool.poll():
                numbers += report.finished
    return numbers, started


def _once(what: Callable[[_Worker], WorkerReport | None], at: int) -> Behaviour:
    """Do it the first time that episode ``at`` is simulated."""
    done = []

    def behaviour(worker: _Worker, number: int) -> WorkerReport | None:
        if number != at or done:
            return None
        done.append(number)
        return what(worker)

    return behaviour


def _die(worker: _Worker) -> None:
    worker.alive = False


def _hang(worker: _Worker) -> None:
    worker.hung = True


def _normal(worker: _Worker, number: int) -> None:
    return None


@pytest.mark.parametrize("episodes", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_episode_is_finished_once(episodes: int, workers: int) -> None:
    numbers, started = _run(_normal, episodes, workers)
    assert sorted(numbers) == list(range(episodes))
    assert len(started) <= workers
    assert all(worker.killed for worker in started)


@pytest.mark.parametrize("fault", [_die, _hang])
@pytest.mark.parametrize("at", [0, 7, 19])
def test_a_lost_worker_is_replaced_and_its_episodes_are_repeated(
    fault: Callable[[_Worker], None], at: int
) -> None:
    numbers, started = _run(_once(fault, at))
    assert sorted(numbers) == list(range(20))
    assert len(started) == 3


def test_an_episode_that_kills_every_worker_raises() -> None:
    def behaviour(worker: _Worker, number: int) -> None:
        worker.alive = number != 7

    with pytest.raises(
        EnvironmentFailure, match=rf"{MAX_ATTEMPTS} workers were lost .*episodes \(7 to .* ended"
    ):
        _run(behaviour)


def test_an_episode_that_always_hangs_raises() -> None:
    def behaviour(worker: _Worker, number: int) -> None:
        worker.hung = number == 7

    with pytest.raises(EnvironmentFailure, match="sent no report for"):
        _run(behaviour)


@pytest.mark.parametrize(
    "failure",
    [
        OSError(28, "No space left on device"),
        DataError("episode 7, frame 3: state is not finite"),
        RuntimeError("bug"),
    ],
)
def test_errors_of_workers_are_raised_at_once(failure: Exception) -> None:
    with pytest.raises(type(failure)):
        _run(_once(lambda worker: WorkerReport(0, error=failure), 7))


def test_the_death_of_a_worker_tells_its_exit_code(tmp_path: Path) -> None:
    worker = Worker(CollectConfig(), tmp_path)
    worker.process.kill()
    assert worker.death == "ended with exit code -9 (out of memory? try fewer --num_workers)"
    worker.kill()
