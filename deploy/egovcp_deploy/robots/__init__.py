"""Robots that the runner can drive: one small Protocol, one module per robot."""

from egovcp_deploy.robots.base import Outcome, Robot, Sensed

__all__ = ["Outcome", "Robot", "Sensed"]
