"""The trained part of walking: a small network in a safetensors file, evaluated with numpy.

The file holds ``mean`` and ``std`` of the observation and ``layers.I.weight``/``.bias``; its
metadata hold, as JSON, the schema's version, the `WalkConfig` that the network was trained
with, and where it comes from (command, seed, steps).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import draccus
import numpy as np
from draccus.utils import DraccusException
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from egovcp.errors import ArtefactError, UsageError
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig

SCHEMA: Final = "egovcp-walk-1"
OBSERVATION_CLIP: Final = 10.0  # standard deviations: one wild measurement must not kick

Array32 = NDArray[np.float32]


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
        save_file(
            {name: np.ascontiguousarray(array) for name, array in tensors.items()},
            path,
            metadata={"schema": SCHEMA, "content": json.dumps(content)},
        )

    @classmethod
    def load(cls, path: Path) -> WalkPolicy:
        """Read and check a file.

        Raises:
            ArtefactError: missing, damaged, of another schema or of another observation.
        """
        if not path.is_file():
            raise ArtefactError(
                f"{path}: no such controller; expected a .safetensors file that "
                "egovcp-train-lowlevel wrote"
            )
        try:
            with safe_open(path, framework="numpy") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return cls._from(tensors, metadata)
        except (SafetensorError, KeyError, ValueError, TypeError, DraccusException) as error:
            reason = " ".join(str(error).split())[:200]
            raise ArtefactError(
                f"{path}: not a controller of schema {SCHEMA} ({reason}); train one with "
                "egovcp-train-lowlevel"
            ) from error

    @classmethod
    def _from(cls, tensors: dict[str, Any], metadata: Mapping[str, str]) -> WalkPolicy:
        if metadata.get("schema") != SCHEMA:
            raise ValueError(f"its schema is {metadata.get('schema')!r}")
        content = json.loads(metadata["content"])
        count = sum(name.endswith(".weight") for name in tensors)
        layers = tuple(
            (tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"]) for i in range(count)
        )
        try:
            config = draccus.decode(WalkConfig, content["config"])
        except UsageError as error:
            raise ValueError(str(error)) from error
        policy = cls(tensors["mean"], tensors["std"], layers, config, content["provenance"])
        policy.check()
        return policy

    def check(self) -> None:
        """Raise ValueError unless shapes, types and numbers are those of a policy."""
        width = OBSERVATION_DIM
        for name, array in (("mean", self.mean), ("std", self.std)):
            if array.shape != (width,):
                raise ValueError(f"{name} has shape {array.shape}, expected ({width},)")
        for i, (weight, bias) in enumerate(self.layers):
            if weight.shape != (len(bias), width):
                raise ValueError(f"layer {i} has shape {weight.shape}, expected (*, {width})")
            width = len(bias)
        if width != ACTIONS:
            raise ValueError(f"it has {width} outputs, expected {ACTIONS}")
        arrays = (self.mean, self.std, *(a for layer in self.layers for a in layer))
        if any(a.dtype != np.float32 or not np.isfinite(a).all() for a in arrays):
            raise ValueError("expected finite numbers of type float32")
        if (self.std <= 0).any():
            raise ValueError("a standard deviation is not positive")
