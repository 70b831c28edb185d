"""How many candidates each search can weigh in the time there is for a plan.

The time of a plan is a + b M of M candidates a round; both follow from plans of few and of many,
made in turns, so that a busy machine hits all searches alike.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from egovcp.artifact import Artifact
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.plan import PlannerConfig, Policy
from egovcp.plan.config import OptimiserName
from egovcp.policy_options import PlannerOptions
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS, STATE_DIM
from egovcp_experiment.studies.study import StudyConfig, finish

PROG: Final = "python -m egovcp_experiment.studies.plan_time"
#: Search -> its optimiser, and rounds.
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
_STEP: Final = 32  # candidates are a multiple of it
_MOST: Final = 65_536


@dataclass(frozen=True)
class PlanTimeConfig(StudyConfig):
    """Find the candidates that each search affords in equal time."""

    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the artifact's planner, whose number of elites all searches keep."""
    budget_ms: float = 40.0
    """Time for a plan of one robot, ms."""
    rounds: int = 9
    """Times that every search takes its turn."""


def measure(config: PlanTimeConfig) -> None:
    """Time the searches and write what each affords."""
    if config.budget_ms <= 0 or config.rounds < 1:
        raise UsageError("--budget_ms must be above 0, and --rounds at least 1")
    artifact = config.load(config.planner)
    policies = {
        (name, samples): _policy(artifact, name, samples)
        for name in SEARCHES
        for samples in (_FEW, _MANY)
    }
    times = _in_turns(policies, config.rounds)
    searches = {
        name: _afforded(
            artifact.planner, name, times[name, _FEW], times[name, _MANY], config.budget_ms
        )
        for name in SEARCHES
    }
    finish(config, {"budget_ms": config.budget_ms, "searches": searches})


def _policy(artifact: Artifact, search: str, samples: int) -> Policy:
    policy = artifact.make_policy(planner=_planner(artifact.planner, search, samples))
    policy.prepare()
    return policy


def _planner(planner: PlannerConfig, search: str, samples: int) -> PlannerConfig:
    optimiser, iterations = SEARCHES[search]
    return replace(
        planner,
        optimiser=optimiser,
        iterations=iterations,
        samples=samples,
        elites=_elites(planner, samples),
    )


def _elites(planner: PlannerConfig, samples: int) -> int:
    """As many as the planner's own, for it is their number that decides what their mean is worth
    (docs/planner.md), and at most half of the candidates."""
    return min(planner.elites, samples // 2)


def _in_turns[K](policies: Mapping[K, Policy], rounds: int) -> dict[K, float]:
    """Median time of a plan, ms."""
    depth = np.full((1, DEPTH_ROWS, DEPTH_COLS), 3000, np.uint16)
    state = np.zeros((1, STATE_DIM), np.float32)
    times: dict[K, list[float]] = {key: [] for key in policies}
    for turn in range(rounds + 1):
        for key, policy in policies.items():
            start = time.perf_counter()
            policy.act(depth, state)
            if turn:  # the first one warms up
                times[key].append(1e3 * (time.perf_counter() - start))
    return {key: statistics.median(values) for key, values in times.items()}


def _afforded(
    planner: PlannerConfig, search: str, few_ms: float, many_ms: float, budget_ms: float
) -> dict[str, Any]:
    """The largest number of candidates whose plan is in time, from `_STEP` to `_MOST`."""
    optimiser, iterations = SEARCHES[search]
    slope = max((many_ms - few_ms) / (_MANY - _FEW), 1e-9)
    room = _FEW + (budget_ms - few_ms) / slope
    samples = min(max(_STEP, int(room // _STEP) * _STEP), _MOST)
    return {
        "optimiser": optimiser,
        "iterations": iterations,
        "samples": samples,
        "elites": _elites(planner, samples),
        "plan_ms": few_ms + slope * (samples - _FEW),
        "measured_ms": {str(_FEW): few_ms, str(_MANY): many_ms},
    }


CONFIG = PlanTimeConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CONFIG, measure, argv, prog=PROG)


if __name__ == "__main__":
    sys.exit(main())
