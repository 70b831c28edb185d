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
from egovcp.plan import blank_observation
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp.reactive import ReactiveNetwork, ReactivePolicy
from egovcp.sim.base_env import BaseVectorEnv
from egovcp.sim.config import EnvConfig
from egovcp.sim.robot_env import make_env
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers
from egovcp_deploy.controllers import PPO, ReferencePolicy, reference
from egovcp_deploy.options import PLANNER
from egovcp_deploy.pilot.pilot import SafetyFilter
from egovcp_deploy.pilot.planner import RolloutPolicy
from egovcp_deploy.scores import EpisodeScore
from egovcp_deploy.videos import VideoRecorder

_POLL_S: Final = 0.2


@dataclass(frozen=True)
class EpisodeSetup:
    """Options that all groups share; sent to each worker once."""

    env: EnvConfig
    policy: PolicyOptions = field(default_factory=PolicyOptions)  # of the controller `planner`
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    seed: int = 0
    ppo: str = ""  # file of the controller `ppo`


@dataclass(frozen=True)
class EpisodeGroup:
    """Scenarios of one task, played side by side by one controller."""

    controller: str
    scenarios: tuple[Scenario, ...]
    action: tuple[float, ...] = ()  # of the controller `constant`
    videos: tuple[Path, ...] = ()  # of the first scenarios, without suffix


class EpisodePlayer:
    """Plays groups in this process; groups of equal size share environment and policy."""

    def __init__(self, setup: EpisodeSetup, artifact: Artifact | None = None) -> None:
        self._setup = setup
        self._artifact = artifact
        self._envs: dict[int, BaseVectorEnv] = {}
        self._policies: dict[tuple[str, int], RolloutPolicy] = {}

    def play(
        self, group: EpisodeGroup, stopped: Callable[[], bool] = lambda: False
    ) -> list[EpisodeScore]:
        """Scores in the order of the group's scenarios; see `play`."""
        if stopped():
            return []
        size, task = len(group.scenarios), group.scenarios[0].task
        if size not in self._envs:
            self._envs[size] = make_env(self._setup.env, size, [task])
        env = self._envs[size]
        recorder = VideoRecorder(group.videos)
        return play(env, self._policy(group, env), group.scenarios, stopped, recorder)

    def _policy(self, group: EpisodeGroup, env: BaseVectorEnv) -> RolloutPolicy:
        if group.controller not in (PPO, PLANNER):
            policy = reference(group.controller, group.action)
            return ReferencePolicy(policy, env, lambda: group.scenarios)
        key = group.controller, env.num_envs
        if key not in self._policies:
            learned = self._policies[key] = self._learned(*key)
            for _ in range(2):  # the first calls compile and allocate, and must not be timed
                learned.act(*blank_observation(env.num_envs, env.robot))
        return self._policies[key]

    def _learned(self, controller: str, robots: int) -> RolloutPolicy:
        setup = self._setup
        if controller == PPO:
            return ReactivePolicy(ReactiveNetwork.load(Path(setup.ppo)), robots)
        if self._artifact is None:
            self._artifact = load_policy(setup.policy, setup.planner)
        return self._artifact.make_policy(robots, setup.seed)


