"""How many candidates to weigh when planning is too slow: half, once plans are often late."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from egovcp.plan import PlannerConfig

BUDGET_S: Final = 0.034  # from an observation to its plan; the rest of the tick carries it over
LATE_TO_HALVE: Final = 3  # late plans; two that are in time make up for one
_MADE_UP: Final = 0.5
IN_TIME_TO_DOUBLE: Final = 50  # plans in time in a row, 2 s
FEWEST_SAMPLES: Final = 64


class Effort:
    """Halves the samples of a planner that is late, and doubles them again when it is not.

    Args:
        full: the planner's own configuration, which is never exceeded.
    """

    def __init__(self, full: PlannerConfig) -> None:
        self._full = full
        self.config = full
        """What to plan with now."""
        self._late, self._in_time = 0.0, 0

    def record(self, late: bool) -> bool:
        """Count one plan; true if `config` has changed."""
        self._late = self._late + 1 if late else max(0.0, self._late - _MADE_UP)
        self._in_time = 0 if late else self._in_time + 1
        if self._late >= LATE_TO_HALVE:
            return self._scale(self.config.samples // 2)
        if self._in_time >= IN_TIME_TO_DOUBLE:
            return self._scale(self.config.samples * 2)
        return False

    def _scale(self, samples: int) -> bool:
        self._late, self._in_time = 0.0, 0
        fewest = min(FEWEST_SAMPLES, self._full.samples)
        samples = min(max(samples, fewest), self._full.samples)
        changed = samples != self.config.samples
        elites = max(1, self._full.elites * samples // self._full.samples)
        self.config = replace(self._full, samples=samples, elites=elites)
        return changed
