"""Plays groups of episodes side by side, in this process or in worker processes."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.errors import EnvironmentFailure
from egovcp.files import user_path
from egovcp.hardware import available_cores
from egovcp.log.rollout_video import AHEAD, RolloutVideoSink
from egovcp.log.tick import RunInfo, Sink, Tick
from egovcp.plan import Policy, PolicyStep, blank_observation
from egovcp.policy_options import PolicyOptions, load_policy
from egovcp.rate import NS_PER_S
from egovcp.reactive import ReactiveNetwork, ReactivePolicy
from egovcp.sim.base_env import BaseVectorEnv, Observation
from egovcp.sim.robot_env import make_env
from egovcp.sim.scenario import Scenario
from egovcp.workers import inherited_by_workers
from egovcp_deploy.controllers import PPO, ReferencePolicy, reference
from egovcp_deploy.options import PLANNER, video_paths
from egovcp_deploy.pilot.pilot import SafetyFilter
from egovcp_deploy.pilot.planner import RolloutPolicy
from egovcp_deploy.robots.sim import true_poses
from egovcp_deploy.scores import EpisodeScore

if TYPE_CHECKING:
    from egovcp_deploy.evaluate import EvalConfig

_POLL_S: Final = 0.2


@dataclass(frozen=True)
class EpisodeGroup:
    """Scenarios of one task, played side by side by one controller."""

    controller: str
    scenarios: tuple[Scenario, ...]
    action: tuple[float, ...] = ()  # of the controller `constant`
    videos: tuple[Path, ...] = ()  # of the first scenarios, without suffix


class EpisodePlayer:
    """Plays groups in this process, until ``stopped()`` turns true; groups of equal size share
    environment and policy."""

    def __init__(
        self, config: EvalConfig, artifact: Artifact | None, stopped: Callable[[], bool]
    ) -> None:
        self._config, self._artifact, self._stopped = config, artifact, stopped
        self._envs: dict[int, BaseVectorEnv] = {}
        self._policies: dict[tuple[str, int], RolloutPolicy] = {}

    def play(self, group: EpisodeGroup) -> list[EpisodeScore]:
        """Scores in the order of the group's scenarios; see `play_group`."""
        if self._stopped():
            return []
        size, task = len(group.scenarios), group.scenarios[0].task
        if size not in self._envs:
            self._envs[size] = make_env(self._config.env, size, [task])
        env = self._envs[size]
        policy = self._policy(group, env)
        return play_group(env, policy, group.scenarios, self._stopped, group.videos)

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()

    def _policy(self, group: EpisodeGroup, env: BaseVectorEnv) -> RolloutPolicy:
        config, robots = self._config, env.num_envs
        if group.controller not in (PPO, PLANNER):
            scripted = reference(group.controller, group.action)
            return ReferencePolicy(scripted, env, lambda: group.scenarios)
        key = group.controller, robots
        if key not in self._policies:
            learned: RolloutPolicy
            if group.controller == PPO:
                network = ReactiveNetwork.load(user_path(config.ppo.path))
                learned = ReactivePolicy(network, robots)
            else:
                self._artifact = self._artifact or load_policy(config.policy, config.planner)
                learned = self._artifact.make_policy(robots, config.seed)
            for _ in range(2):  # the first calls compile and allocate, and must not be timed
                learned.act(*blank_observation(robots, env.robot))
            self._policies[key] = learned
        return self._policies[key]


