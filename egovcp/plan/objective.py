"""Values V of plans (equation 15), and their reference evaluation with a world model.

value     V = 1/N sum_{k<N} Q(h_{t+k}, z^_{t+k}, a_{t+k})                       the paper's
reward    V = sum_{k<N} gamma^k r(h_{t+k}, z^_{t+k}, a_{t+k})                   Rew-MPC
td        V = the same + gamma^N Q(h_{t+N}, z^_{t+N}, a_{t+N})                  TD-MPC

TD-MPC evaluates Q_N at the action of a trained policy. There is none here, so the candidate has one
more action, which the search optimises.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from egovcp.model import Carry
from egovcp.plan.config import PlannerConfig
from egovcp.robot_spec import RobotSpec

PlanValue = Callable[[Tensor, torch.Generator | None], Tensor]
"""V (E, M) of plans (E, M, P, 7), P = `PlannerConfig.actions`; the generator samples the noise
under ``latent=sample``."""


class PlanEvaluator[C](Protocol):
    """Evaluates plans from a state; all implementations compute the same up to rounding."""

    @property
    def backend(self) -> str:
        """The value of `PlannerConfig.backend` that names it."""
        ...

    def at(self, carry: C) -> PlanValue:
        """The evaluation of plans from the robots' states (E, ...)."""
        ...


class Dynamics[L](Protocol):
    """The part of a world model that planning uses; leading dimensions (E, M) broadcast.

    The objectives with rewards also need its ``reward``, latent=sample its ``imagine_sample``.
    """

    @property
    def discount(self) -> Tensor:
        """Discount per step of Q."""
        ...

    @property
    def min_return(self) -> Tensor:
        """The 0.1 % quantile of the returns of the data, the value of a failed plan under the rules
        ``shift`` and ``survival``."""
        ...

    def expand_candidates(self, carry: L) -> L:
        """(E, ...) -> (E, 1, ...): one state that all candidates of a robot share."""
        ...

    def imagine(self, carry: L, action: Tensor) -> L:
        """Advance by one step under action (E, M, 7)."""
        ...

    def value(self, carry: L, action: Tensor) -> Tensor:
        """Q, (E, M)."""
        ...

    def termination(self, carry: L) -> Tensor:
        """Probability that this state is a failure, (E, M)."""
        ...


@dataclass(frozen=True)
class ReferenceEvaluator[L]:
    """Evaluates plans with the world model step by step: slow, the reference of all backends."""

    model: Dynamics[L]
    config: PlannerConfig
    backend = "eager"

    def at(self, carry: L) -> PlanValue:
        """See `PlanEvaluator`."""

        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            return evaluate(self.model, carry, actions, self.config, generator)

        return plan_value


def mirrored_actions(actions: Tensor, robot: RobotSpec) -> Tensor:
    """Reflected normalised actions (..., 7) of a symmetric robot."""
    assert robot.mirror is not None, "the robot is not symmetric"
    sign = torch.tensor(robot.mirror.action_sign, device=actions.device)
    return actions[..., list(robot.mirror.action_source)] * sign


class MirroredEvaluator(NamedTuple):
    """V of a plan, averaged with that of its mirror image in the mirrored scene.

    The true values are equal, and the errors of Q partly independent, so the mean has less error.
    States are (2 E, ...): those of E robots, then of the same robots as seen in a mirror.
    """

    evaluator: PlanEvaluator[Carry]
    robot: RobotSpec

    @property
    def backend(self) -> str:
        """See `PlanEvaluator`."""
        return self.evaluator.backend

    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`; plans are those of the E robots."""
        value_of_both = self.evaluator.at(carry)

        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            both = torch.cat([actions, mirrored_actions(actions, self.robot)])
            return value_of_both(both, generator).view(2, len(actions), -1).mean(0)

        return plan_value


class ReturnAccumulator:
    """Accumulates V of plans step by step, and selects the head that each step needs.

    A failed plan has the value ``floor``, or the reward (1 - gamma) floor at each step, whose
    endless discounted sum is the floor. So under ``td`` a failure at step j contributes
    gamma^j floor for any horizon N; under ``reward``, which ends with the plan, it contributes
    (gamma^j - gamma^N) floor.

    Args:
        config: objective and termination rule.
        model: a `Dynamics`; with ``discount`` under ``reward`` and ``td``.
        steps: of a plan, `PlannerConfig.actions`.
    """

    def __init__(self, config: PlannerConfig, model: Any, steps: int) -> None:
        self._config, self._steps = config, steps
        self._is_mean = config.objective == "value"
        self._discount = 1.0 if self._is_mean else model.discount
        self._floor = 0.0 if config.termination_rule == "paper" else model.min_return
        self._weight: Tensor | float = 1.0
        self._survival: Tensor | float = 1.0
        self._above: Tensor | float = 0.0
        self._below: Tensor | float = 0.0

    def needs_value(self, k: int) -> bool:
        """Whether step k contributes Q, rather than its reward."""
        at_the_end = self._config.objective == "td" and k == self._steps - 1
        return self._is_mean or at_the_end

    def needs_termination(self, k: int) -> bool:
        """Whether the termination probability of step k affects V."""
        return 0 < k < self._steps - 1

    def add_value(self, q: Tensor) -> None:
        self._add(q, self._floor)

    def add_reward(self, r: Tensor) -> None:
        self._add(r, (1.0 - self._discount) * self._floor)
        self._weight = self._weight * self._discount

    def add_termination(self, probability: Tensor) -> None:
        if self._config.termination_rule == "survival":
            self._survival = self._survival * (1.0 - probability)
        else:
            self._survival = self._survival * (probability <= self._config.termination_threshold)

    def plan_value(self) -> Tensor:
        """V, (...)."""
        v = self._above + self._below
        if self._is_mean:
            v = v / self._steps
        assert isinstance(v, Tensor)
        return v

    def _add(self, value: Tensor, floor: Tensor | float) -> None:
        self._above = self._above + self._weight * self._survival * (value - floor)
        self._below = self._below + self._weight * floor


def evaluate[L](
    model: Dynamics[L],
    carry: L,
    actions: Tensor,
    config: PlannerConfig,
    generator: torch.Generator | None = None,
) -> Tensor:
    """V (E, M) of plans (E, M, P, 7) from the robots' carry (E, ...), P = `PlannerConfig.actions`.

    Args:
        generator: of the noise under ``latent=sample``; None: torch's own.

    Raises:
        UsageError: the model lacks a head that the objective needs.
    """
    rewarded: Any = model  # rewards are no part of `Dynamics`
    accumulator = ReturnAccumulator(config, model, actions.shape[-2])
    states = _states(model, carry, actions, config, generator)
    for k, (state, action) in enumerate(zip(states, actions.unbind(-2), strict=True)):
        if accumulator.needs_value(k):
            accumulator.add_value(model.value(state, action))
        else:
            accumulator.add_reward(rewarded.reward(state, action))
        if accumulator.needs_termination(k):
            accumulator.add_termination(model.termination(state))
    return accumulator.plan_value()


def _states(
    model: Any,
    carry: Any,
    actions: Tensor,
    config: PlannerConfig,
    generator: torch.Generator | None,
) -> Iterator[Any]:
    """The states in which the actions are taken: the robots' present ones, then imagined ones."""
    sampled = config.latent == "sample"
    imagine = partial(model.imagine_sample, generator=generator) if sampled else model.imagine
    carry = model.expand_candidates(carry)
    yield carry
    for action in actions.unbind(-2)[:-1]:
        carry = imagine(carry, action)
        yield carry
