"""The simulated humanoid as a LeRobot environment.

LeRobot imports every installed distribution whose name begins with ``lerobot_env_``;
importing this one registers the environment type ``egovcp``.
"""

from lerobot_env_egovcp.configuration_egovcp import EgovcpEnvConfig
from lerobot_env_egovcp.environment_egovcp import LeRobotEgovcpEnv

__all__ = ["EgovcpEnvConfig", "LeRobotEgovcpEnv"]