def play_group(
    env: BaseVectorEnv,
    policy: RolloutPolicy,
    scenarios: Sequence[Scenario],
    stopped: Callable[[], bool],
    videos: Sequence[Path],
) -> list[EpisodeScore]:
    """Play one episode on each instance of ``env``; returns the scores of the episodes that ended.

    If ``stopped()`` becomes true, these are not all, and no video is written. ``videos`` are the
    paths, without suffix, for the first instances.
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
    terms: dict[str, NDArray[np.float64]] = {}
    sinks = [RolloutVideoSink(*video_paths(stem)) for stem in videos]
    for sink in sinks:
        sink.open(RunInfo("", robot=env.robot))
    while not env.done.all() and not stopped():
        live = ~env.done
        begin = time.perf_counter()
        step = policy.act(observation.depth, observation.state)
        plan_ms.append((time.perf_counter() - begin) * 1e3 / num_envs)
        if step.skipped.size:
            skipped += live & step.skipped
        sent = safety.filter(step.action)
        if live[: len(sinks)].any():
            _log_tick(sinks, len(plan_ms) - 1, env, observation, policy, step, sent)
        result = env.step(sent)
        policy.advance(result.sent_action)
        rewards += np.where(live, result.reward, 0.0)
        for name, values in result.reward_terms.items():
            terms[name] = terms.get(name, 0.0) + np.where(live, values, 0.0)
        steps += live
        success, terminated, parts = result.success, result.terminated, result.parts
        observation = result.observation
    if env.done.all():
        for sink in sinks:
            sink.close()
    return [
        EpisodeScore(
            episode=scenario.episode,
            steps=int(steps[i]),
            reward=float(rewards[i]),
            success=bool(success[i]),
            terminated=bool(terminated[i]),
            parts=parts[i],
            terms={name: float(values[i]) for name, values in terms.items()},
            skipped=int(skipped[i]),
            plan_ms=plan_ms[: int(steps[i])],
        )
        for i, scenario in enumerate(scenarios)
        if env.done[i]
    ]


def _log_tick(
    sinks: Sequence[Sink],
    index: int,
    env: BaseVectorEnv,
    observation: Observation,
    policy: RolloutPolicy,
    step: PolicyStep,
    sent: NDArray[np.floating],
) -> None:
    """Add tick ``index`` of the first instances, with what the model imagines, to their ``sinks``;
    call it before ``env`` advances."""
    imagined = policy.imagine(step.plan, AHEAD) if isinstance(policy, Policy) else None
    for i, sink in enumerate(sinks):
        if env.done[i]:
            continue
        base, scene = true_poses(env, i)
        sink.write(
            Tick(
                index=index,
                time_ns=index * NS_PER_S // env.robot.planner_hz,
                depth=observation.depth[i].copy(),
                state=observation.state[i].copy(),
                action_planned=step.action[i],
                action_sent=sent[i],
                base=base,
                scene=scene,
                depth_imagined=None if imagined is None else imagined[i],
            )
        )


class EpisodePool:
    """Plays groups in worker processes, which last until `close`; each loads the policy from the
    folder of ``artifact``, so that all have the same version.

    With one worker it plays in this process, with ``artifact``. After ``stopped()`` turns true,
    unfinished episodes are abandoned.
    """

    def __init__(
        self,
        config: EvalConfig,
        artifact: Artifact | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._workers = config.num_workers or available_cores()
        self._player = EpisodePlayer(config, artifact, stopped)
        self._stopped = stopped
        context = multiprocessing.get_context("spawn")
        self._stop = context.Event()
        if artifact is not None:
            config = replace(config, policy=PolicyOptions(str(artifact.path.absolute())))
        self._executor = ProcessPoolExecutor(  # starts no process before the first `submit`
            self._workers, context, initializer=_start, initargs=(config, self._stop)
        )

    def play(self, groups: Sequence[EpisodeGroup]) -> Iterator[tuple[int, list[EpisodeScore]]]:
        """Play ``groups``; yields (index of a group, its scores) as they finish. When stopped, it
        yields the scores of the complete episodes. Raises `EnvironmentFailure` if a worker was
        killed."""
        if self._workers == 1:
            for i, group in enumerate(groups):
                yield i, self._player.play(group)
            return
        try:
            with inherited_by_workers():
                index = {
                    self._executor.submit(_play_in_worker, group): i
                    for i, group in enumerate(groups)
                }
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

    def close(self) -> None:
        """Abandon episodes in progress, end the workers and close the environments."""
        self._stop.set()
        self._executor.shutdown(wait=True, cancel_futures=True)
        self._player.close()


_player: EpisodePlayer  # of a worker process


def _start(config: EvalConfig, stop: Event) -> None:
    global _player
    torch.set_num_threads(1)
    _player = EpisodePlayer(config, None, stop.is_set)


def _play_in_worker(group: EpisodeGroup) -> list[EpisodeScore]:
    return _player.play(group)
