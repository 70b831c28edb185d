"""MPPI (Williams et al., 2017): every candidate counts, by the exponential of its value."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from egovcp.plan.cem import refit
from egovcp.plan.config import PlannerConfig
from egovcp.plan.search import SearchState, best_of, draw, white


@dataclass(frozen=True)
class PathIntegral:
    """Deviations of values set the temperature's unit, so that it means the same to any Q."""

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """See `Optimiser`; standing still is always among the candidates."""
        noise = white(state.mean, self.config.samples, generator)
        return draw(state.mean, state.std, noise)

    def learn(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """See `Optimiser`."""
        elites, top = best_of(deltas, values, self.config.elites)
        usable = values.isfinite()
        weight = weights(values, self.config.temperature)  # (E, M)
        any_usable = usable.any(1)
        mean = (weight[:, :, None, None] * deltas).sum(1)
        mean = torch.where(any_usable[:, None, None], mean, state.mean)
        value = (weight * values.masked_fill(~usable, 0.0)).sum(1)
        value = value.masked_fill(~any_usable, -torch.inf)
        _, std = refit(elites, top.isfinite(), state)
        return SearchState(mean, std.clamp_min(self.config.min_std), elites, top, value)


def weights(values: Tensor, temperature: float) -> Tensor:
    """(E, M) values -> weights that add up to 1; 0 where a value is -inf."""
    usable = values.isfinite()
    known = values.masked_fill(~usable, 0.0)
    count = usable.sum(1, keepdim=True).clamp_min(1)
    mean = known.sum(1, keepdim=True) / count
    spread = ((known - mean).square() * usable).sum(1, keepdim=True).div(count).sqrt()
    best = values.amax(1, keepdim=True)
    below = torch.where(
        usable, (known - best) / (temperature * spread).clamp_min(1e-12), -torch.inf
    )
    weight = below.exp()
    return weight / weight.sum(1, keepdim=True).clamp_min(1e-12)
