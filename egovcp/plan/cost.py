"""Estimates what a plan costs, so that a planner which cannot run is refused before it starts."""

from __future__ import annotations

from typing import Final, NamedTuple

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import WorldModelConfig
from egovcp.model.value import width
from egovcp.plan.config import PlannerConfig

MAX_SECONDS: Final = 10.0
"""Largest estimate of the time of a plan for one robot."""
MAX_BYTES: Final = 256 << 20
"""Largest estimate of the memory of a plan for one robot."""

_PRODUCTS_PER_S: Final = 4e10  # multiply-adds of one processor core, float32
_FLOATS_PER_S: Final = 2e9  # element-wise operations
_CALL_S: Final = 5e-4  # overhead of the operations of one step, whatever the number of samples
_ACTION_COPIES: Final = 8  # noise, deltas, actions, and what the optimisers derive from them
_BYTES: Final = 4


class PlanCost(NamedTuple):
    """Of a plan for one robot."""

    seconds: float
    """On one processor core."""
    memory_bytes: int


def plan_cost(model: WorldModelConfig, planner: PlannerConfig) -> PlanCost:
    """Estimate time and memory of a plan for one robot, on one core without a GPU."""
    samples, iterations, actions = planner.samples, planner.iterations, planner.actions
    steps = samples * actions * iterations
    floats = _floats_per_step(model)
    per_step = _products_per_step(model) / _PRODUCTS_PER_S + floats / _FLOATS_PER_S
    seconds = steps * per_step + actions * iterations * _CALL_S
    memory = _BYTES * samples * (actions * spec.ACTION_DIM * _ACTION_COPIES + floats)
    return PlanCost(seconds, memory)


def require_affordable(model: WorldModelConfig, planner: PlannerConfig) -> None:
    """Raise `UsageError`, which states the estimate, for a plan that takes too long or too much
    memory for one robot."""
    cost = plan_cost(model, planner)
    if cost.seconds > MAX_SECONDS or cost.memory_bytes > MAX_BYTES:
        raise UsageError(
            f"planner.samples={planner.samples}, "
            f"planner.horizon={planner.horizon} and "
            f"planner.iterations={planner.iterations} take about {cost.seconds:,.1f} s on "
            f"one core and {cost.memory_bytes / 1e6:,.0f} MB for each plan of one robot with these "
            f"networks; expected at most {MAX_SECONDS:.0f} s and {MAX_BYTES / 1e6:.0f} MB: lower "
            "them"
        )


def _products_per_step(c: WorldModelConfig) -> int:
    """Multiply-adds of imagining and judging one step of one candidate."""
    state = c.hidden + c.latent
    transition = (c.latent + spec.ACTION_DIM) * c.units + (c.units + c.hidden) * 3 * c.hidden
    prior = c.hidden * c.units + c.units * 2 * c.latent
    value = (state + spec.ACTION_DIM + c.units + width(c.value_loss)) * c.units
    termination = (state + 1) * c.units
    return transition + prior + value + termination


def _floats_per_step(c: WorldModelConfig) -> int:
    """Intermediate results of one candidate, which are the memory that it takes, too."""
    return 8 * c.hidden + 9 * c.units + 4 * c.latent + width(c.value_loss)
