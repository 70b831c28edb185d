"""Plays groups of episodes side by side, in this process or in worker processes."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.errors import EnvironmentFailure
from egovcp.hardware import available_cores
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp.reactive import ReactiveNetwork, ReactivePolicy
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers
from egovcp_deploy.controllers import PPO, Constants, Controller, Planned, reference
from egovcp_deploy.options import PLANNER
from egovcp_deploy.policy import RolloutPolicy
from egovcp_deploy.safety import SafetyFilter
from egovcp_deploy.scores import EpisodeScore

_POLL_S: Final = 0.2


@dataclass(frozen=True)
class Setup:
    """What every group needs; sent to each worker once."""

    env: EnvConfig
    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """Names nothing when no planner plays."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    seed: int = 0
    ppo: str = ""
    """File of the controller `ppo`."""


@dataclass(frozen=True)
class Group:
    """Scenarios of one task, played side by side by one controller."""

    controller: str
    scenarios: tuple[Scenario, ...]
    actions: tuple[tuple[float, ...], ...] = ()
    """For ``constant``: one action per scenario."""


class Player:
    """Plays groups in this process; environments and the artifact are kept between groups."""

    def __init__(self, setup: Setup, artifact: Artifact | None = None) -> None:
        self._setup = setup
        self._artifact = artifact
        self._envs: dict[int, VectorEnv] = {}
        self._planned: dict[tuple[str, int], Planned] = {}

    def play(self, group: Group, stopped: Callable[[], bool] = lambda: False) -> list[EpisodeScore]:
        """Scores in the order of the group's scenarios; see `play`."""
        if stopped():
            return []
        size = len(group.scenarios)
        if size not in self._envs:
            self._envs[size] = VectorEnv(self._setup.env, size)
        return play(self._envs[size], self._controller(group), group.scenarios, stopped)

    def _controller(self, group: Group) -> Controller:
        if group.controller == "constant":
            return Constants(np.array(group.actions))
        if group.controller not in (PPO, PLANNER):
            return reference(group.controller)
        key = group.controller, len(group.scenarios)
        if key not in self._planned:
            self._planned[key] = Planned(self._policy(*key))
            self._planned[key].warm_up(len(group.scenarios))  # else the first plan is timed
        return self._planned[key]

    def _policy(self, controller: str, robots: int) -> RolloutPolicy:
        setup = self._setup
        if controller == PPO:
            return ReactivePolicy(ReactiveNetwork.load(Path(setup.ppo)), robots)
        if self._artifact is None:
            self._artifact = load_policy(setup.policy, setup.planner)
        return self._artifact.make_policy(robots, setup.seed)


def play(
    env: VectorEnv,
    controller: Controller,
    scenarios: Sequence[Scenario],
    stopped: Callable[[], bool] = lambda: False,
) -> list[EpisodeScore]:
    """One episode per row of ``env``, to the end of all of them.

    Returns:
        The scores of the episodes that ended: all of them, unless ``stopped`` became true.
    """
    observation = env.reset(scenarios)
    controller.reset(env, scenarios)
    safety = SafetyFilter(env.num_envs)
    tally = _Tally(env.num_envs)
    while not env.done.all() and not stopped():
        live = ~env.done
        begin = time.perf_counter()
        planned = controller.act(env, observation)
        tally.plan_ms.append((time.perf_counter() - begin) * 1e3 / env.num_envs)
        if isinstance(controller, Planned) and controller.skipped.size:
            tally.skipped += live & controller.skipped
        result = env.step(safety.filter(planned).action)
        controller.advance(result.sent_action)
        tally.rewards += np.where(live, result.reward, 0.0)
        tally.steps += live
        tally.success, tally.terminated = result.success, result.terminated
        tally.parts = result.parts
        observation = result.observation
    return [score for score, done in zip(tally.scores(scenarios), env.done, strict=True) if done]


class _Tally:
    """Running sums of a group."""

    def __init__(self, rows: int) -> None:
        self.rewards = np.zeros(rows)
        self.steps = np.zeros(rows, np.int64)
        self.skipped = np.zeros(rows, np.int64)
        self.success: NDArray[np.bool_] = np.zeros(rows, np.bool_)
        self.terminated: NDArray[np.bool_] = np.zeros(rows, np.bool_)
        self.parts: tuple[dict[str, bool], ...] = ({},) * rows
        self.plan_ms: list[float] = []

    def scores(self, scenarios: Sequence[Scenario]) -> list[EpisodeScore]:
        """One score per row."""
        return [
            EpisodeScore(
                episode=scenario.episode,
                steps=int(self.steps[i]),
                reward=float(self.rewards[i]),
                success=bool(self.success[i]),
                terminated=bool(self.terminated[i]),
                parts=self.parts[i],
                skipped=int(self.skipped[i]),
                plan_ms=self.plan_ms[: int(self.steps[i])],
            )
            for i, scenario in enumerate(scenarios)
        ]


class Stage:
    """Where groups are played: this process, or worker processes that stay until it closes.

    Args:
        setup: what all groups share.
        num_workers: processes; 1 plays in this process, 0 takes one per processor core.
        artifact: what `load_policy` makes of the setup; spares this process loading it again.
        stopped: once it returns true, the episodes that are being played are given up.
    """

    def __init__(
        self,
        setup: Setup,
        num_workers: int = 0,
        artifact: Artifact | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._workers = num_workers or available_cores()
        self._player = Player(setup, artifact)
        self._setup = setup
        self._stopped = stopped
        self._executor: ProcessPoolExecutor | None = None

    def play(self, groups: Sequence[Group]) -> Iterator[tuple[int, list[EpisodeScore]]]:
        """Play ``groups``; yields (index of a group, its scores) as they finish.

        When it is stopped, it yields the scores of the episodes that have ended, and no more.

        Raises:
            EnvironmentFailure: a worker was killed.
        """
        if self._workers == 1:
            for i, group in enumerate(groups):
                if self._stopped():
                    return
                yield i, self._player.play(group, self._stopped)
            return
        try:
            yield from self._results(self._submit(groups))
        except BrokenProcessPool as error:
            raise EnvironmentFailure(
                "a worker process was killed (out of memory?); try fewer --num_workers"
            ) from error

    def _results(
        self, groups: dict[Future[list[EpisodeScore]], int]
    ) -> Iterator[tuple[int, list[EpisodeScore]]]:
        waiting = set(groups)
        while waiting:
            if self._stopped() and not self._stop.is_set():
                self._stop.set()
                waiting = {future for future in waiting if not future.cancel()}
            ended, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
            for future in ended:
                yield groups[future], future.result()

    def _submit(self, groups: Sequence[Group]) -> dict[Future[list[EpisodeScore]], int]:
        with inherited_by_workers():
            if self._executor is None:
                context = multiprocessing.get_context("spawn")
                self._stop = context.Event()
                self._executor = ProcessPoolExecutor(
                    self._workers, context, initializer=_start, initargs=(self._setup, self._stop)
                )
            executor = self._executor
            return {executor.submit(_work, group): i for i, group in enumerate(groups)}

    def close(self) -> None:
        """Stop what is being played and end the workers."""
        if self._executor is not None:
            self._stop.set()
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None


class _Worker:
    """The state of a worker process."""

    player: Player
    stop: Event


def _start(setup: Setup, stop: Event) -> None:
    torch.set_num_threads(1)
    _Worker.player, _Worker.stop = Player(setup), stop


def _work(group: Group) -> list[EpisodeScore]:
    """Runs in a worker."""
    return _Worker.player.play(group, _Worker.stop.is_set)
