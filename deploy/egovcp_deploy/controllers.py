"""The controllers that are compared: the planner, and references that need no learning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.plan import PolicyStep, blank_observation
from egovcp.sim.env import Observation, VectorEnv
from egovcp.sim.policies import EnvPolicy as ReferencePolicy
from egovcp.sim.policies import Hold, Oracle, RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp_deploy.options import PLANNER
from egovcp_deploy.policy import RolloutPolicy
from egovcp_deploy.robots.sim import SimRobot

Array = NDArray[np.float64]

CONTROLLERS: Final = (PLANNER, "hold", "constant", "random", "oracle")
PPO: Final = "ppo"


class Controller(Protocol):
    """Decides for a batch of robots, one per scenario."""

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Every row has just begun an episode."""
        ...

    def act(self, env: VectorEnv, observation: Observation) -> NDArray[np.floating]:
        """(E, 7) planned actions; any value, safety comes after."""
        ...

    def advance(self, sent: Array) -> None:
        """(E, 7) what the robots were really sent."""
        ...


class Planned:
    """A policy that was learned; it sees the observation and nothing else."""

    def __init__(self, policy: RolloutPolicy) -> None:
        self._policy = policy
        self.skipped: NDArray[np.bool_] = np.zeros(0, np.bool_)
        """(E,) observations that the policy did not use in its last `act`; empty: unknown."""

    def warm_up(self, robots: int) -> None:
        """Act for nothing and forget it: the first calls compile, pack and allocate."""
        for _ in range(2):
            self._policy.act(*blank_observation(robots))
        self._policy.reset()

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Forget the past of every row."""
        self._policy.reset()

    def act(self, env: VectorEnv, observation: Observation) -> NDArray[np.floating]:
        """The first action of every row's plan."""
        step = self._policy.act(observation.depth, observation.state)
        self.skipped = step.skipped
        return step.action

    def advance(self, sent: Array) -> None:
        """Advance the recurrence with what was sent."""
        self._policy.advance(sent)


class Reference:
    """A policy of the simulator package."""

    def __init__(self, policy: ReferencePolicy) -> None:
        self._policy = policy

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Hand the scenarios on."""
        self._policy.reset(env, scenarios)

    def act(self, env: VectorEnv, observation: Observation) -> NDArray[np.floating]:
        """The reference's actions."""
        return self._policy.act(env)

    def advance(self, sent: Array) -> None:
        """References keep no state of what was sent."""


class Constants:
    """A fixed action for each row."""

    def __init__(self, actions: NDArray[np.floating]) -> None:
        self._actions = np.asarray(actions, np.float64)

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Nothing to forget."""

    def act(self, env: VectorEnv, observation: Observation) -> NDArray[np.floating]:
        """(E, 7) the same actions always."""
        return self._actions

    def advance(self, sent: Array) -> None:
        """Nothing to remember."""


def reference(name: str) -> Controller:
    """``hold``, ``random`` or ``oracle``."""
    policies: dict[str, type[ReferencePolicy]] = {
        "hold": Hold,
        "random": RandomWalk,
        "oracle": Oracle,
    }
    return Reference(policies[name]())


class Scripted:
    """A reference as the runner's policy for one simulated robot, whose truth it may see."""

    def __init__(self, controller: Controller, robot: SimRobot) -> None:
        self._controller = controller
        self._robot = robot

    def reset(self) -> None:
        """The robot has just begun an episode."""
        self._controller.reset(self._robot.env, [self._robot.scenario])

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """The reference's action, and no plan; it takes no time worth limiting."""
        action = self._controller.act(self._robot.env, Observation(depth, state))
        return PolicyStep(np.asarray(action, np.float32))

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """References keep no state of what they saw."""

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Hand on what was sent."""
        self._controller.advance(np.asarray(sent, np.float64))
