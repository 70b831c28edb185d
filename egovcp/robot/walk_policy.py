"""The trained part of walking: a small network in a safetensors file, evaluated with numpy.

The file holds ``mean`` and ``std`` of the observation and ``layers.I.weight``/``.bias``; its
metadata hold, as JSON, the schema's version, the `WalkConfig` that the network was trained
with, and where it comes from (command, seed, steps).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import draccus
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from egovcp.atomic import write_bytes
from egovcp.bounds import check_bounds
from egovcp.decode import decode, shown
from egovcp.errors import ArtifactError
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.tensor_file import TensorFile, read_tensor_file

SCHEMA: Final = "egovcp-walk-1"
OBSERVATION_CLIP: Final = 10.0  # standard deviations: one wild measurement must not kick
_LIMIT_BYTES: Final = 64 << 20

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class _Content:
    """The metadata's JSON."""

    config: WalkConfig
    provenance: dict[str, Any]


@dataclass(frozen=True)
class WalkPolicy:
    """An MLP with ELU between its layers, on standardised observations."""

    mean: Array32  # (95,)
    std: Array32  # (95,)
    layers: tuple[tuple[Array32, Array32], ...]  # weight (out, in), bias (out,)
    config: WalkConfig
    """What surrounds the network (`walking.Walk`)."""
    provenance: Mapping[str, Any]
    """Command, seed and steps of its training."""

    def __call__(self, observation: Array32) -> Array32:
        """(B, 95) -> actions (B, 15); a row's bits do not depend on the batch."""
        x = np.clip((observation - self.mean) / self.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        for i, (weight, bias) in enumerate(self.layers):
            x = (weight @ x[:, :, None])[:, :, 0] + bias
            if i + 1 < len(self.layers):
                x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
        return x

    @property
    def digest(self) -> str:
        """8 hexadecimal digits that change with any number."""
        out = hashlib.sha256(repr(self.config).encode())
        for array in (self.mean, self.std, *(a for layer in self.layers for a in layer)):
            out.update(np.ascontiguousarray(array).tobytes())
        return out.hexdigest()[:8]

    def save(self, path: Path) -> None:
        """Write the file."""
        tensors = {"mean": self.mean, "std": self.std}
        for i, (weight, bias) in enumerate(self.layers):
            tensors |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
        content = {"config": draccus.encode(self.config), "provenance": dict(self.provenance)}
        arrays = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
        metadata = {"schema": SCHEMA, "content": json.dumps(content, allow_nan=False)}
        write_bytes(path, save(arrays, metadata))

    @classmethod
    def load(cls, path: Path) -> WalkPolicy:
        """Read and check a file.

        Raises:
            ArtifactError: missing, damaged, of another schema or of another observation.
        """
        if not os.path.lexists(path):
            raise ArtifactError(
                f"{path}: no such controller; expected a .safetensors file that "
                "egovcp-train-lowlevel wrote"
            )
        try:
            return cls._from(read_tensor_file(path, _LIMIT_BYTES))
        except OSError as error:
            raise ArtifactError(f"{path}: {error.strerror}; it cannot be read") from error
        except (SafetensorError, ValueError) as error:
            raise ArtifactError(
                f"{path}: not a controller of schema {SCHEMA} ({error}); train one with "
                "egovcp-train-lowlevel"
            ) from error

    @classmethod
    def _from(cls, file: TensorFile) -> WalkPolicy:
        if file.metadata.get("schema") != SCHEMA:
            raise ValueError(f"its schema is {shown(file.metadata.get('schema'))}")
        content = decode(_Content, file.json_metadata("content"), "content")
        count = sum(name.endswith(".weight") for name in file.tensors)
        names = {f"layers.{i}.{part}" for i in range(count) for part in ("weight", "bias")}
        names |= {"mean", "std"}
        file.require_names(names)
        tensors = load(file.content)
        layers = tuple(
            (tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"]) for i in range(count)
        )
        check_bounds(content.config, "content.config.")
        policy = cls(tensors["mean"], tensors["std"], layers, content.config, content.provenance)
        policy.check()
        return policy

    def check(self) -> None:
        """Raise ValueError unless shapes, types and numbers are those of a policy."""
        width = OBSERVATION_DIM
        for name, array in (("mean", self.mean), ("std", self.std)):
            if array.shape != (width,):
                raise ValueError(f"{name} has shape {array.shape}, expected ({width},)")
        for i, (weight, bias) in enumerate(self.layers):
            if bias.ndim != 1 or weight.shape != (len(bias), width):
                raise ValueError(f"layer {i} has shape {weight.shape}, expected (*, {width})")
            width = len(bias)
        if width != ACTIONS:
            raise ValueError(f"it has {width} outputs, expected {ACTIONS}")
        arrays = (self.mean, self.std, *(a for layer in self.layers for a in layer))
        if any(a.dtype != np.float32 or not np.isfinite(a).all() for a in arrays):
            raise ValueError("expected finite numbers of type float32")
        if (self.std <= 0).any():
            raise ValueError("a standard deviation is not positive")
