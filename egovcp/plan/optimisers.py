"""The searches, by the name under which `PlannerConfig` chooses one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

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


def optimiser_of(config: PlannerConfig) -> Optimiser:
    """The search that ``config.optimiser`` names."""
    return OPTIMISERS[config.optimiser](config)
