"""What a plan is worth (equation 15), and who says so.

J = 1/N sum_k Q(h_{t+k}, z^_{t+k}, a_{t+k})
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from egovcp.plan.choices import judge_of, step_of
from egovcp.plan.config import PlannerConfig

Worth = Callable[[Tensor, torch.Generator | None], Tensor]
"""J (E, M) of plans (E, M, N, 7); the generator is for the noise under ``latent=sample``."""


class Judge[C](Protocol):
    """Says what plans from a state are worth; several may compute the same in different ways."""

    def at(self, carry: C) -> Worth:
        """What all plans from the robots' states (E, ...) share is computed here, once."""
        ...


class Dynamics[L](Protocol):
    """What is needed of a world model; leading dimensions broadcast (E robots, M plans)."""

    @property
    def return_floor(self) -> Tensor:
        """The worst return of the data: what a failed plan is worth under rule ``shift``."""
        ...

    def spread(self, carry: L) -> L:
        """(E, ...) -> (E, 1, ...): one state that all candidates of a robot share."""
        ...

    def imagine(self, carry: L, action: Tensor) -> L:
        """Advance by one tick under action (E, M, 7)."""
        ...

    def value(self, carry: L, action: Tensor) -> Tensor:
        """Q, (E, M)."""
        ...

    def termination(self, carry: L) -> Tensor:
        """Probability that this state is a failure, (E, M)."""
        ...


class StepByStep[L](NamedTuple):
    """The judge that asks a world model about every step: slow, and right by definition."""

    model: Dynamics[L]
    config: PlannerConfig

    def at(self, carry: L) -> Worth:
        """See `Judge`."""

        def worth(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            return evaluate(self.model, carry, actions, self.config, generator)

        return worth


class Tally:
    """The running sum of a plan's values, under a rule of what follows a failure."""

    def __init__(self, config: PlannerConfig, floor: Tensor) -> None:
        self._config = config
        self._floor = 0.0 if config.termination_rule == "paper" else floor
        self._total: Tensor | float = 0.0
        self._alive: Tensor | float = 1.0

    def value(self, q: Tensor) -> None:
        """The next step is worth ``q``."""
        self._total = self._total + self._alive * (q - self._floor)

    def risk(self, dead: Tensor) -> None:
        """The state of the last step is a failure with probability ``dead``."""
        if self._config.termination_rule == "survival":
            self._alive = self._alive * (1.0 - dead)
        else:
            self._alive = self._alive * (dead <= self._config.termination_threshold)

    def mean(self, horizon: int) -> Tensor:
        """J."""
        j = self._total / horizon + self._floor
        assert isinstance(j, Tensor)
        return j


def evaluate[L](
    model: Dynamics[L],
    carry: L,
    actions: Tensor,
    config: PlannerConfig,
    generator: torch.Generator | None = None,
) -> Tensor:
    """J (E, M) of plans (E, M, N, 7) from the robots' carry (E, ...).

    Args:
        generator: of the noise under ``latent=sample``; None: torch's own.
    """
    imagine = step_of(model, model.imagine, config.latent, generator)
    judge = judge_of(model, model.value, config.ensemble)
    horizon = actions.shape[-2]
    tally = Tally(config, model.return_floor)
    carry = model.spread(carry)
    for k in range(horizon):
        if k > 0:
            carry = imagine(carry, actions[..., k - 1, :])
        tally.value(judge(carry, actions[..., k, :]))
        if 0 < k < horizon - 1:  # o_t was seen alive; and nothing follows the last step
            tally.risk(model.termination(carry))
    return tally.mean(horizon)
