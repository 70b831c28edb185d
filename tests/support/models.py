"""Small models: an untrained reactive policy, and a world model that counts."""

from __future__ import annotations

import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import PRESETS, Carry, WorldModel
from egovcp.reactive import ReactiveConfig, ReactiveNetwork, tensor_shapes


def toy_reactive(controller_id: str, seed: int = 0) -> ReactiveNetwork:
    """A small untrained reactive policy whose action depends on its observations."""
    config = ReactiveConfig(frames=2, channels=(2, 4, 4), hidden=(16,))
    rng = torch.Generator().manual_seed(seed)
    tensors = {
        name: 0.3 * torch.randn(shape, generator=rng)
        for name, shape in tensor_shapes(config).items()
    }
    tensors["std"] = torch.ones_like(tensors["std"])
    return ReactiveNetwork(tensors, config, controller_id, {"steps": 0})


class CountingModel(WorldModel):
    """Counts its calls: h[:, 0] is the number of observations since the reset,
    z[:, :7] the action that led to the state, h[:, 1] the imagined ticks.

    Q is highest for an action that repeats the last one, shifted by ``drift``.
    """

    COUNT, IMAGINED = 0, 1

    def __init__(self, drift: float = 0.0) -> None:
        super().__init__(PRESETS["debug"])
        self.drift = drift

    def observe(
        self, carry: Carry, action: Tensor, depth: Tensor, state: Tensor, is_first: Tensor
    ) -> Carry:
        first = is_first[:, None]
        h, z = carry.h.masked_fill(first, 0.0), torch.zeros_like(carry.z)
        h[:, self.COUNT] += 1.0
        z[:, : spec.ACTION_DIM] = action.masked_fill(first, 0.0)
        return Carry(h, z)

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        shape = action.shape[:-1]
        h = carry.h.expand(*shape, -1).clone()
        z = carry.z.expand(*shape, -1).clone()
        h[..., self.IMAGINED] += 1.0
        z[..., : spec.ACTION_DIM] = action
        return Carry(h, z)

    def value(self, carry: Carry, action: Tensor) -> Tensor:
        last = carry.z[..., : spec.ACTION_DIM]
        return -(action - last - self.drift).square().sum(-1)

    def termination(self, carry: Carry) -> Tensor:
        return torch.zeros_like(carry.h[..., 0])
