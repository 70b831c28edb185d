"""How many candidates to weigh when time is short: half, once plans are often late or cut short.

A plan that the deadline cut short has fewer rounds than it should; fewer candidates in all of the
rounds are worth more than many in one (`docs/log.md`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from egovcp.plan import PlannerConfig

BUDGET_S: Final = 0.034  # from an observation to its plan; the rest of the tick carries it over
POOR_TO_HALVE: Final = 3  # late or short plans; two good ones make up for one
_MADE_UP: Final = 0.5
GOOD_TO_DOUBLE: Final = 50  # good plans in a row, 2 s
FEWEST_SAMPLES: Final = 64
FEWEST_ELITES: Final = 4  # the mean of two follows Q's errors too closely (docs/planner.md)


class Effort:
    """Halves the samples of a planner that lacks time, and doubles them again when it does not.

    Args:
        full: the planner's own configuration, which is never exceeded.
    """

    def __init__(self, full: PlannerConfig) -> None:
        self._full = full
        self.config = full
        """What to plan with now."""
        self._poor, self._good = 0.0, 0

    def record(self, late: bool, iterations: int) -> bool:
        """Count one plan and its rounds; true if `config` has changed."""
        poor = late or iterations < self.config.iterations
        self._poor = self._poor + 1 if poor else max(0.0, self._poor - _MADE_UP)
        self._good = 0 if poor else self._good + 1
        if self._poor >= POOR_TO_HALVE:
            return self._scale(self.config.samples // 2)
        if self._good >= GOOD_TO_DOUBLE:
            return self._scale(self.config.samples * 2)
        return False

    def _scale(self, samples: int) -> bool:
        self._poor, self._good = 0.0, 0
        fewest = min(FEWEST_SAMPLES, self._full.samples)
        samples = min(max(samples, fewest), self._full.samples)
        changed = samples != self.config.samples
        elites = self._full.elites * samples // self._full.samples
        elites = min(max(elites, FEWEST_ELITES), self._full.elites)
        self.config = replace(self._full, samples=samples, elites=elites)
        return changed
