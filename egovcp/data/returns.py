"""Which Monte Carlo return Q is fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from egovcp import spec
from egovcp.bounds import bounded, check_bounds

ReturnScaling = Literal["dataset", "none", "per_task"]


@dataclass(frozen=True)
class ReturnConfig:
    """The Monte Carlo target of Q."""

    gamma: float = bounded(spec.GAMMA, least=0, most=1)
    """Discount per planner tick."""
    steps: int = bounded(spec.RETURN_STEPS, least=1, most=100_000)
    """Horizon K, planner ticks."""
    keep_truncated: bool = False
    """Train on returns that the time limit cuts short, too (the paper's choice)."""
    scale: ReturnScaling = "dataset"
    """What Q is fitted to. dataset: returns in deviations from their mean over all tasks; none:
    returns as they are; per_task: an ablation, in deviations from the mean of the own task."""

    def check(self, flag: str = "--returns") -> None:
        """Raise `UsageError`, which names options of ``flag``, for values that make no sense."""
        check_bounds(self, f"{flag}.")
