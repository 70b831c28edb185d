"""The cross-entropy method on a processor, each of its steps one function of the C kernel.

The draws are torch's own, so that a seed means the same to every backend; what is made of them
differs from `egovcp.plan.cem`, which says what is right, by rounding only.
"""

from __future__ import annotations

import torch
from torch import Tensor

from egovcp.plan.backends import library
from egovcp.plan.config import PlannerConfig
from egovcp.plan.search import SearchState, white


class KernelCrossEntropy:
    """See `egovcp.plan.cem.CrossEntropy`; tensors in float32 on the processor.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
    """

    def __init__(self, config: PlannerConfig) -> None:
        self.config = config
        self._kernel = library.library()

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """See `Optimiser`; standing still is always among the candidates."""
        mean, std = state.mean.contiguous(), state.std.contiguous()
        robots, horizon, actions = mean.shape
        noise = white(mean, self.config.samples, generator)
        deltas = torch.empty(robots, self.config.samples, horizon, actions)
        parts = (mean, std, noise, deltas)
        sizes = (robots, self.config.samples, horizon * actions)
        self._kernel.draw(*sizes, *(x.data_ptr() for x in parts))
        return deltas

    def random_walk(self, start: Tensor, deltas: Tensor, eta: float) -> Tensor:
        """See `Walker`."""
        start, deltas = start.contiguous(), deltas.contiguous()
        actions = torch.empty_like(deltas)
        parts = (start, deltas, actions)
        self._kernel.walk(*deltas.shape, eta, *(x.data_ptr() for x in parts))
        return actions

    def learn(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """See `Optimiser`."""
        count, (robots, samples, horizon, actions) = self.config.elites, deltas.shape
        deltas, values = deltas.contiguous(), values.contiguous()
        elites = torch.empty(robots, count, horizon, actions)
        top, value = torch.empty(robots, count), torch.empty(robots)
        mean, std = state.mean.clone(), state.std.clamp_min(self.config.min_std)
        parts = (deltas, values, elites, top, value, mean, std)
        sizes = (robots, samples, horizon * actions, count)
        self._kernel.learn(*sizes, self.config.min_std, *(x.data_ptr() for x in parts))
        return SearchState(mean, std, elites, top, value)


def is_at_hand() -> bool:
    """Whether a search may use the kernel: the processor is made for it, and it can be built."""
    return library.processor_is_fast() and library.library_if_possible() is not None
