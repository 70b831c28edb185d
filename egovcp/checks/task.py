"""Conformance check of a task: repeatability, rewards, ends of episodes, cost."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.checks.environment import check_env
from egovcp.checks.robot import check_robot
from egovcp.errors import ConformanceError

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.policies import EnvPolicy

_ENV_TICKS: Final = 10


@dataclass(frozen=True)
class TaskReport:
    """What `check_task` measured."""

    task: str
    success_rate: dict[str, float]
    """Controller (hold, random, oracle) -> share of the episodes."""
    reward: dict[str, dict[str, float]]
    """Controller -> reward term -> mean sum per episode."""
    ms_per_step: float
    """Wall-clock time per robot and planner step, with depth image and checks, ms."""


def check_task(
    task: str, episodes: int = 2, seed: int = 0, config: EnvConfig | None = None
) -> TaskReport:
    """Play episodes of a task under hold, random actions and the oracle, and check every step.

    Seeds must reproduce episodes bit for bit, also after other episodes and in another row. States
    and rewards must be finite, and reward terms at most ``MAX_REWARD`` in size. An episode ends by
    a fall or the time limit, never by success. `check_env` checks the first 10 ticks only. A robot
    other than the G1 is checked by `check_robot`.

    Args:
        task: name of an installed task, or ``package.module:Class``.
        episodes: scenarios of each controller.
        seed: from 0, selects the scenarios.
        config: the environment; None: the defaults with an event in every episode.

    Raises:
        ConformanceError: names the task, the episode, the time and the problem.
        UsageError: the task is unknown.
        EnvironmentFailure: the task is defective: its scene does not compile, or a reward is NaN.
    """
    from egovcp.sim.config import evaluation_config
    from egovcp.sim.policies import Hold, Oracle, RandomWalk
    from egovcp.sim.robot_env import make_env
    from egovcp.sim.scenario import CHECK_SEED, Scenario
    from egovcp.sim.tasks.registry import find_task, register_task
    from egovcp.sim.tasks.robot_task import RobotTask

    name = register_task(task) if ":" in task else task
    kind = find_task(name)
    if issubclass(kind, RobotTask):
        check_robot(kind.robot_class)
    scenarios = [Scenario(name, CHECK_SEED + seed, i) for i in range(episodes)]
    with closing(make_env(config or evaluation_config(), episodes, [name])) as env:
        try:
            check_env(env, scenarios, _ENV_TICKS)
        except ConformanceError as error:
            raise ConformanceError(f"task {name}: {error}") from error
        started = time.perf_counter()
        played = {"random": _play(env, RandomWalk(), scenarios)}
        steps = sum(len(episode.arrays["reward"]) for episode in played["random"])
        ms = 1e3 * (time.perf_counter() - started) / steps
        again = _play(env, RandomWalk(), scenarios[::-1])
        for a, b in zip(played["random"], again[::-1], strict=True):
            _require_equal(name, a, b)
        played["hold"] = _play(env, Hold(), scenarios)
        if kind.has_oracle():
            played["oracle"] = _play(env, Oracle(), scenarios)
        terms = env.instances[0].task.reward_terms
    arrays = {n: [episode.arrays for episode in each] for n, each in played.items()}
    return TaskReport(
        task=name,
        success_rate={
            n: float(np.mean([a["success"][-1] for a in each])) for n, each in arrays.items()
        },
        reward={
            n: {term: float(np.mean([a[f"term {term}"].sum() for a in each])) for term in terms}
            for n, each in arrays.items()
        },
        ms_per_step=ms,
    )


@dataclass(frozen=True)
class _Episode:
    """What one robot did; T steps."""

    number: int
    arrays: dict[str, NDArray[Any]]  # (T, ...)
    parameters: dict[str, float]


def _play(env: Any, policy: EnvPolicy, scenarios: Sequence[Any]) -> list[_Episode]:
    """Play one episode in every row, check each step, and return the episodes in order."""
    env.reset(scenarios)
    policy.reset(env, scenarios)
    rows: list[list[dict[str, Any]]] = [[] for _ in scenarios]
    while not env.done.all():
        live = np.flatnonzero(~env.done).tolist()
        result = env.step(policy.act(env))
        objects = env.known_objects()
        for row in live:
            _check(env.instances[row], row, result)
            rows[row].append(
                {
                    "depth": result.observation.depth[row].copy(),
                    "state": result.observation.state[row].copy(),
                    "reward": result.reward[row],
                    "success": result.success[row],
                    "object": objects[row],
                    **{f"term {n}": v[row] for n, v in result.reward_terms.items()},
                }
            )
    return [
        _Episode(
            number=scenario.episode,
            arrays={n: np.array([step[n] for step in steps]) for n in steps[0]},
            parameters=env.parameters[row],
        )
        for row, (scenario, steps) in enumerate(zip(scenarios, rows, strict=True))
    ]


def _check(instance: Any, row: int, result: Any) -> None:
    """Raise `ConformanceError` if the step of an instance, a row of ``result``, is wrong."""
    from egovcp.sim.tasks.options import MAX_REWARD

    scenario, task = instance.scenario, instance.task

    def require(ok: bool | np.bool_, problem: str) -> None:
        if not ok:
            raise ConformanceError(
                f"task {scenario.task}, episode {scenario.episode}, {task.time:.2f} s: {problem}"
            )

    require(np.isfinite(result.observation.state[row]).all(), "its state is not finite")
    for name, value in instance.parameters.items():
        require(np.isfinite(value), f"its parameter {name} is {value}")
    for name, values in result.reward_terms.items():
        message = f"reward term {name} is {values[row]}, expected at most {MAX_REWARD} in size"
        require(abs(values[row]) <= MAX_REWARD, message)
    if result.terminated[row]:
        message = f"the episode ended although the robot stands (success: {task.achieved})"
        require(_has_fallen(task), message)
    if result.truncated[row] and type(task).for_training:  # a sequence ends after its last part
        message = f"the episode ended after {instance.tick} of {task.ticks_limit} ticks"
        require(instance.tick == task.ticks_limit, message)
    place = task.object_w
    numbers = np.shape(place) == (3,) and (np.isfinite(place).all() or np.isnan(place).all())
    require(numbers, f"the position of its object is {place}")


def _has_fallen(task: Any) -> bool:
    """Whether the robot fell: for the G1 by `Task.has_fallen` even if the task overrides it, else
    by the task's own `has_fallen`."""
    from egovcp.sim.tasks.base import Task

    return Task.has_fallen(task) if isinstance(task, Task) else bool(task.has_fallen())


def _require_equal(task: str, a: _Episode, b: _Episode) -> None:
    if a.parameters != b.parameters:
        raise ConformanceError(
            f"task {task}, episode {a.number}: its parameters differ in a second run; draw them "
            "with sample and scenario.rng"
        )
    for name, values in a.arrays.items():
        other = b.arrays[name]
        same = len(values) == len(other) and np.array_equal(values, other)
        if not same:
            n = min(len(values), len(other))
            differs = (values[:n] != other[:n]).reshape(n, -1).any(axis=1)
            at = int(np.argmax(differs)) if differs.any() else n
            raise ConformanceError(
                f"task {task}, episode {a.number}, tick {at + 1}: {name} differs "
                "in a second run with the same actions; use scenario.rng and reset what __init__ "
                "and place set"
            )
