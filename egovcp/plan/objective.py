"""What a plan is worth (equation 15), and who says so.

value     J = 1/N sum_{k<N} Q(h_{t+k}, z^_{t+k}, a_{t+k})                       the paper's
reward    J = sum_{k<N} gamma^k r(h_{t+k}, z^_{t+k}, a_{t+k})                   Rew-MPC
td        J = the same + gamma^N Q(h_{t+N}, z^_{t+N}, a_{t+N})                  TD-MPC

TD-MPC asks Q_N about what its policy would do, which is trained to say the best action; here there
is none, and Q_N is asked about one action more of the candidate's own walk, which the search looks
for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from egovcp.plan.choices import reward_model, step_of
from egovcp.plan.config import PlannerConfig

PlanValue = Callable[[Tensor, torch.Generator | None], Tensor]
"""J (E, M) of plans (E, M, N, 7); the generator is for the noise under ``latent=sample``."""


class PlanEvaluator[C](Protocol):
    """Says what plans from a state are worth; several may compute the same in different ways."""

    def at(self, carry: C) -> PlanValue:
        """What all plans from the robots' states (E, ...) share is computed here, once."""
        ...


class Dynamics[L](Protocol):
    """What is needed of a world model; leading dimensions broadcast (E robots, M plans)."""

    @property
    def min_return(self) -> Tensor:
        """The worst return of the data: what a failed plan is worth under rule ``shift``."""
        ...

    def expand_candidates(self, carry: L) -> L:
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


class ReferenceEvaluator[L](NamedTuple):
    """The evaluator that asks a world model about every step: slow, and right by definition."""

    model: Dynamics[L]
    config: PlannerConfig

    def at(self, carry: L) -> PlanValue:
        """See `PlanEvaluator`."""

        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            return evaluate(self.model, carry, actions, self.config, generator)

        return plan_value


class ReturnAccumulator:
    """J of plans, step by step: which head a step is asked for, and what it adds.

    A plan that has failed is worth the floor, or earns (1 - gamma) floor at each tick: for ever,
    that is the floor. So a failure at tick j is worth gamma^j floor, however many of the later
    ticks are looked at.

    Args:
        config: the objective, and the rule of what follows a failure.
        model: a `Dynamics`; under ``reward`` and ``td`` it must foresee rewards.
        steps: of a plan, `PlannerConfig.actions`.

    Raises:
        UsageError: the model does not know what is asked of it.
    """

    def __init__(self, config: PlannerConfig, model: Dynamics[Any], steps: int) -> None:
        self._config, self._steps = config, steps
        self._means = config.objective == "value"
        self._discount = 1.0 if self._means else reward_model(model).discount
        self._floor = 0.0 if config.termination_rule == "paper" else model.min_return
        self._weight: Tensor | float = 1.0
        self._share: Tensor | float = 1.0
        self._above: Tensor | float = 0.0
        self._below: Tensor | float = 0.0

    def asks_value(self, k: int) -> bool:
        """Whether step k is asked for Q, else for its reward."""
        at_the_end = self._config.objective == "td" and k == self._steps - 1
        return self._means or at_the_end

    def asks_risk(self, k: int) -> bool:
        """Whether it matters if step k is a failure: o_t was seen alive, and nothing follows the
        last step."""
        return 0 < k < self._steps - 1

    def value(self, q: Tensor) -> None:
        """The step is worth ``q``, or all that comes from it on."""
        self._add(q, self._floor)

    def reward(self, r: Tensor) -> None:
        """The step earns ``r``."""
        self._add(r, (1.0 - self._discount) * self._floor)
        self._weight = self._weight * self._discount

    def risk(self, dead: Tensor) -> None:
        """The state of the step is a failure with probability ``dead``."""
        if self._config.termination_rule == "survival":
            self._share = self._share * (1.0 - dead)
        else:
            self._share = self._share * (dead <= self._config.termination_threshold)

    def plan_value(self) -> Tensor:
        """J, (...)."""
        j = self._above + self._below
        if self._means:
            j = j / self._steps
        assert isinstance(j, Tensor)
        return j

    def _add(self, value: Tensor, floor: Tensor | float) -> None:
        self._above = self._above + self._weight * self._share * (value - floor)
        self._below = self._below + self._weight * floor


def evaluate[L](
    model: Dynamics[L],
    carry: L,
    actions: Tensor,
    config: PlannerConfig,
    generator: torch.Generator | None = None,
) -> Tensor:
    """J (E, M) of plans (E, M, A, 7) from the robots' carry (E, ...), A = `PlannerConfig.actions`.

    Args:
        generator: of the noise under ``latent=sample``; None: torch's own.

    Raises:
        UsageError: the model does not know what is asked of it.
    """
    accumulator = ReturnAccumulator(config, model, actions.shape[-2])
    states = _states(model, carry, actions, config, generator)
    for k, (state, action) in enumerate(zip(states, actions.unbind(-2), strict=True)):
        if accumulator.asks_value(k):
            accumulator.value(model.value(state, action))
        else:
            accumulator.reward(reward_model(model).reward(state, action))
        if accumulator.asks_risk(k):
            accumulator.risk(model.termination(state))
    return accumulator.plan_value()


def _states[L](
    model: Dynamics[L],
    carry: L,
    actions: Tensor,
    config: PlannerConfig,
    generator: torch.Generator | None,
) -> Iterator[L]:
    """At which each of the actions is taken: the robots' own, then the imagined ones."""
    imagine = step_of(model, model.imagine, config.latent, generator)
    carry = model.expand_candidates(carry)
    yield carry
    for action in actions.unbind(-2)[:-1]:
        carry = imagine(carry, action)
        yield carry
