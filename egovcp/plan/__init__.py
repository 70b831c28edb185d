"""Planning in a learned model: the cross-entropy method and the policy built on it."""

from egovcp.plan.cem import Plan, PlannerConfig, plan_cem
from egovcp.plan.policy import Policy, PolicyStep
from egovcp.plan.value_map import HandGrid, hand_grid, value_map

__all__ = [
    "HandGrid",
    "Plan",
    "PlannerConfig",
    "Policy",
    "PolicyStep",
    "hand_grid",
    "plan_cem",
    "value_map",
]
