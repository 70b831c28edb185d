"""Conformance check of a task: repeatability, rewards, ends of episodes, cost."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.checks.environment import check_env
from egovcp.errors import ConformanceError

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.policies import EnvPolicy

CHECK_SEED: Final = 6_000_000_000  # scenarios of no collection and no evaluation
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
    """Simulation with depth image, ms per robot and planner step of 40 ms."""


def check_task(
    task: str, episodes: int = 2, seed: int = 0, config: EnvConfig | None = None
) -> TaskReport:
    """Play episodes of a task under hold, random actions and the oracle, and check every step.

    Seeds reproduce episodes bit for bit, also after other episodes and in another row. Rewards are
    finite, bounded by ``MAX_REWARD``, and the sum of their terms. Only a fall or the time limit
    ends an episode, success does not.

    Args:
        task: name of an installed task, or ``package.module:Class``.
        episodes: scenarios of each controller.
        seed: which ones.
        config: the environment; None: the defaults with an event in every episode.

    Raises:
        ConformanceError: names the task, the episode, the time and the problem.
        UsageError: the task is unknown.
        EnvironmentFailure: the task is defective: its scene does not compile, or a reward is NaN.
    """
    from egovcp.sim.config import evaluation_config
    from egovcp.sim.policies import Hold, Oracle, RandomWalk
    from egovcp.sim.robot_env import make_env
    from egovcp.sim.scenario import Scenario
    from egovcp.sim.tasks.registry import find_task, register_task

    name = register_task(task) if ":" in task else task
    kind = find_task(name)
    env = make_env(config or evaluation_config(), episodes, [name])
    scenarios = [Scenario(name, CHECK_SEED + seed, i) for i in range(episodes)]
    check_env(env, scenarios, _ENV_TICKS)
    first, started = _Run(env, RandomWalk(), scenarios), time.perf_counter()
    played = {"random": first.play()}
    ms = 1e3 * (time.perf_counter() - started) / max(1, first.steps)
    again = _Run(env, RandomWalk(), scenarios[::-1]).play()
    for a, b in zip(played["random"], again[::-1], strict=True):
        _require_equal(name, a, b)
    played["hold"] = _Run(env, Hold(), scenarios).play()
    if kind.has_oracle():
        played["oracle"] = _Run(env, Oracle(), scenarios).play()
    env.close()
    return TaskReport(
        task=name,
        success_rate={n: float(np.mean([e.success for e in each])) for n, each in played.items()},
        reward={
            n: {term: float(np.mean([e.terms[term].sum() for e in each])) for term in each[0].terms}
            for n, each in played.items()
        },
        ms_per_step=ms,
    )


@dataclass(frozen=True)
class _Episode:
    """What one robot did; T steps."""

    number: int
    arrays: dict[str, NDArray[Any]]  # (T, ...)
    terms: dict[str, NDArray[np.float64]]  # (T,) per reward term
    parameters: dict[str, float]
    success: bool


class _Run:
    """Plays one episode in every row, and checks each step."""

    def __init__(self, env: Any, policy: EnvPolicy, scenarios: Sequence[Any]) -> None:
        self._env, self._policy, self._scenarios = env, policy, scenarios
        self._task = scenarios[0].task
        self.steps = 0

    def play(self) -> list[_Episode]:
        """The episodes in the order of the scenarios."""
        env = self._env
        env.reset(self._scenarios)
        self._policy.reset(env, self._scenarios)
        rows: list[list[dict[str, Any]]] = [[] for _ in self._scenarios]
        success = [False] * len(rows)
        while not env.done.all():
            live = np.flatnonzero(~env.done).tolist()
            result = env.step(self._policy.act(env))
            objects = env.known_objects()
            self.steps += len(live)
            for row in live:
                self._check(row, result)
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
                success[row] = bool(result.success[row])
        return [
            _Episode(
                number=scenario.episode,
                arrays={n: np.array([step[n] for step in steps]) for n in steps[0]},
                terms={n: np.array([s[f"term {n}"] for s in steps]) for n in result.reward_terms},
                parameters=env.parameters[row],
                success=success[row],
            )
            for row, (scenario, steps) in enumerate(zip(self._scenarios, rows, strict=True))
        ]

    def _check(self, row: int, result: Any) -> None:
        from egovcp.sim.tasks.options import MAX_REWARD

        instance = self._env.instances[row]
        task = instance.task
        where = f"episode {self._scenarios[row].episode}, {task.time:.2f} s"
        for name, value in instance.parameters.items():
            _require(np.isfinite(value), self._task, where, f"its parameter {name} is {value}")
        for name, values in result.reward_terms.items():
            found = f"reward term {name} is {values[row]}, expected at most {MAX_REWARD} in size"
            _require(abs(values[row]) <= MAX_REWARD, self._task, where, found)
        total = sum(values[row] for values in result.reward_terms.values())
        differs = f"the reward is {result.reward[row]}, the sum of its terms {total}"
        _require(np.isclose(total, result.reward[row]), self._task, where, differs)
        if result.terminated[row]:
            upright = f"the episode ended although the robot stands (success: {task.achieved})"
            _require(_has_fallen(task), self._task, where, upright)
        if result.truncated[row] and type(task).for_training:  # a sequence ends after its last part
            early = f"the episode ended after {instance.tick} of {task.ticks_limit} ticks"
            _require(instance.tick == task.ticks_limit, self._task, where, early)
        place = task.state().position_w
        numbers = np.shape(place) == (3,) and (np.isfinite(place).all() or np.isnan(place).all())
        _require(numbers, self._task, where, f"the position of its object is {place}")


def _has_fallen(task: Any) -> bool:
    """Whether the robot of a task fell; of another robot than the G1 what its task says."""
    from egovcp.sim.tasks.base import Task

    return Task.has_fallen(task) if isinstance(task, Task) else bool(task.has_fallen())


def _require_equal(task: str, a: _Episode, b: _Episode) -> None:
    if a.parameters != b.parameters:
        raise ConformanceError(f"task {task}, episode {a.number}: a second run draws others")
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


def _require(ok: bool | np.bool_, task: str, where: str, problem: str) -> None:
    if not ok:
        raise ConformanceError(f"task {task}, {where}: {problem}")
