"""A G1 that is not there: the simulator behind the wire of LeRobot's bridge."""

from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.faults import Faults

__all__ = ["FakeBridge", "Faults", "Ports"]
