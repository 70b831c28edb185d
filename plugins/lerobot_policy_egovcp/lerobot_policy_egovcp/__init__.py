"""The ego-vision world model as a LeRobot policy.

LeRobot imports every installed distribution whose name begins with ``lerobot_policy_``;
importing this one registers the policy type ``egovcp``.
"""

from lerobot_policy_egovcp.configuration_egovcp import EgovcpConfig
from lerobot_policy_egovcp.modeling_egovcp import EgovcpPolicy
from lerobot_policy_egovcp.processor_egovcp import make_egovcp_pre_post_processors

__all__ = ["EgovcpConfig", "EgovcpPolicy", "make_egovcp_pre_post_processors"]
