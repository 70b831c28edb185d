"""A simulated G1 behind the protocol of LeRobot's bridge."""

from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.faults import InjectedFaults

__all__ = ["FakeBridge", "InjectedFaults", "Ports"]
