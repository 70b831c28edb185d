"""Worker processes that simulate groups of episodes; results come back in order."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized

from egovcp.data import Episode
from egovcp.errors import EnvironmentFailure
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers
from egovcp_collect.config import CollectConfig
from egovcp_collect.rollout import Interrupted, simulate

_AHEAD = 2  # groups in flight per worker: one being simulated, one waiting
_POLL = 0.25  # s between looks at the stop request


@dataclass(frozen=True)
class Shared:
    """What the main process and its workers both see."""

    steps: Synchronized[int]
    """Planner ticks simulated so far, all workers together."""
    stop: Synchronized[int]
    """Not zero: stop at the next tick."""


class SimulationFailed(Exception):
    """The simulation ended early; the cause says why. What was yielded before is good."""


def make_shared() -> Shared:
    """Counters in shared memory, for processes that are spawned."""
    context = multiprocessing.get_context("spawn")
    return Shared(steps=context.Value("q", 0), stop=context.Value("i", 0))


def run_groups(
    config: CollectConfig, shared: Shared, on_wait: Callable[[], None]
) -> Generator[list[Episode]]:
    """Simulate all groups of ``config`` and yield them in order.

    Ends early, without an error, once ``shared.stop`` is set.

    Args:
        config: the collection.
        shared: counters.
        on_wait: called several times per second while nothing is ready.

    Raises:
        SimulationFailed: a worker raised an error or was killed.
    """
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(
        config.workers, context, initializer=_start, initargs=(config, shared)
    )
    groups = iter(config.groups())
    pending: deque[Future[list[Episode] | None]] = deque()
    try:
        with inherited_by_workers():
            for _, group in zip(range(_AHEAD * config.workers), groups, strict=False):
                pending.append(executor.submit(_run_group, group))
        while pending:
            episodes = _result(pending[0], shared, on_wait)
            if episodes is None:
                return
            pending.popleft()
            for group in groups:
                pending.append(executor.submit(_run_group, group))
                break
            yield episodes
    except BrokenProcessPool as error:
        raise SimulationFailed from _killed(error)
    finally:
        shared.stop.value = 1
        executor.shutdown(wait=True, cancel_futures=True)


def _result(
    future: Future[list[Episode] | None], shared: Shared, on_wait: Callable[[], None]
) -> list[Episode] | None:
    """The group's episodes; None if a stop was requested first."""
    while not wait([future], timeout=_POLL).done:
        on_wait()
        if shared.stop.value:
            return None
    error = future.exception()
    if error is not None:
        raise SimulationFailed from _killed(error)
    return future.result()


def _killed(error: BaseException) -> BaseException:
    """What to tell the user of a process that is gone; any other error as it is."""
    if not isinstance(error, BrokenProcessPool):
        return error
    return EnvironmentFailure(
        "a worker process was killed (out of memory?); try fewer --num_workers"
    )


class _Worker:
    """The state of a worker process: environments are dear to build, so they are kept."""

    config: CollectConfig
    shared: Shared
    envs: dict[int, VectorEnv]


def _start(config: CollectConfig, shared: Shared) -> None:
    _Worker.config, _Worker.shared, _Worker.envs = config, shared, {}


def _run_group(scenarios: tuple[Scenario, ...]) -> list[Episode] | None:
    """Runs in a worker; None if a stop was requested."""
    config, shared, envs = _Worker.config, _Worker.shared, _Worker.envs
    size = len(scenarios)
    if size not in envs:
        envs[size] = VectorEnv(config.env, size)

    def on_tick(steps: int) -> bool:
        with shared.steps.get_lock():
            shared.steps.value += steps
        return not shared.stop.value

    policy = RandomWalk(config.eta, config.boundary)
    try:
        return simulate(envs[size], policy, scenarios, on_tick)
    except Interrupted:
        return None
