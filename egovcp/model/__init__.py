"""The world model: networks, recurrence and losses. Imports neither data nor a simulator."""

from egovcp.model.config import PRESETS, LossConfig, WorldModelConfig
from egovcp.model.latent_state import Carry
from egovcp.model.losses import Batch
from egovcp.model.objective import (
    StepNoise,
    sample_step_noise,
    world_model_gradients,
    world_model_loss,
)
from egovcp.model.world_model import WorldModel

__all__ = [
    "PRESETS",
    "Batch",
    "Carry",
    "LossConfig",
    "StepNoise",
    "WorldModel",
    "WorldModelConfig",
    "sample_step_noise",
    "world_model_gradients",
    "world_model_loss",
]
