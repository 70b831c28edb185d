"""Robots that the runner can drive, one module per robot; `base` defines the interfaces."""

from egovcp_deploy.robots.base import ActionResult, LockstepRobot, RobotObservation

__all__ = ["ActionResult", "LockstepRobot", "RobotObservation"]
