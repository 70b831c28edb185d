"""Interfaces of policies that drive robots, and what the log shows of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.log.tick import Hand, ValueMap
from egovcp.plan import Policy, PolicyStep, hand_grid, value_map
from egovcp.plan.objective import Dynamics
from egovcp.plan.value_map import HAND_AXES
from egovcp.spec import ACTION_BOX

_HANDS: Final[tuple[Hand, ...]] = ("left", "right")
_BACKENDS: Final = {
    "ReferenceEvaluator": "eager",
    "FloatEvaluator": "float32",
    "Int8Evaluator": "int8",
}


class RolloutPolicy(Protocol):
    """Decides for E robots in step, from their observations."""

    def reset(self) -> None:
        """Every robot has just begun an episode."""
        ...

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Depth (E, 48, 64) mm and state (E, 74) -> plans, within ``remaining()`` s. Arrays that
        the policy does not compute are empty."""
        ...

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Filter depth (E, 48, 64) mm and state (E, 74) without planning."""
        ...

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Advance by a tick with the actions (E, 7) that were sent."""
        ...


@runtime_checkable
class ImaginingPolicy(RolloutPolicy, Protocol):
    """A policy with a world model to decode, between `act` and `advance`."""

    def reconstruct(self) -> NDArray[np.float32]:
        """(E, 48, 64) m: depth decoded from the posterior."""
        ...

    def imagine(self, plan: NDArray[np.floating], horizon: int) -> NDArray[np.float32]:
        """(E, horizon, 48, 64) m: depth predicted along the plans (E, N, 7)."""
        ...


def backend_of(policy: RolloutPolicy) -> str:
    """Name of the backend that computes the plans, with ``auto`` resolved; empty: no planner."""
    if not isinstance(policy, Policy):
        return ""
    if policy.config.backend != "auto":
        return policy.config.backend
    evaluator = type(policy.prepare()).__name__
    return _BACKENDS.get(evaluator, evaluator)


def value_maps[L](
    model: Dynamics[L], carry: L, action: NDArray[np.floating]
) -> tuple[ValueMap, ...]:
    """Q of the planned ``action`` (7,) with each hand moved over its box, for one robot whose
    filtered state is ``carry`` (1, ...)."""
    planned = torch.as_tensor(action, dtype=torch.float32, device=model.min_return.device)
    target = ACTION_BOX.to_metric(np.asarray(action))
    maps = []
    for hand in _HANDS:
        grid = hand_grid(hand)
        values = value_map(model, carry, planned[None], hand, grid)[0].float().cpu().numpy()
        y = float(np.float32(target[HAND_AXES[hand][1]]))
        maps.append(ValueMap(hand, grid.x, y, grid.z, values))
    return tuple(maps)
