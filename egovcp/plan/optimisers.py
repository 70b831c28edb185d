"""The searches, by the name under which `PlannerConfig` chooses one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import torch

from egovcp.plan.backends.sampling import KernelCrossEntropy, is_at_hand
from egovcp.plan.cem import CrossEntropy
from egovcp.plan.config import OptimiserName, PlannerConfig
from egovcp.plan.icem import ImprovedCrossEntropy
from egovcp.plan.mppi import PathIntegral
from egovcp.plan.search import Optimiser
from egovcp.plan.shooting import Shooting

OPTIMISERS: Final[Mapping[OptimiserName, Callable[[PlannerConfig], Optimiser]]] = {
    "cem": CrossEntropy,
    "icem": ImprovedCrossEntropy,
    "mppi": PathIntegral,
    "shooting": Shooting,
}


def optimiser_of(config: PlannerConfig, device: torch.device | str = "cpu") -> Optimiser:
    """The search that ``config.optimiser`` names.

    Args:
        config: of the planner.
        device: of what it works on. On a processor cem is computed by the kernel of the int8
            planner, if the backend may be that.
    """
    kernel = config.backend in ("auto", "int8") and torch.device(device).type == "cpu"
    if config.optimiser == "cem" and kernel and is_at_hand():
        return KernelCrossEntropy(config)
    return OPTIMISERS[config.optimiser](config)
