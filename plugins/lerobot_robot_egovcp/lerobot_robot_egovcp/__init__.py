"""A Unitree G1 under an egovcp low-level controller, as a LeRobot robot.

LeRobot imports every installed distribution whose name begins with ``lerobot_robot_``;
importing this one registers the robot type ``egovcp_g1``.
"""

from lerobot_robot_egovcp.robot_egovcp import EgovcpG1, EgovcpG1Config

__all__ = ["EgovcpG1", "EgovcpG1Config"]
