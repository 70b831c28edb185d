"""Value-guided sampling MPC (paper section III-D): sample plans, evaluate them, refine the samples.

Candidates change by at most eta per step from the last executed action, a_k = a_{k-1} + eta *
delta_k with delta in [-1, 1]^7. A search has no side effects and reads no clock but ``remaining``.
P in shapes is `PlannerConfig.actions`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from egovcp import spec
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import PlanEvaluator


def reflect_once(x: Tensor) -> Tensor:
    """`egovcp.spec.reflect` of values within [-3, 3]; bit-identical to the kernel."""
    return 2.0 * x.clamp(-1.0, 1.0) - x


def random_walk(start: Tensor, deltas: Tensor, eta: float) -> Tensor:
    """Actions (..., P, 7) of a random walk from ``start`` (..., 7) by ``deltas``."""
    actions = []
    action = start
    for delta in deltas.unbind(-2):
        action = reflect_once(action + eta * delta)
        actions.append(action)
    return torch.stack(actions, -2)


def target_deltas(start: Tensor, deltas: Tensor, eta: float) -> Tensor:
    """Deltas (..., P, 7) that move from ``start`` (..., 7) to one target at rate ``eta``, and hold.

    The target is where ``deltas`` (..., P, 7) add up to, reflected into the box. Deltas that are
    already of this kind are returned unchanged.
    """
    target = reflect_once((start + eta * deltas.sum(-2)).clamp(-3.0, 3.0))
    steps_to_target = ((target - start) / eta)[..., None, :]
    steps = torch.arange(deltas.shape[-2], dtype=deltas.dtype, device=deltas.device)[:, None]
    return (steps_to_target.abs() - steps).clamp(0.0, 1.0) * steps_to_target.sign()


def shift(deltas: Tensor) -> Tensor:
    """The warm start: deltas (E, P, 7) without the first, which was executed, and a zero step."""
    return torch.cat([deltas[:, 1:], torch.zeros_like(deltas[:, :1])], 1)


class SearchState(NamedTuple):
    """State of a search for E robots."""

    mean: Tensor  # (E, P, 7) deltas of the current result: a mean, or the best plan so far
    std: Tensor  # (E, P, 7)
    elites: Tensor  # (E, elites, P, 7) deltas, best first; of the last iteration
    values: Tensor  # (E, elites); -inf where J was not finite
    value: Tensor  # (E,) mean J of the candidates that ``mean`` is made of; -inf: not known


class Optimiser(Protocol):
    """Samples candidates, and updates its state from their values.

    It may have its own, bit-identical implementation of `random_walk`.
    """

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """(E, M, P, 7) deltas; the first candidate is ``state.mean`` in iteration 0."""
        ...

    def update(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """Update from the ``values`` (E, M) of candidates; -inf where J was not finite."""
        ...


class Plan(NamedTuple):
    """Result of a search for E robots."""

    actions: Tensor  # (E, P, 7) in [-1, 1]; the first is to be executed
    deltas: Tensor  # (E, P, 7) its deltas; shifted, the warm start of the next plan
    value: Tensor  # (E,) see `SearchState`
    candidates: Tensor  # (E, elites, P, 7) elites of the last iteration, best first
    candidate_values: Tensor  # (E, elites); -inf where J was not finite
    iterations: int


def time_left_until(deadline_s: float) -> Callable[[], float]:
    """Returns a function: seconds left until ``deadline_s`` of `time.perf_counter`."""
    return lambda: deadline_s - time.perf_counter()


def make_plan[C](
    evaluator: PlanEvaluator[C],
    optimiser: Optimiser,
    carry: C,
    executed: Tensor,
    config: PlannerConfig,
    generator: torch.Generator,
    warm: Tensor | None = None,
    remaining: Callable[[], float] | None = None,
    discount: Tensor | float = spec.GAMMA,
) -> Plan:
    """Plan for E robots from ``carry`` (E, ...), a_{t-1} = ``executed`` (E, 7).

    Maximises J = V - C: the evaluator's value minus `action_costs`, known terms of the reward that
    Q does not learn.

    Args:
        warm: (E, P, 7) deltas of the previous plan, already shifted; None: zeros.
        generator: of the samples, which all robots share: a robot's plan does not depend on the
            other robots.
        remaining: seconds until the result is due. The search stops if another iteration, as long
            as the slowest so far, would end later, but does at least one.
        discount: discount per step of the costs, that of the model's Q.
    """
    left = remaining() if remaining else 0.0
    slowest = 0.0
    state = _start(executed, config, warm)
    plan_value = evaluator.at(carry)
    walk = getattr(optimiser, "random_walk", random_walk)
    start = executed[:, None]  # (E, 1, 7)
    for iteration in range(config.iterations):
        deltas = optimiser.propose(state, iteration, generator)  # (E, M, P, 7)
        if config.action_parameterization == "target":
            deltas = target_deltas(start, deltas, config.eta)
        actions = walk(start, deltas, config.eta)
        costs = action_costs(start, actions, config, discount)
        values = plan_value(actions, generator) - costs
        values = values.nan_to_num(-torch.inf, -torch.inf, -torch.inf)
        state = optimiser.update(state, deltas, values)
        if remaining:
            before, left = left, remaining()
            slowest = max(slowest, before - left)
            if left <= slowest:
                break
    best = walk(start, state.elites, config.eta)
    chosen = walk(start, state.mean[:, None], config.eta)[:, 0]
    return Plan(chosen, state.mean, state.value, best, state.values, iteration + 1)


def action_costs(
    start: Tensor, actions: Tensor, config: PlannerConfig, discount: Tensor | float
) -> Tensor:
    """Discounted costs (E, M) of poses and action changes in plans (E, M, P, 7) of P steps from
    a_{t-1} (E, 1, 7):

    sum_{k<K} gamma^k (pose_cost mean(a_k^2) + action_rate_cost mean((a_k - a_{k-1})^2) / limit^2)

    gamma is ``discount``. K is P under ``objective=reward``. The other objectives contain Q, which
    also counts later rewards: K is `spec.RETURN_STEPS` if that is more, and after the plan the last
    action is held.
    """
    before = torch.cat([start[:, None].expand_as(actions[..., :1, :]), actions[..., :-1, :]], -2)
    change = (actions - before) / spec.ACTION_RATE_LIMIT
    pose = config.pose_cost * actions.square().mean(-1)
    steps = actions.shape[-2]
    counted = max(steps, 0 if config.objective == "reward" else spec.RETURN_STEPS)
    weight = discount ** torch.arange(counted, device=actions.device)
    during, after = weight[:steps], weight[steps:].sum()
    rate = config.action_rate_cost * change.square().mean(-1)
    return ((pose + rate) * during).sum(-1) + pose[..., -1] * after


def _start(executed: Tensor, config: PlannerConfig, warm: Tensor | None) -> SearchState:
    robots = executed.shape[0]
    shape = (robots, config.actions, executed.shape[-1])
    mean = executed.new_zeros(shape) if warm is None else warm
    unknown = executed.new_full((robots, config.elites), -torch.inf)
    elites = mean[:, None].expand(-1, config.elites, -1, -1)
    std = torch.full_like(mean, 3.0**-0.5)  # of U(-1, 1)
    return SearchState(mean, std, elites, unknown, unknown[:, 0])
