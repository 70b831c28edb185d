"""How many candidates each search can evaluate in the time for a plan.

The time of a plan is a + b M for M candidates per iteration; a and b follow from plans with few and
with many candidates. All searches are timed in turns, so that other load affects them alike.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure
from egovcp.plan import PlannerConfig, Policy, blank_observation
from egovcp.plan.config import OptimiserName
from egovcp_experiment.studies import study

#: Search -> its optimiser and iterations.
SEARCHES: Final[Mapping[str, tuple[OptimiserName, int]]] = {
    "cem": ("cem", 3),
    "cem_1": ("cem", 1),
    "cem_6": ("cem", 6),
    "icem": ("icem", 3),
    "mppi": ("mppi", 3),
    "shooting": ("shooting", 1),
}
_FEW: Final = 256
_MANY: Final = 1024
_MULTIPLE: Final = 32  # numbers of candidates are multiples of it
_MOST: Final = 65_536


@dataclass(frozen=True)
class PlanTimeConfig(study.StudyConfig):
    """Find the number of candidates that each search can evaluate in equal time."""

    budget_ms: float = bounded(40.0, above=0)
    """Time for a plan of one robot, ms."""
    rounds: int = bounded(9, least=1)
    """Timed plans of each search."""


def measure(config: PlanTimeConfig) -> None:
    """Time the searches and write the numbers of candidates."""
    artifact = config.load()
    policies = {}
    for name, (optimiser, iterations) in SEARCHES.items():
        for samples in (_FEW, _MANY):
            planner = replace(
                artifact.planner,
                optimiser=optimiser,
                iterations=iterations,
                samples=samples,
                elites=min(artifact.planner.elites, samples // 2),
            )
            policies[name, samples] = artifact.make_policy(planner=planner)
            policies[name, samples].prepare()
    times = _median_times(policies, config.rounds)
    searches = {
        name: _affordable(
            artifact.planner, name, times[name, _FEW], times[name, _MANY], config.budget_ms
        )
        for name in SEARCHES
    }
    config.write({"budget_ms": config.budget_ms, "searches": searches})


def _median_times[K](policies: Mapping[K, Policy], rounds: int) -> dict[K, float]:
    """Median time of a plan, ms, of policies of one robot."""
    robot = next(iter(policies.values())).model.robot
    depth, state = blank_observation(1, robot)
    times: dict[K, list[float]] = {key: [] for key in policies}
    for turn in range(rounds + 1):
        for key, policy in policies.items():
            start = time.perf_counter()
            policy.act(depth, state)
            if turn:  # the first one warms up
                times[key].append(1e3 * (time.perf_counter() - start))
    return {key: statistics.median(values) for key, values in times.items()}


def _affordable(
    planner: PlannerConfig, search: str, few_ms: float, many_ms: float, budget_ms: float
) -> dict[str, Any]:
    """Options of the search with the most candidates in the budget, `_MULTIPLE` to `_MOST`.

    Raises:
        EnvironmentFailure: plans with more candidates took less time.
    """
    optimiser, iterations = SEARCHES[search]
    if many_ms <= few_ms:
        raise EnvironmentFailure(
            f"timing too noisy: plans of {search} took {few_ms:.2f} ms with {_FEW} candidates and "
            f"{many_ms:.2f} ms with {_MANY}; stop other programs, or increase --rounds"
        )
    slope = (many_ms - few_ms) / (_MANY - _FEW)
    room = _FEW + (budget_ms - few_ms) / slope
    samples = min(max(_MULTIPLE, int(room // _MULTIPLE) * _MULTIPLE), _MOST)
    return {
        "optimiser": optimiser,
        "iterations": iterations,
        "samples": samples,
        "elites": min(planner.elites, samples // 2),  # docs/planner.md
        "plan_ms": few_ms + slope * (samples - _FEW),
        "within_budget": room >= _MULTIPLE,
    }


main = study.make_main("plan_time", PlanTimeConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
