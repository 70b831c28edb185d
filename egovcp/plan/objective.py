"""What a plan is worth (equation 15), and who says so.

value     J = 1/N sum_{k<N} Q(h_{t+k}, z^_{t+k}, a_{t+k})                       the paper's
reward    J = sum_{k<N} gamma^k r(h_{t+k}, z^_{t+k}, a_{t+k})                   Rew-MPC
td        J = the same + gamma^N Q(h_{t+N}, z^_{t+N}, a_{t+N})                  TD-MPC
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from egovcp.plan.choices import earning, judge_of, step_of
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


class Survival:
    """How much of what comes next counts, under a rule of what follows a failure."""

    def __init__(self, config: PlannerConfig) -> None:
        self._config = config
        self.share: Tensor | float = 1.0

    def risk(self, dead: Tensor) -> None:
        """The state of the last step is a failure with probability ``dead``."""
        if self._config.termination_rule == "survival":
            self.share = self.share * (1.0 - dead)
        else:
            self.share = self.share * (dead <= self._config.termination_threshold)


class Tally(Survival):
    """The running sum of a plan's values, under a rule of what follows a failure."""

    def __init__(self, config: PlannerConfig, floor: Tensor) -> None:
        super().__init__(config)
        self._floor = 0.0 if config.termination_rule == "paper" else floor
        self._total: Tensor | float = 0.0

    def value(self, q: Tensor) -> None:
        """The next step is worth ``q``."""
        self._total = self._total + self.share * (q - self._floor)

    def mean(self, horizon: int) -> Tensor:
        """J."""
        j = self._total / horizon + self._floor
        assert isinstance(j, Tensor)
        return j


class Earnings(Survival):
    """The running return of a plan, discounted, under a rule of what follows a failure.

    A plan that has failed earns (1 - gamma) floor at each tick: for ever, that is the floor. So a
    failure at tick j is worth gamma^j floor, however many of the later ticks are looked at.
    """

    def __init__(self, config: PlannerConfig, floor: Tensor, discount: Tensor) -> None:
        super().__init__(config)
        self._floor = 0.0 if config.termination_rule == "paper" else floor
        self._discount = discount
        self._weight: Tensor | float = 1.0
        self._total: Tensor | float = 0.0

    def reward(self, r: Tensor) -> None:
        """The next step earns ``r``."""
        self._add(r, (1.0 - self._discount) * self._floor)
        self._weight = self._weight * self._discount

    def value(self, q: Tensor) -> None:
        """All that comes after the last reward is worth ``q``."""
        self._add(q, self._floor)

    def _add(self, worth: Tensor, floor: Tensor | float) -> None:
        self._total = self._total + self._weight * (self.share * (worth - floor) + floor)

    def total(self) -> Tensor:
        """J."""
        assert isinstance(self._total, Tensor)
        return self._total


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
    states = _states(model, carry, actions, config, generator)
    if config.objective == "value":
        return _mean_value(model, states, actions, config)
    return _discounted(model, states, actions, config)


def _mean_value[L](
    model: Dynamics[L], states: Iterator[L], actions: Tensor, config: PlannerConfig
) -> Tensor:
    """1/N sum_k Q_k."""
    judge = judge_of(model, model.value, config.ensemble)
    tally = Tally(config, model.return_floor)
    steps = actions.unbind(-2)
    for k, (state, action) in enumerate(zip(states, steps, strict=True)):
        tally.value(judge(state, action))
        if 0 < k < len(steps) - 1:  # o_t was seen alive; and nothing follows the last step
            tally.risk(model.termination(state))
    return tally.mean(len(steps))


def _discounted[L](
    model: Dynamics[L], states: Iterator[L], actions: Tensor, config: PlannerConfig
) -> Tensor:
    """sum_{k<N} gamma^k r_k, and under ``td`` gamma^N Q_N.

    Q_N is asked about one action more of the candidate's own walk. TD-MPC asks its policy, which
    is trained to say the best action; here there is none, and the search looks for it.
    """
    earner = earning(model)
    judge = judge_of(model, model.value, config.ensemble)
    earnings = Earnings(config, model.return_floor, earner.discount)
    steps = actions.unbind(-2)
    last = len(steps) - 1
    for k, (state, action) in enumerate(zip(states, steps, strict=True)):
        if k == last and config.objective == "td":
            earnings.value(judge(state, action))
        else:
            earnings.reward(earner.reward(state, action))
        if 0 < k < last:
            earnings.risk(model.termination(state))
    return earnings.total()


def _states[L](
    model: Dynamics[L],
    carry: L,
    actions: Tensor,
    config: PlannerConfig,
    generator: torch.Generator | None,
) -> Iterator[L]:
    """At which each of the actions is taken: the robots' own, then the imagined ones."""
    imagine = step_of(model, model.imagine, config.latent, generator)
    carry = model.spread(carry)
    yield carry
    for action in actions.unbind(-2)[:-1]:
        carry = imagine(carry, action)
        yield carry
