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
from egovcp.bounds import bounded, check_bounds
from egovcp.decode import decode, shown
from egovcp.errors import ArtifactError
from egovcp.files import write_bytes
from egovcp.model.depth import nearness
from egovcp.plan import PolicyStep
from egovcp.tensor_file import TensorFile, read_tensor_file

SCHEMA: Final = "egovcp-reactive-1"
KERNELS: Final = (8, 3, 3)
STRIDES: Final = (4, 2, 2)
_LIMIT_BYTES: Final = 64 << 20

type Layer = tuple[Tensor, Tensor]  # weight, bias


@dataclass(frozen=True)
class ReactiveConfig:
    """Sizes of the networks, and the number of stacked images."""

    frames: int = bounded(3, least=1, most=64)
    """Number of stacked depth images, the newest and those before it."""
    channels: tuple[int, int, int] = bounded((16, 32, 32), least=1, most=1024)
    """Channels of the three layers of the depth CNN; actor and critic have one each."""
    hidden: tuple[int, ...] = bounded((256, 128), least=1, most=8192, longest=16)
    """Hidden layers of actor and critic, after the CNN."""
    depth_max_m: float = bounded(spec.DEPTH_MAX_M, least=0.1, most=100)
    """Depth, in metres, at which nearness is 0."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True)
class _Content:
    """The JSON in the metadata of a file."""

    config: ReactiveConfig
    controller_id: str
    provenance: dict[str, Any]


class FrameStack:
    """The last depth images of E robots, for training and playing."""

    def __init__(self, robots: int, config: ReactiveConfig) -> None:
        self._max_m = config.depth_max_m
        shape = (robots, config.frames, spec.DEPTH_ROWS, spec.DEPTH_COLS)
        self._pictures = torch.zeros(shape)

    def push(self, depth: NDArray[np.uint16], fresh: NDArray[np.bool_]) -> Tensor:
        """Add depth (E, 48, 64) mm; returns nearness (E, frames, 48, 64), newest first.

        Rows with ``fresh`` (E,) start an episode: all their frames are set to the newest.
        """
        near = nearness(torch.from_numpy(depth.astype(np.int32)), self._max_m)[:, None]
        self._pictures = torch.cat([near, self._pictures[:, :-1]], 1)
        rows = torch.from_numpy(np.asarray(fresh))
        self._pictures[rows] = near[rows].expand(-1, self._pictures.shape[1], -1, -1)
        return self._pictures


@dataclass(frozen=True)
class ReactiveNetwork:
    """The actor: a CNN of the images, and an MLP of its output and the standardised state (ELU)."""

    mean: Tensor  # (74,)
    std: Tensor  # (74,)
    cnn: tuple[Layer, ...]
    mlp: tuple[Layer, ...]
    config: ReactiveConfig
    controller_id: str
    """Low-level controller of the training."""
    provenance: Mapping[str, Any]
    """Command, seed and steps of the training."""

    @torch.inference_mode()
    def __call__(self, pictures: Tensor, state: Tensor) -> Tensor:
        """Pictures (E, frames, 48, 64) and state (E, 74) -> actions (E, 7) in [-1, 1]."""
        x = pictures
        for (weight, bias), stride in zip(self.cnn, STRIDES, strict=True):
            x = F.elu(F.conv2d(x, weight, bias, stride))
        x = torch.cat([(state - self.mean) / self.std, x.flatten(1)], -1)
        for weight, bias in self.mlp[:-1]:
            x = F.elu(F.linear(x, weight, bias))
        return F.linear(x, *self.mlp[-1]).clamp(-1.0, 1.0)

    def save(self, path: Path) -> None:
        """Write the file."""
        content = {
            "config": draccus.encode(self.config),
            "controller_id": self.controller_id,
            "provenance": dict(self.provenance),
        }
        tensors = {name: tensor.contiguous() for name, tensor in self._tensors().items()}
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
            return cls._from(read_tensor_file(path, _LIMIT_BYTES))
        except OSError as error:
            raise ArtifactError(f"{path}: {error.strerror}; it cannot be read") from error
        except (SafetensorError, ValueError) as error:
            raise ArtifactError(
                f"{path}: not a policy of schema {SCHEMA} ({error}); train one with "
                "egovcp-train-ppo"
            ) from error

    def require_controller(self, controller_id: str) -> None:
        """Raise `ArtifactError` unless the robot has the controller of the training."""
        if controller_id != self.controller_id:
            raise ArtifactError(
                f"this policy was trained with the low-level controller {self.controller_id}, the "
                f"robot has {controller_id}; choose its --env.controller, or train again"
            )

    @classmethod
    def _from(cls, file: TensorFile) -> ReactiveNetwork:
        if file.metadata.get("schema") != SCHEMA:
            raise ValueError(f"its schema is {shown(file.metadata.get('schema'))}")
        content = decode(_Content, file.json_metadata("content"), "content")
        file.require(tensor_shapes(content.config))
        tensors = load(file.content)
        return cls.of(tensors, content.config, content.controller_id, content.provenance)

    @classmethod
    def of(
        cls,
        tensors: Mapping[str, Tensor],
        config: ReactiveConfig,
        controller_id: str,
        provenance: Mapping[str, Any],
    ) -> ReactiveNetwork:
        """A network from tensors with the names of `tensor_shapes`.

        Raises:
            KeyError: one is missing.
            ValueError: one is not of its shape, or not finite.
        """
        network = cls(
            tensors["mean"],
            tensors["std"],
            _layers(tensors, "cnn", len(KERNELS)),
            _layers(tensors, "mlp", len(config.hidden) + 1),
            config,
            controller_id,
            provenance,
        )
        network.check()
        return network

    def check(self) -> None:
        """Raise ValueError unless tensors have the configured shapes and finite values."""
        expected = tensor_shapes(self.config)
        for name, tensor in self._tensors().items():
            if tuple(tensor.shape) != expected[name]:
                shape = tuple(tensor.shape)
                raise ValueError(f"{name} has shape {shape}, expected {expected[name]}")
            if tensor.dtype != torch.float32 or not tensor.isfinite().all():
                raise ValueError(f"{name}: expected finite numbers of type float32")
        if (self.std <= 0).any():
            raise ValueError("a standard deviation is not positive")

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {"mean": self.mean, "std": self.std}
        for part, layers in (("cnn", self.cnn), ("mlp", self.mlp)):
            for i, (weight, bias) in enumerate(layers):
                tensors |= {f"{part}.{i}.weight": weight, f"{part}.{i}.bias": bias}
        return tensors


def _layers(tensors: Mapping[str, Tensor], part: str, count: int) -> tuple[Layer, ...]:
    return tuple((tensors[f"{part}.{i}.weight"], tensors[f"{part}.{i}.bias"]) for i in range(count))


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
        self._fresh = np.ones(self._robots, dtype=np.bool_)

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """Depth (E, 48, 64) mm and state (E, 74) -> actions, without a plan."""
        pictures = self._push(depth)
        action = self._network(pictures, torch.as_tensor(state, dtype=torch.float32)).numpy()
        return PolicyStep(action)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Add a depth image without acting."""
        self._push(depth)

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Does nothing: the next state contains the action."""

    def _push(self, depth: NDArray[np.uint16]) -> Tensor:
        pictures = self._frames.push(depth, self._fresh)
        self._fresh = np.zeros(self._robots, dtype=np.bool_)
        return pictures
