"""Loads the weights of a world model from an untrusted safetensors file.

Names and shapes in the header of the file are compared with the configuration before any network is
allocated; values are checked before the model is returned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from egovcp.files import UnsafeFileError
from egovcp.model.config import WorldModelConfig
from egovcp.model.world_model import WorldModel
from egovcp.robot_spec import G1, RobotSpec
from egovcp.tensor_file import HEADER_LIMIT_BYTES, TensorFile

MAX_WEIGHT_BYTES: Final = 512 << 20
"""Upper limit of the size of a model's weights, float32."""
DTYPES: Final = ("F32", "F16", "BF16")
"""Dtypes accepted in the file; all are loaded as float32."""

_POSITIVE: Final = ("state_std", "return_std")
_BYTES: Final = 4  # of a float32


def tensor_shapes(config: WorldModelConfig, robot: RobotSpec = G1) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor of a model's state; nothing is allocated.

    Raises:
        ValueError: the model has more than `MAX_WEIGHT_BYTES`.
    """
    with torch.device("meta"):
        state = WorldModel(config, robot).state_dict()
    size = sum(tensor.numel() for tensor in state.values()) * _BYTES
    if size > MAX_WEIGHT_BYTES:
        raise ValueError(
            f"world_model describes networks of {size / 1e6:.0f} MB, expected at most "
            f"{MAX_WEIGHT_BYTES / 1e6:.0f} MB"
        )
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def size_limit(shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Largest size of a file of these tensors, bytes."""
    return HEADER_LIMIT_BYTES + _BYTES * sum(math.prod(shape) for shape in shapes.values())


def load_model(
    config: WorldModelConfig,
    shapes: Mapping[str, tuple[int, ...]],
    content: bytes,
    robot: RobotSpec = G1,
) -> WorldModel:
    """Build a model in evaluation mode with the weights of a file.

    Args:
        shapes: its `tensor_shapes`.
        content: bytes of the file.

    Raises:
        UnsafeFileError: the tensors do not match the configuration, a value is not finite, or an
            output of the model for an empty image is not finite.
    """
    file = TensorFile.parse(content)
    file.require(shapes, DTYPES)
    try:
        weights = {name: tensor.float() for name, tensor in load(content).items()}
    except SafetensorError as error:
        raise UnsafeFileError(f"not a safetensors file: {error}") from error
    _check_numbers(weights)
    model = WorldModel(config, robot)
    model.load_state_dict(weights)
    model.eval()
    _check_outputs(model)
    return model


def _check_numbers(weights: Mapping[str, Tensor]) -> None:
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise UnsafeFileError(f"tensor {name} holds NaN or infinite numbers")
    for name in _POSITIVE:
        if not (weights[name] > 0).all():
            raise UnsafeFileError(f"tensor {name} holds numbers that are not positive")
    discount = float(weights["discount"])
    if not 0 <= discount <= 1:
        raise UnsafeFileError(f"tensor discount is {discount:g}, expected 0 to 1")


@torch.inference_mode()
def _check_outputs(model: WorldModel) -> None:
    """Finite weights may still overflow: filter an empty image and evaluate the neutral action."""
    action = torch.zeros(1, model.robot.action_dim)
    depth = torch.zeros(1, *model.robot.depth, dtype=torch.int32)
    first = torch.ones(1, dtype=torch.bool)
    carry = model.observe(model.initial(1), action, depth, model.state_mean[None], first)
    carry = model.imagine(carry, action)
    outputs = {
        "state": carry.h,
        "latent": carry.z,
        "value": model.value(carry, action),
        "termination": model.termination(carry),
    }
    for name, output in outputs.items():
        if not output.isfinite().all():
            raise UnsafeFileError(
                f"the weights overflow: the {name} after an empty image is not finite"
            )
