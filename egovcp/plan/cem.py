"""Value-guided sampling MPC with the cross-entropy method (paper section III-D).

    maximise  J = 1/N sum_k Q(h_{t+k}, z^_{t+k}, a_{t+k})            (equation 15)

Candidates live in the action process of the data, a_k = a_{k-1} + eta * delta_k with
delta in [-1, 1]^7 starting at the last executed action: anything else would ask Q about
actions it never saw. The planner is pure: no I/O, no clock, no global state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.plan.choices import Ensemble, Latent, judge_of, step_of

TerminationRule = Literal["paper", "shift", "survival"]


class Dynamics[L](Protocol):
    """What the planner needs of a world model; leading dimensions broadcast (E robots, M plans)."""

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


@dataclass(frozen=True)
class PlannerConfig:
    """The sampling MPC; the defaults are the paper's, 25 Hz."""

    samples: int = 1024
    """M, candidate plans per iteration."""
    horizon: int = 4
    """N, planner ticks."""
    iterations: int = 3
    """Rounds of the cross-entropy method."""
    elites: int = 64
    """Best candidates that the next round is fitted to."""
    min_std: float = 0.1
    """Floor of the sampling deviation, in units of delta."""
    eta: float = spec.ACTION_ETA
    """Step of the action process, box units per tick."""
    termination_threshold: float = 0.9
    """A candidate whose termination probability exceeds this loses its later values."""
    termination_rule: TerminationRule = "shift"
    """paper: later values are 0; shift: they are the data's worst return; survival: each
    value above the worst return is weighted with the probability of being alive."""
    latent: Latent = "mean"
    """z of imagined states. mean: the prior's; sample: drawn from the prior, anew in each
    iteration, with the same noise for all candidates."""
    ensemble: Ensemble = "mean"
    """What several heads of Q are worth together (`q_heads`): their mean, or the least of them."""

    def __post_init__(self) -> None:
        if min(self.samples, self.horizon, self.iterations, self.elites) < 1:
            raise UsageError("samples, horizon, iterations and elites must be at least 1")
        if self.elites > self.samples:
            raise UsageError(f"elites ({self.elites}) exceed samples ({self.samples})")
        if not 0 < self.eta <= 2:
            raise UsageError(f"eta is {self.eta}; expected more than 0 and at most 2, the box")


class Plan(NamedTuple):
    """The planner's answer for E robots."""

    actions: Tensor  # (E, N, 7) in [-1, 1]; the first is to be executed
    deltas: Tensor  # (E, N, 7) its steps; shifted, the warm start of the next plan
    value: Tensor  # (E,) J, the mean over the last elites; -inf if no candidate had a finite J
    candidates: Tensor  # (E, elites, N, 7) elites of the last round, best first
    candidate_values: Tensor  # (E, elites); -inf where J was not a number
    iterations: int


def reflect(x: Tensor) -> Tensor:
    """Fold values within one box length outside [-1, 1] back inside, as the data does."""
    x = torch.where(x > 1.0, 2.0 - x, x)
    return torch.where(x < -1.0, -2.0 - x, x)


def walk(start: Tensor, deltas: Tensor, eta: float) -> Tensor:
    """Actions (..., N, 7) of the data's process from ``start`` (..., 7) by ``deltas``."""
    actions = []
    action = start
    for delta in deltas.unbind(-2):
        action = reflect(action + eta * delta)
        actions.append(action)
    return torch.stack(actions, -2)


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
    floor = 0.0 if config.termination_rule == "paper" else model.return_floor
    total = torch.zeros_like(actions[..., 0, 0])
    alive = torch.ones_like(total)
    carry = model.spread(carry)
    for k in range(horizon):
        if k > 0:
            carry = imagine(carry, actions[..., k - 1, :])
        total = total + alive * (judge(carry, actions[..., k, :]) - floor)
        if k == 0 or k == horizon - 1:
            continue  # o_t was seen alive; and nothing follows the last step
        dead = model.termination(carry)
        if config.termination_rule == "survival":
            alive = alive * (1.0 - dead)
        else:
            alive = alive * (dead <= config.termination_threshold)
    return total / horizon + floor


def plan_cem[L](
    model: Dynamics[L],
    carry: L,
    executed: Tensor,
    config: PlannerConfig,
    generator: torch.Generator,
    warm: Tensor | None = None,
) -> Plan:
    """Plan for E robots from ``carry`` (E, ...), a_{t-1} = ``executed`` (E, 7).

    Args:
        warm: (E, N, 7) deltas of the previous plan, already shifted; None starts at rest.
        generator: its draws are shared by all robots, so that a robot's plan does not
            depend on which others it is planned with.
    """
    robots = executed.shape[0]
    shape = (robots, config.horizon, spec.ACTION_DIM)
    mean = executed.new_zeros(shape) if warm is None else warm
    std = torch.full_like(mean, 3.0**-0.5)  # of U(-1, 1)
    start = executed[:, None]  # (E, 1, 7)
    for _ in range(config.iterations):
        deltas = _sample(mean, std, config, generator)  # (E, M, N, 7)
        values = evaluate(model, carry, walk(start, deltas, config.eta), config, generator)
        values = values.masked_fill(~values.isfinite(), -torch.inf)
        top, index = values.topk(config.elites, dim=1)
        elites = deltas.take_along_dim(index[:, :, None, None], 1)
        usable = top.isfinite()
        mean, std = _refit(elites, usable, mean, std)
        std = std.clamp_min(config.min_std)
    chosen = walk(executed, mean, config.eta)
    best = walk(executed.repeat_interleave(config.elites, 0), elites.flatten(0, 1), config.eta)
    best = best.view(robots, config.elites, *shape[1:])
    value = top.masked_fill(~usable, 0.0).sum(1) / usable.sum(1).clamp_min(1)
    value = value.masked_fill(~usable.any(1), -torch.inf)
    return Plan(chosen, mean, value, best, top, config.iterations)


def _refit(elites: Tensor, usable: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation (E, N, 7) of the usable elites (E, elites, N, 7); without any, the old."""
    weight = usable[:, :, None, None].to(elites.dtype)
    count = weight.sum(1)
    fitted = (elites * weight).sum(1) / count.clamp_min(1.0)
    squares = (elites - fitted[:, None]).square() * weight
    spread = (squares.sum(1) / count.clamp_min(1.0)).sqrt()
    return torch.where(count > 0, fitted, mean), torch.where(count > 0, spread, std)


def _sample(mean: Tensor, std: Tensor, config: PlannerConfig, generator: torch.Generator) -> Tensor:
    """(E, M, N, 7) deltas; the first candidate is the mean itself, the second stands still."""
    size = (1, config.samples, *mean.shape[1:])
    noise = torch.randn(size, generator=generator, device=mean.device)
    deltas = mean[:, None] + std[:, None] * noise
    deltas[:, 0] = mean
    if config.samples > 1:
        deltas[:, 1] = 0.0
    return deltas.clamp_(-1.0, 1.0)


def shift(deltas: Tensor) -> Tensor:
    """Drop the executed first step (E, N, 7) and stand still at the end: the warm start."""
    return torch.cat([deltas[:, 1:], torch.zeros_like(deltas[:, :1])], 1)
