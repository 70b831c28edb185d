"""A policy without a world model: recent depth images and proprioception to an action.

``egovcp-train-ppo`` trains it, ``egovcp-eval --controllers=ppo`` plays it. Its safetensors file
holds ``mean`` and ``std`` of the state, and ``.weight`` and ``.bias`` of ``cnn.I`` and ``mlp.I``.
Metadata: the schema, and as JSON the `ReactiveConfig`, the controller id and the provenance.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import draccus
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from egovcp import spec
from egovcp.bounds import OutOfBounds, bounded, check_bounds
from egovcp.decode import decode, shown
from egovcp.errors import ArtifactError
from egovcp.files import write_bytes
from egovcp.model.depth import nearness
from egovcp.plan import PolicyStep
from egovcp.tensor_file import read_tensor_file

SCHEMA: Final = "egovcp-reactive-1"
KERNELS: Final = (8, 3, 3)
STRIDES: Final = (4, 2, 2)
_LIMIT_BYTES: Final = 64 << 20


@dataclass(frozen=True)
class ReactiveConfig:
    """Sizes of the networks, and the number of stacked images."""

    frames: int = bounded(3, least=1, most=64)
    """Number of stacked depth images, the newest and those before it."""
    channels: tuple[int, int, int] = bounded((16, 32, 32), least=1, most=1024)
    """Channels of the three layers of the depth CNN; actor and critic have one each."""
    hidden: tuple[int, ...] = bounded((256, 128), least=1, most=8192, longest=16)
    """Hidden layers of actor and critic, after the CNN."""

    def __post_init__(self) -> None:
        check_bounds(self)
        if not self.hidden:
            raise OutOfBounds("hidden", self.hidden, "at least one layer")


@dataclass(frozen=True)
class _Content:
    """The JSON in the metadata of a file."""

    config: ReactiveConfig
    controller_id: str
    provenance: dict[str, Any]


class FrameStack:
    """The last depth images of E robots, for training and playing."""

    def __init__(self, robots: int, config: ReactiveConfig) -> None:
        self._images = torch.zeros(robots, config.frames, spec.DEPTH_ROWS, spec.DEPTH_COLS)

    def push(self, depth: NDArray[np.uint16], is_first: NDArray[np.bool_]) -> Tensor:
        """Add depth (E, 48, 64) mm; returns nearness (E, frames, 48, 64), newest first.

        Rows with ``is_first`` (E,) start an episode: all their frames are set to the newest.
        """
        near = nearness(torch.from_numpy(depth.astype(np.int32)), spec.DEPTH_MAX_M)[:, None]
        self._images = torch.cat([near, self._images[:, :-1]], 1)
        rows = torch.from_numpy(np.asarray(is_first))
        self._images[rows] = near[rows].expand(-1, self._images.shape[1], -1, -1)
        return self._images


@dataclass(frozen=True)
class ReactiveNetwork:
    """The actor: a CNN of the images, and an MLP of its output and the standardised state (ELU)."""

    tensors: Mapping[str, Tensor]
    """By the names of `tensor_shapes`."""
    config: ReactiveConfig
    controller_id: str
    """Low-level controller of the training."""
    provenance: Mapping[str, Any]
    """Command, seed and steps of the training."""

    @torch.inference_mode()
    def __call__(self, images: Tensor, state: Tensor) -> Tensor:
        """Nearness (E, frames, 48, 64) and state (E, 74) -> actions (E, 7) in [-1, 1]."""
        x = images
        for i, stride in enumerate(STRIDES):
            x = F.elu(F.conv2d(x, *self._layer("cnn", i), stride))
        standardised = (state - self.tensors["mean"]) / self.tensors["std"]
        x = torch.cat([standardised, x.flatten(1)], -1)
        depth = len(self.config.hidden)
        for i in range(depth):
            x = F.elu(F.linear(x, *self._layer("mlp", i)))
        return F.linear(x, *self._layer("mlp", depth)).clamp(-1.0, 1.0)

    def _layer(self, part: str, index: int) -> tuple[Tensor, Tensor]:
        name = f"{part}.{index}"
        return self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"]

    def save(self, path: Path) -> None:
        """Write the file."""
        content = {
            "config": draccus.encode(self.config),
            "controller_id": self.controller_id,
            "provenance": dict(self.provenance),
        }
        tensors = {name: tensor.contiguous() for name, tensor in self.tensors.items()}
        metadata = {"schema": SCHEMA, "content": json.dumps(content, allow_nan=False)}
        write_bytes(path, save(tensors, metadata))

    @classmethod
    def load(cls, path: Path) -> ReactiveNetwork:
        """Read and check a file.

        Raises:
            ArtifactError: missing, damaged, or of another schema.
        """
        if not os.path.lexists(path):
            raise ArtifactError(
                f"{path}: no such policy; expected a .safetensors file that egovcp-train-ppo wrote"
            )
        try:
            file = read_tensor_file(path, _LIMIT_BYTES)
            if file.metadata.get("schema") != SCHEMA:
                raise ValueError(f"its schema is {shown(file.metadata.get('schema'))}")
            content = _decode(file.json_metadata("content"))
            file.require(tensor_shapes(content.config))
            tensors = load(file.content)
            if not all(tensor.isfinite().all() for tensor in tensors.values()):
                raise ValueError("a number is not finite")
            if (tensors["std"] <= 0).any():
                raise ValueError("a standard deviation is not positive")
        except OSError as error:
            raise ArtifactError(f"{path}: {error.strerror}; it cannot be read") from error
        except (SafetensorError, ValueError) as error:
            raise ArtifactError(
                f"{path}: not a policy of schema {SCHEMA} ({error}); train one with "
                "egovcp-train-ppo"
            ) from error
        return cls(tensors, content.config, content.controller_id, content.provenance)

    def require_controller(self, controller_id: str) -> None:
        """Raise `ArtifactError` unless the robot has the controller of the training."""
        if controller_id != self.controller_id:
            raise ArtifactError(
                f"this policy was trained with the low-level controller {self.controller_id}, the "
                f"robot has {controller_id}; choose its --env.controller, or train again"
            )


def _decode(content: Any) -> _Content:
    """Raises `DecodeError`; files of earlier versions have the range of the camera, too."""
    config = content.get("config") if isinstance(content, dict) else None
    if isinstance(config, dict) and config.get("depth_max_m") == spec.DEPTH_MAX_M:
        del config["depth_max_m"]
    return decode(_Content, content, "content")


def tensor_shapes(config: ReactiveConfig) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every tensor in the file."""
    shapes: dict[str, tuple[int, ...]] = {"mean": (spec.STATE_DIM,), "std": (spec.STATE_DIM,)}
    rows, cols = spec.DEPTH_ROWS, spec.DEPTH_COLS
    ends = pairwise((config.frames, *config.channels))
    for i, ((before, after), k, stride) in enumerate(zip(ends, KERNELS, STRIDES, strict=True)):
        shapes |= {f"cnn.{i}.weight": (after, before, k, k), f"cnn.{i}.bias": (after,)}
        rows, cols = (rows - k) // stride + 1, (cols - k) // stride + 1
    inputs = spec.STATE_DIM + config.channels[-1] * rows * cols
    for i, (before, after) in enumerate(pairwise((inputs, *config.hidden, spec.ACTION_DIM))):
        shapes |= {f"mlp.{i}.weight": (after, before), f"mlp.{i}.bias": (after,)}
    return shapes


class ReactivePolicy:
    """Plays the network for E robots; call `act` or `observe` once per tick."""

    def __init__(self, network: ReactiveNetwork, robots: int) -> None:
        self._network, self._robots = network, robots
        self.reset()

    def reset(self) -> None:
        """Start an episode of every robot."""
        self._frames = FrameStack(self._robots, self._network.config)
        self._is_first = np.ones(self._robots, dtype=np.bool_)

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Depth (E, 48, 64) mm and state (E, 74) -> actions, without a plan."""
        images = self._push(depth)
        action = self._network(images, torch.as_tensor(state, dtype=torch.float32)).numpy()
        return PolicyStep(action)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Add a depth image without acting."""
        self._push(depth)

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Does nothing: the next state contains the action."""

    def _push(self, depth: NDArray[np.uint16]) -> Tensor:
        images = self._frames.push(depth, self._is_first)
        self._is_first = np.zeros(self._robots, dtype=np.bool_)
        return images
