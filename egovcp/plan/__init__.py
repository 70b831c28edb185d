"""Sampling-based planning in a learned model, and the policy that uses it."""

from egovcp.plan.config import PlannerConfig, require_affordable, require_compatible
from egovcp.plan.objective import PlanEvaluator, ReferenceEvaluator
from egovcp.plan.optimisers import optimiser_of
from egovcp.plan.policy import Policy, PolicyStep, blank_observation
from egovcp.plan.search import Optimiser, Plan, make_plan, time_left_until
from egovcp.plan.value_map import HandGrid, hand_grid, held_value, value_map

__all__ = [
    "HandGrid",
    "Optimiser",
    "Plan",
    "PlanEvaluator",
    "PlannerConfig",
    "Policy",
    "PolicyStep",
    "ReferenceEvaluator",
    "blank_observation",
    "hand_grid",
    "held_value",
    "make_plan",
    "optimiser_of",
    "require_affordable",
    "require_compatible",
    "time_left_until",
    "value_map",
]
