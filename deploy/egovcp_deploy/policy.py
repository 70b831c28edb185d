"""What is asked of a policy that drives robots, and of one that can also show what it thinks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from egovcp.plan import PlannerConfig, Policy, PolicyStep

_BACKENDS: Final = {
    "ReferenceEvaluator": "eager",
    "FloatEvaluator": "float32",
    "Int8Evaluator": "int8",
}


class RolloutPolicy(Protocol):
    """Decides for E robots in step, from their observations alone.

    One that does not plan returns empty arrays, and nothing of them is logged.
    """

    def reset(self) -> None:
        """Forget the past: every robot has just begun an episode."""
        ...

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Depth (E, 48, 64) mm and state (E, 74) -> plans, within ``remaining`` s."""
        ...

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Take depth (E, 48, 64) mm and state (E, 74) in, in the place of `act`: no plan needed."""
        ...

    def advance(self, sent: NDArray[np.floating]) -> None:
        """The actions (E, 7) that were really sent."""
        ...


@runtime_checkable
class ImaginingPolicy(RolloutPolicy, Protocol):
    """A policy with a world model that can be looked into, between `act` and `advance`."""

    def reconstruct(self) -> NDArray[np.float32]:
        """(E, 48, 64) m: the present as the model holds it."""
        ...

    def imagine(self, plan: NDArray[np.floating], horizon: int) -> NDArray[np.float32]:
        """(E, horizon, 48, 64) m: what the plans (E, N, 7) lead to."""
        ...


@runtime_checkable
class Adjustable(RolloutPolicy, Protocol):
    """A policy that can be told to plan with more or less care."""

    config: PlannerConfig
    """What the next plan is made with; its horizon must stay."""


def backend_of(policy: RolloutPolicy) -> str:
    """Who computes the plans; ``auto`` chooses by machine, and plans differ a little between them.

    Empty: it does not plan.
    """
    if not isinstance(policy, Policy):
        return ""
    if policy.config.backend != "auto":
        return policy.config.backend
    evaluator = type(policy.prepare()).__name__
    return _BACKENDS.get(evaluator, evaluator)
