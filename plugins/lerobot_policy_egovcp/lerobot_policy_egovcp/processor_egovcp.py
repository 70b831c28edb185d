"""Pre- and postprocessors of the policy, which change no values."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors
from torch import Tensor

from lerobot_policy_egovcp.configuration_egovcp import EgovcpConfig


def make_egovcp_pre_post_processors(
    config: EgovcpConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """LeRobot's default pipelines: rename, add a batch dimension, move to the device and back.

    Args:
        dataset_stats: stored as LeRobot does, but unused; the world model has its own.
    """
    pipelines: tuple[Any, Any] = make_default_pre_post_processors(
        config, dataset_stats, normalizer_device=config.device
    )
    return pipelines
