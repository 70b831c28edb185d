"""Random shooting: plans as the data's own random walk would make them; the best one is kept."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from egovcp.plan.config import PlannerConfig
from egovcp.plan.icem import keep_best
from egovcp.plan.search import SearchState, best_of


@dataclass(frozen=True)
class Shooting:
    """Learns nothing from a round but its best plan."""

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """See `Optimiser`; uniform steps, after the best plan so far and standing still."""
        mean = state.mean
        size = (1, self.config.samples, *mean.shape[1:])
        uniform = 2 * torch.rand(size, generator=generator, device=mean.device) - 1
        deltas = uniform.repeat(mean.shape[0], 1, 1, 1)
        deltas[:, 0] = mean
        if self.config.samples > 1:
            deltas[:, 1] = 0.0
        return deltas.clamp_(-1.0, 1.0)

    def learn(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """See `Optimiser`."""
        return keep_best(state, *best_of(deltas, values, self.config.elites))