def play(
    env: BaseVectorEnv,
    policy: RolloutPolicy,
    scenarios: Sequence[Scenario],
    stopped: Callable[[], bool] = lambda: False,
    recorder: VideoRecorder | None = None,
) -> list[EpisodeScore]:
    """Play one episode on each instance of ``env``; returns the scores of the episodes that ended.

    Unless ``stopped()`` becomes true, these are all, and ``recorder`` draws its videos.
    """
    observation = env.reset(scenarios)
    policy.reset()
    num_envs = env.num_envs
    safety = SafetyFilter(num_envs, env.robot.action_dim)
    rewards, plan_ms = np.zeros(num_envs), list[float]()
    steps, skipped = np.zeros(num_envs, np.int64), np.zeros(num_envs, np.int64)
    success: NDArray[np.bool_] = np.zeros(num_envs, np.bool_)
    terminated: NDArray[np.bool_] = np.zeros(num_envs, np.bool_)
    parts: tuple[dict[str, bool], ...] = ({},) * num_envs
    while not env.done.all() and not stopped():
        live = ~env.done
        begin = time.perf_counter()
        step = policy.act(observation.depth, observation.state)
        plan_ms.append((time.perf_counter() - begin) * 1e3 / num_envs)
        if step.skipped.size:
            skipped += live & step.skipped
        if recorder is not None:
            recorder.add(env, observation, policy, step)
        result = env.step(safety.filter(step.action))
        policy.advance(result.sent_action)
        rewards += np.where(live, result.reward, 0.0)
        steps += live
        success, terminated, parts = result.success, result.terminated, result.parts
        observation = result.observation
    if recorder is not None and env.done.all():
        recorder.write()
    return [
        EpisodeScore(
            episode=scenario.episode,
            steps=int(steps[i]),
            reward=float(rewards[i]),
            success=bool(success[i]),
            terminated=bool(terminated[i]),
            parts=parts[i],
            skipped=int(skipped[i]),
            plan_ms=plan_ms[: int(steps[i])],
        )
        for i, scenario in enumerate(scenarios)
        if env.done[i]
    ]


class EpisodePool:
    """Plays groups in worker processes that last until `close`. ``num_workers`` 1 plays in this
    process, with ``artifact`` if it is loaded already; 0 starts one worker per processor core. Once
    ``stopped()`` is true, episodes in progress are abandoned."""

    def __init__(
        self,
        setup: EpisodeSetup,
        num_workers: int = 0,
        artifact: Artifact | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._workers = num_workers or available_cores()
        self._player = EpisodePlayer(setup, artifact)
        self._setup = setup
        self._stopped = stopped
        self._executor: ProcessPoolExecutor | None = None

    def play(self, groups: Sequence[EpisodeGroup]) -> Iterator[tuple[int, list[EpisodeScore]]]:
        """Play ``groups``; yields (index of a group, its scores) as they finish. When stopped, it
        yields the scores of the complete episodes. Raises `EnvironmentFailure` if a worker was
        killed."""
        if self._workers == 1:
            for i, group in enumerate(groups):
                if self._stopped():
                    return
                yield i, self._player.play(group, self._stopped)
            return
        try:
            index = self._submit(groups)
            waiting = set(index)
            while waiting:
                if self._stopped() and not self._stop.is_set():
                    self._stop.set()
                    waiting = {future for future in waiting if not future.cancel()}
                ended, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for future in ended:
                    yield index[future], future.result()
        except BrokenProcessPool as error:
            raise EnvironmentFailure(
                "a worker process was killed (out of memory?); try fewer --num_workers"
            ) from error

    def _submit(self, groups: Sequence[EpisodeGroup]) -> dict[Future[list[EpisodeScore]], int]:
        with inherited_by_workers():
            if self._executor is None:
                context = multiprocessing.get_context("spawn")
                self._stop = context.Event()
                self._executor = ProcessPoolExecutor(
                    self._workers, context, initializer=_start, initargs=(self._setup, self._stop)
                )
            executor = self._executor
            return {executor.submit(_play, group): i for i, group in enumerate(groups)}

    def close(self) -> None:
        """Abandon episodes in progress and end the workers."""
        if self._executor is not None:
            self._stop.set()
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None


class _Worker:  # the state of a worker process
    player: EpisodePlayer
    stop: Event


def _start(setup: EpisodeSetup, stop: Event) -> None:
    torch.set_num_threads(1)
    _Worker.player, _Worker.stop = EpisodePlayer(setup), stop


def _play(group: EpisodeGroup) -> list[EpisodeScore]:
    return _Worker.player.play(group, _Worker.stop.is_set)
