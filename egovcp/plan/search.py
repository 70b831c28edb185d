"""Value-guided sampling MPC (paper section III-D): draw plans, evaluator them, draw better ones.

Candidates live in the action process of the data, a_k = a_{k-1} + eta * delta_k with
delta in [-1, 1]^7 starting at the last executed action (where the data rests between its steps, in
ramps to a place to rest at): anything else would ask Q about actions it never saw. A search is
pure: no I/O, no global state, and no clock but the one that it is given.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from egovcp import spec
from egovcp.plan.action_parameterization import random_walk, target_steps
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import PlanEvaluator


class SearchState(NamedTuple):
    """What a search knows about good plans of E robots."""

    mean: Tensor  # (E, N, 7) deltas; what it would answer now
    std: Tensor  # (E, N, 7)
    elites: Tensor  # (E, elites, N, 7) deltas, best first; of the last round
    values: Tensor  # (E, elites); -inf where J was not a number
    value: Tensor  # (E,) J of the answer, less what its effort costs, as far as it is known


class Optimiser(Protocol):
    """Draws candidates and learns from what they are worth."""

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """(E, M, N, 7) deltas; the first candidate is ``state.mean`` in iteration 0."""
        ...

    def learn(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """After the ``values`` (E, M) of these candidates; -inf where J was not a number."""
        ...


@runtime_checkable
class Walker(Protocol):
    """An optimiser that also makes actions of its draws."""

    def random_walk(self, start: Tensor, deltas: Tensor, eta: float) -> Tensor:
        """Same bits as the module function, but faster: (E, M, N, 7) from (E, 1, 7)."""
        ...


class Plan(NamedTuple):
    """The planner's answer for E robots."""

    actions: Tensor  # (E, N, 7) in [-1, 1]; the first is to be executed
    deltas: Tensor  # (E, N, 7) its steps; shifted, the warm start of the next plan
    value: Tensor  # (E,) J less effort (cem: mean of the last elites); -inf: none finite
    candidates: Tensor  # (E, elites, N, 7) elites of the last round, best first
    candidate_values: Tensor  # (E, elites); -inf where J was not a number
    iterations: int


class Deadline:
    """Says whether another iteration ends before the deadline, judged by the slowest so far.

    Args:
        remaining: seconds until the deadline; None: there is none, and no clock is read.
    """

    def __init__(self, remaining: Callable[[], float] | None) -> None:
        self._remaining = remaining
        self._slowest = 0.0
        self._left = remaining() if remaining else 0.0

    def goes_on(self) -> bool:
        """Ask after each iteration."""
        if self._remaining is None:
            return True
        left = self._remaining()
        self._slowest = max(self._slowest, self._left - left)
        self._left = left
        return left > self._slowest


def until(deadline_s: float) -> Callable[[], float]:
    """Seconds left until ``deadline_s`` of `time.perf_counter`."""
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
) -> Plan:
    """Plan for E robots from ``carry`` (E, ...), a_{t-1} = ``executed`` (E, 7).

    Args:
        warm: (E, N, 7) deltas of the previous plan, already shifted; None starts at rest.
        generator: its draws are shared by all robots, so that a robot's plan does not
            depend on which others it is planned with.
        remaining: seconds until an answer is due. The search stops where a further iteration,
            were it as slow as the slowest so far, would end later; one is always made.
    """
    pace = Deadline(remaining)
    state = _start(executed, config, warm)
    plan_value = evaluator.at(carry)
    follow = optimiser.random_walk if isinstance(optimiser, Walker) else random_walk
    start = executed[:, None]  # (E, 1, 7)
    for iteration in range(config.iterations):
        deltas = optimiser.propose(state, iteration, generator)  # (E, M, N, 7)
        if config.action_parameterization == "target":
            deltas = target_steps(start, deltas, config.eta)
        actions = follow(start, deltas, config.eta)
        values = _less_effort(plan_value(actions, generator), actions, deltas, config)
        values = values.nan_to_num(-torch.inf, -torch.inf, -torch.inf)
        state = optimiser.learn(state, deltas, values)
        if not pace.goes_on():
            break
    best = follow(start, state.elites, config.eta)
    chosen = follow(start, state.mean[:, None], config.eta)[:, 0]
    return Plan(chosen, state.mean, state.value, best, state.values, iteration + 1)


def _less_effort(values: Tensor, actions: Tensor, deltas: Tensor, config: PlannerConfig) -> Tensor:
    """J (E, M) less what plans (E, M, N, 7) cost besides what Q says of them."""
    cost: Tensor | float = 0.0
    if config.hands_cost > 0:
        cost = config.hands_cost * actions[..., spec.ACTION_HANDS].square().mean((-2, -1))
    if config.step_cost > 0:
        cost = cost + config.step_cost * deltas.square().mean((-2, -1))
    return values - cost if isinstance(cost, Tensor) else values


def _start(executed: Tensor, config: PlannerConfig, warm: Tensor | None) -> SearchState:
    robots = executed.shape[0]
    shape = (robots, config.actions, spec.ACTION_DIM)
    mean = executed.new_zeros(shape) if warm is None else warm
    nothing = executed.new_full((robots, config.elites), -torch.inf)
    elites = mean[:, None].expand(-1, config.elites, -1, -1)
    std = torch.full_like(mean, 3.0**-0.5)  # of U(-1, 1)
    return SearchState(mean, std, elites, nothing, nothing[:, 0])


def draw(mean: Tensor, std: Tensor, noise: Tensor, still: bool = True) -> Tensor:
    """(E, M, N, 7) deltas around a mean, from noise (1, M, N, 7).

    The first candidate is the mean itself; the second, if ``still``, stands still.
    """
    deltas = mean[:, None] + std[:, None] * noise
    deltas[:, 0] = mean
    if still and deltas.shape[1] > 1:
        deltas[:, 1] = 0.0
    return deltas.clamp_(-1.0, 1.0)


def white(mean: Tensor, samples: int, generator: torch.Generator) -> Tensor:
    """Noise (1, M, N, 7) that all robots share."""
    return torch.randn((1, samples, *mean.shape[1:]), generator=generator, device=mean.device)


def best_of(deltas: Tensor, values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The ``count`` best of (E, M, N, 7) by their values (E, M), best first."""
    top, index = values.topk(count, dim=1)
    rows = deltas.flatten(2)
    best = rows.gather(1, index[:, :, None].expand(-1, -1, rows.shape[2]))
    return best.view(*index.shape, *deltas.shape[2:]), top
