"""The steps that LeRobot takes before and after the policy: none that changes a number."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from lerobot_policy_egovcp.configuration_egovcp import EgovcpConfig


def make_egovcp_pre_post_processors(
    config: EgovcpConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's usual pipelines: rename, add a batch dimension, move to the device and back.

    Args:
        dataset_stats: kept beside the steps as LeRobot does, and applied to nothing: the
            statistics that count are in the world model.
    """
    pipelines: tuple[Any, Any] = make_default_pre_post_processors(
        config, dataset_stats, normalizer_device=config.device
    )
    return pipelines
