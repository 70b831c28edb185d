"""A value function of the simulator's state: the target of Q.

The return of one recorded action is a noisy target: later random actions and chance decide most of
it. But the data also holds the position of the task's object (`egovcp.data.privileged`), from which
a small network learns the value of planned actions (`egovcp_train.privileged_value`). Its
predictions are the target of Q(h, z, a), which sees only what the robot sees (an asymmetric critic;
Pinto et al. 2018, Chen et al. 2020). It also predicts the value of actions that were not taken, so
Q is fitted to several actions per state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Self

import torch
from torch import Tensor, nn

from egovcp import spec
from egovcp.model.networks import SplitMlp
from egovcp.robot_spec import G1, RobotSpec

_UNITS: Final = 256
_LAYERS: Final = 3


class PrivilegedValue(nn.Module):
    """Standardised value of a state and an action.

    Args:
        features: number of privileged features.
        robot: whose state and actions are inputs.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, features: int, robot: RobotSpec = G1) -> None:
        super().__init__()
        inputs = (robot.state_dim, features, robot.action_dim)
        self.network = SplitMlp(inputs, _UNITS, 1, hidden_layers=_LAYERS)
        self.network.start_at_zero()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))

    @classmethod
    def restore(cls, state: Mapping[str, Tensor], robot: RobotSpec = G1) -> Self:
        """The value that a ``state_dict`` describes, without gradients."""
        value = cls(len(state["mean"]), robot)
        value.load_state_dict(state)
        return value.requires_grad_(False)

    def forward(self, state: Tensor, privileged: Tensor, action: Tensor) -> Tensor:
        """Standardised proprioception (..., 74), features (..., F), actions (..., 7) -> (...,)."""
        value: Tensor = self.network(state, (privileged - self.mean) / self.std, action)
        return value.squeeze(-1).float()


def sample_actions(
    previous: Tensor, count: int, generator: torch.Generator | None = None
) -> Tensor:
    """Actions (B, T, ``count``, 7) that random targets lead to from the previous action.

    Each moves from ``previous`` (B, T, 7) towards a uniformly distributed target, as far as the
    rate limit allows.
    """
    size, length, dim = previous.shape
    shape = (size, length, count, dim)
    noise = torch.randn(shape, generator=generator, device=previous.device)
    target = torch.erf(noise * 0.5**0.5)  # uniform in (-1, 1)
    limit = spec.ACTION_RATE_LIMIT
    previous = previous[:, :, None]
    return previous + (target - previous).clamp(-limit, limit)
