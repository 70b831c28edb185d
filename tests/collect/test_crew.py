"""Workers that die, hang and fail: the crew must get every episode all the same."""

import copy
import time
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.sim.scenario import Scenario
from egovcp.testing import random_episode
from egovcp_collect.backend import Brief, Report, encode_numbered, portable
from egovcp_collect.crew import ATTEMPTS, Crew

_ROBOTS = 2

type Deed = Callable[["_Worker", int], Report | None]


def _brief(number: int) -> Brief:
    return Brief(number, 10, True, {"block": 1}, 1)


class _Worker:
    """Plays one episode per look at its reports; ``deed`` may do something else instead."""

    def __init__(self, deed: Deed) -> None:
        self._deed = deed
        self._todo: list[int] = []
        self.alive = True
        self.hung = False
        self.killed = False

    def give(self, scenarios: Sequence[Scenario]) -> None:
        self._todo += [scenario.episode for scenario in scenarios]

    def reports(self) -> list[Report]:
        if not self._todo or not self.alive or self.hung:
            return []
        report = self._deed(self, self._todo[0])
        if report is not None:
            return [report]
        if not self.alive or self.hung:
            return []
        return [Report(10, (_brief(self._todo.pop(0)),))]

    def kill(self) -> None:
        self.alive, self.killed = False, True


class _Backend:
    cores = 2

    def __init__(self, deed: Deed) -> None:
        self._deed = deed
        self.workers: list[_Worker] = []

    def start(self) -> _Worker:
        self.workers.append(_Worker(self._deed))
        return self.workers[-1]

    def wait(self, seconds: float) -> None:
        time.sleep(0.001)

    def close(self) -> None:
        pass


def _play(deed: Deed, episodes: int = 20, workers: int = 2) -> tuple[list[int], Crew, _Backend]:
    """Numbers of the episodes in the order in which they came."""
    backend = _Backend(deed)
    scenarios = [Scenario("ball", 0, i) for i in range(episodes)]
    numbers: list[int] = []
    with Crew(backend, workers, scenarios, _ROBOTS, timeout=0.05) as crew:
        while not crew.over:
            for report in crew.poll():
                numbers += [brief.number for brief in report.done]
    return numbers, crew, backend


def _once(what: Callable[[_Worker], Report | None], at: int) -> Deed:
    """Do it the first time that episode ``at`` is played."""
    done = []

    def deed(worker: _Worker, number: int) -> Report | None:
        if number != at or done:
            return None
        done.append(number)
        return what(worker)

    return deed


def _die(worker: _Worker) -> None:
    worker.alive = False


def _hang(worker: _Worker) -> None:
    worker.hung = True


def _nothing(worker: _Worker, number: int) -> None:
    return None


@pytest.mark.parametrize("episodes", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_episode_comes_once(episodes: int, workers: int) -> None:
    numbers, crew, backend = _play(_nothing, episodes, workers)
    assert sorted(numbers) == list(range(episodes))
    assert crew.replaced == 0
    assert len(backend.workers) <= workers
    assert all(worker.killed for worker in backend.workers)


@pytest.mark.parametrize("mishap", [_die, _hang])
@pytest.mark.parametrize("at", [0, 7, 19])
def test_a_lost_worker_is_replaced_and_its_episodes_played_again(
    mishap: Callable[[_Worker], None], at: int
) -> None:
    numbers, crew, backend = _play(_once(mishap, at))
    assert sorted(numbers) == list(range(20))
    assert crew.replaced == 1
    assert len(backend.workers) == 3


def test_an_episode_that_kills_every_worker_ends_the_run() -> None:
    def deed(worker: _Worker, number: int) -> None:
        worker.alive = number != 7

    with pytest.raises(EnvironmentFailure, match=rf"was killed .*{ATTEMPTS} times.* episodes 7 to"):
        _play(deed)


def test_an_episode_that_always_hangs_ends_the_run() -> None:
    def deed(worker: _Worker, number: int) -> None:
        worker.hung = number == 7

    with pytest.raises(EnvironmentFailure, match="no sign of life"):
        _play(deed)


def test_an_invalid_episode_is_played_once_more() -> None:
    broken = DataError("episode 7, frame 3: state is not finite")
    numbers, crew, _ = _play(_once(lambda worker: Report(0, failure=broken), 7))
    assert sorted(numbers) == list(range(20))
    assert crew.replaced == 1


def test_an_episode_that_stays_invalid_ends_the_run() -> None:
    broken = DataError("episode 7, frame 3: state is not finite")

    def deed(worker: _Worker, number: int) -> Report | None:
        return Report(0, failure=broken) if number == 7 else None

    with pytest.raises(DataError, match="episode 7, frame 3"):
        _play(deed)


def _invalid(number: int) -> DataError:
    error = DataError(f"episode {number}, frame 3: state is not finite")
    error.episode = number
    return error


def test_an_invalid_episode_is_not_held_against_those_beside_it() -> None:
    """Two of one worker's episodes are invalid once each: neither stayed so."""
    failed: list[int] = []

    def deed(worker: _Worker, number: int) -> Report | None:
        if number not in (6, 7) or number in failed:
            return None
        failed.append(number)
        return Report(0, failure=_invalid(number))

    numbers, crew, _ = _play(deed, workers=1)
    assert sorted(numbers) == list(range(20))
    assert crew.replaced == 2


def test_an_invalid_episode_is_found_among_lost_workers() -> None:
    """A worker that died on the same episodes before is no reason to give up one that is new."""
    mishaps: list[str] = []

    def deed(worker: _Worker, number: int) -> Report | None:
        if number != 7 or len(mishaps) == 2:
            return None
        mishaps.append("death" if not mishaps else "invalid")
        if len(mishaps) == 2:
            return Report(0, failure=_invalid(7))
        worker.alive = False
        return None

    numbers, crew, _ = _play(deed)
    assert sorted(numbers) == list(range(20))
    assert crew.replaced == 2


def test_the_number_of_an_invalid_episode_travels_with_the_error() -> None:
    episode = random_episode(7)
    episode.state[3, 0] = np.nan
    with pytest.raises(DataError, match="episode 7, frame 3") as caught:
        encode_numbered(7, episode)
    arrived = copy.copy(portable(caught.value))  # goes the way of pickle
    assert isinstance(arrived, DataError)
    assert (arrived.episode, str(arrived)) == (7, str(caught.value))


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), RuntimeError("bug")])
def test_other_failures_end_the_run_at_once(failure: Exception) -> None:
    with pytest.raises(type(failure)):
        _play(_once(lambda worker: Report(0, failure=failure), 7))
