"""Planning in a learned model: the cross-entropy method and the policy built on it."""

from egovcp.plan.cem import Plan, PlannerConfig, plan_cem
from egovcp.plan.policy import Policy, PolicyStep

__all__ = ["Plan", "PlannerConfig", "Policy", "PolicyStep", "plan_cem"]
