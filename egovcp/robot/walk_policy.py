"""The trained part of walking: a small network in a safetensors file, and its export to ONNX.

A safetensors file has ``mean`` and ``std`` of the observation and ``layers.I.weight``/``.bias``;
its metadata are the schema's version, the `WalkConfig` of the training, and the provenance
(command, seed, steps). numpy evaluates it. The graph of an ONNX file maps the raw observation
(B, 95) to the action (B, 15); its metadata add joint names, gains, the neutral pose and the
observation's layout.
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

from egovcp.bounds import check_bounds
from egovcp.decode import decode, shown
from egovcp.errors import ArtifactError
from egovcp.files import write_bytes
from egovcp.packages import require_packages
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.robot.stance_table import standing_pose
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.spec import ACTION_BOX, JOINT_NAMES, STATE_NAMES
from egovcp.tensor_file import TensorFile, read_tensor_file

SCHEMA: Final = "egovcp-walk-1"
OBSERVATION_CLIP: Final = 10.0  # standard deviations
_LIMIT_BYTES: Final = 64 << 20

ONNX_SCHEMA: Final = "egovcp-walk-onnx-1"
_OPSET: Final = 17
_INPUT, _OUTPUT = "observation", "action"

#: Names of the numbers of the observation.
OBSERVATION_NAMES: Final = (
    *STATE_NAMES,
    "gait.sin_phase",
    "gait.cos_phase",
    "gait.amount",
    "odometry.velocity_x",
    "odometry.velocity_y",
    "odometry.turned",
    *(f"last_action.{name}" for name in JOINT_NAMES[:ACTIONS]),
)

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
    config: WalkConfig  # Of `walking.Walk`
    provenance: Mapping[str, Any]  # Command, seed and steps of its training

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
        count = sum(name.endswith(".weight") for name in file.shapes)
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


def export_onnx(policy: WalkPolicy, path: Path) -> None:
    """Write ``policy`` to ``path``.

    Raises:
        EnvironmentFailure: the package onnx is missing.
    """
    require_packages("egovcp", "exporting a controller", "onnx")
    import onnx

    model = onnx.helper.make_model(
        _graph(policy), opset_imports=[onnx.helper.make_opsetid("", _OPSET)], ir_version=9
    )
    onnx.helper.set_model_props(model, {k: _text(v) for k, v in metadata(policy).items()})
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))


def metadata(policy: WalkPolicy) -> dict[str, Any]:
    """What is needed to run the graph, and the policy's provenance."""
    return {
        "schema": ONNX_SCHEMA,
        "digest": policy.digest,
        "joint_names": list(JOINT_NAMES),
        "stiffness": STIFFNESS.tolist(),
        "damping": DAMPING.tolist(),
        "default_joint_position": standing_pose(ACTION_BOX.neutral[-1]).joints.tolist(),
        "action_joint_names": list(JOINT_NAMES[:ACTIONS]),
        "action_scale": policy.config.action_scale,
        "observation_names": list(OBSERVATION_NAMES),
        "config": draccus.encode(policy.config),
        "provenance": dict(policy.provenance),
    }


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _graph(policy: WalkPolicy) -> Any:
    """Sub, Div, Clip, then Gemm and Elu per layer."""
    from onnx import TensorProto, helper, numpy_helper

    constants = {
        "mean": policy.mean,
        "std": policy.std,
        "low": np.float32(-OBSERVATION_CLIP),
        "high": np.float32(OBSERVATION_CLIP),
    }
    nodes = [
        helper.make_node("Sub", [_INPUT, "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "std"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "low", "high"], ["hidden0"]),
    ]
    last = len(policy.layers) - 1
    for i, (weight, bias) in enumerate(policy.layers):
        constants |= {f"weight{i}": weight, f"bias{i}": bias}
        out = _OUTPUT if i == last else f"linear{i}"
        inputs = [f"hidden{i}", f"weight{i}", f"bias{i}"]
        nodes.append(helper.make_node("Gemm", inputs, [out], transB=1))
        if i < last:
            nodes.append(helper.make_node("Elu", [out], [f"hidden{i + 1}"]))
    return helper.make_graph(
        nodes,
        "egovcp_walk",
        [helper.make_tensor_value_info(_INPUT, TensorProto.FLOAT, ["batch", OBSERVATION_DIM])],
        [helper.make_tensor_value_info(_OUTPUT, TensorProto.FLOAT, ["batch", ACTIONS])],
        [numpy_helper.from_array(np.asarray(v), name) for name, v in constants.items()],
    )
