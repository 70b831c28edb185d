"""``egovcp-export``: the planner's networks as ONNX, or the policy with weights in half precision.

``--format=float16`` writes `egovcp_train.half_precision`; ``--format=onnx``:

golden.safetensors   inputs/NAME and outputs/NETWORK/NAME, from the original
export.json          features, controller, planner, SHA-256 and shapes
observe.onnx         h, z, action, depth, state, is_first  ->  h_next, z_next
imagine.onnx         h, z, action                          ->  h_next, z_next
value.onnx           h, z, action                          ->  value
termination.onnx     h, z                                  ->  termination
reward.onnx          h, z, action                          ->  reward         if it is predicted

A graph is one tick of a batch of independent rows. It contains the normalisation: depth is in
millimetres, proprioception in SI units, values in units of return. A planner repeats the row of a
robot for each of its candidates.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import draccus
import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save
from torch import Tensor, nn

from egovcp.artifact import WEIGHTS, Artifact, load_artifact
from egovcp.cli import run_command
from egovcp.errors import ArtifactError, UsageError
from egovcp.files import removed_on_error, sha256, write_bytes, write_text
from egovcp.manifest import MANIFEST
from egovcp.model import Carry, WorldModel
from egovcp.packages import require_packages
from egovcp.policy_options import PolicyOptions
from egovcp.terminal import echo
from egovcp_train.checkpoint import prepare_output
from egovcp_train.half_precision import write_half_precision
from egovcp_train.publish import CARD, card_text

PROG = "egovcp-export"
SCHEMA: Final = "egovcp-onnx-1"
OPSET: Final = 17
GOLDEN, REPORT = "golden.safetensors", "export.json"
TOLERANCE: Final = 1e-4  # of the reference's magnitude where that exceeds 1
_ROWS: Final = 7  # of the golden vectors; other than what is traced
_TRACED_ROWS: Final = 2


@dataclass(frozen=True)
class ExportConfig:
    """Write the networks that the planner calls as ONNX, and verify them with onnxruntime.

    golden.safetensors has inputs and the outputs of the original, to verify other runtimes.
    --format=float16 writes a copy of the artifact in half the size, and its card.
    """

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The artifact."""
    output_dir: str = ""
    """New folder for the result."""
    format: Literal["onnx", "float16"] = "onnx"
    """onnx: networks for other runtimes; float16: an artifact with weights in half precision."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(ExportConfig, export, argv, prog=PROG)


def export(config: ExportConfig) -> None:
    """Write the networks, verify them, and print their largest errors; or write the artifact.

    Raises:
        UsageError: artifact or folder are missing, or the folder is not empty.
        ArtifactError: the artifact is damaged, a network differs from the original, or a weight
            exceeds the range of float16.
        EnvironmentFailure: onnx or onnxruntime is missing, or the folder cannot be written.
    """
    if not config.policy.path or not config.output_dir:
        raise UsageError(
            "--policy.path and --output_dir are needed: the artifact, and a new folder"
        )
    onnx = config.format == "onnx"
    if onnx:
        require_packages("egovcp-train", PROG, "onnx", "onnxruntime")
    output = prepare_output(config.output_dir, resume=False, resumable=False)
    artifact = load_artifact(config.policy.path, config.policy.revision)
    with removed_on_error(output.with_name(output.name + ".partial")) as work:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        if onnx:
            errors = write_export(artifact, work)
        else:
            write_half_precision(artifact, work)
        os.replace(work, output)
    if not onnx:
        write_text(output / CARD, card_text(load_artifact(str(output)), ""))
        echo(f"{output / WEIGHTS}: {(output / WEIGHTS).stat().st_size / 1e6:.1f} MB")
        return
    for name, error in errors.items():
        echo(f"{output / name}.onnx: at most {error:.1e} from the original")
    echo(f"golden vectors: {output / GOLDEN}; description: {output / REPORT}")


def write_export(artifact: Artifact, folder: Path) -> dict[str, float]:
    """Write everything to the existing ``folder``; network -> its largest error.

    Raises:
        ArtifactError: a network differs from the original, or the planner needs other outputs.
    """
    model = artifact.world_model
    _require_exportable(artifact)
    for name, network in networks_of(model).items():
        write_graph(network, golden_inputs(model, _TRACED_ROWS, 1), folder / f"{name}.onnx")
    inputs = golden_inputs(model, _ROWS)
    golden = {f"inputs/{name}": tensor for name, tensor in inputs.items()}
    for name, outputs in reference(model, inputs).items():
        golden |= {f"outputs/{name}/{key}": tensor for key, tensor in outputs.items()}
    write_bytes(folder / GOLDEN, save({name: t.contiguous() for name, t in golden.items()}))
    errors = verify(folder)
    report = _report(artifact, folder, golden) | {"largest_error": errors}
    text = json.dumps(report, indent=2, allow_nan=False) + "\n"
    (folder / REPORT).write_text(text, encoding="utf-8")
    return errors


def _require_exportable(artifact: Artifact) -> None:
    """Raise `ArtifactError` for a planner that needs other outputs than the networks have."""
    planner = artifact.planner
    if planner.latent != "mean":
        raise ArtifactError(
            f"{artifact.path}: its planner has latent={planner.latent}; the networks written here "
            "give the mean, and another plan: train a policy with latent=mean, the default"
        )


def verify(folder: Path) -> dict[str, float]:
    """Run every network on the golden inputs, whole and row by row; its largest error.

    Errors are relative where the reference exceeds 1, absolute elsewhere.

    Raises:
        ArtifactError: one exceeds `TOLERANCE`.
        EnvironmentFailure: onnxruntime is missing.
    """
    require_packages("egovcp-train", PROG, "onnx", "onnxruntime")
    golden = load_file(folder / GOLDEN)
    errors: dict[str, float] = {}
    for name in NETWORKS:
        if name == "reward" and not (folder / "reward.onnx").exists():
            continue
        errors[name] = _largest_error(folder, name, golden)
        if not errors[name] <= TOLERANCE:  # NaN is more, too
            raise ArtifactError(
                f"{folder / name}.onnx differs from the original by {errors[name]:.1e}, more than "
                f"{TOLERANCE:g}; the export is wrong"
            )
    return errors


def _largest_error(folder: Path, name: str, golden: Mapping[str, torch.Tensor]) -> float:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        str(folder / f"{name}.onnx"), options, providers=["CPUExecutionProvider"]
    )
    names = [output.name for output in session.get_outputs()]
    inputs = {x.name: golden[f"inputs/{x.name}"].numpy() for x in session.get_inputs()}
    expected = [golden[f"outputs/{name}/{key}"].numpy() for key in names]
    rows = len(expected[0])
    whole = session.run(names, inputs)
    single = [session.run(names, {k: v[i : i + 1] for k, v in inputs.items()}) for i in range(rows)]
    found = [whole, [np.concatenate(parts) for parts in zip(*single, strict=True)]]
    errors = [
        np.max(np.abs(a - b) / np.maximum(1.0, np.abs(b)))
        for answer in found
        for a, b in zip(answer, expected, strict=True)
    ]
    return float(np.max(errors))


def _report(artifact: Artifact, folder: Path, golden: dict[str, torch.Tensor]) -> dict[str, Any]:
    """What another runtime needs besides the graphs."""
    model = artifact.world_model

    def described(key: str) -> dict[str, Any]:
        tensor = golden[key]
        kind = str(tensor.dtype).removeprefix("torch.")
        return {"dtype": kind, "shape": ["batch", *tensor.shape[1:]]}

    return {
        "schema": SCHEMA,
        "opset": OPSET,
        "networks": {
            name: {
                "file": f"{name}.onnx",
                "sha256": sha256(folder / f"{name}.onnx"),
                "inputs": {key: described(f"inputs/{key}") for key in network.inputs},
                "outputs": {key: described(f"outputs/{name}/{key}") for key in network.outputs},
            }
            for name, network in networks_of(model).items()
        },
        "golden": {"file": GOLDEN, "sha256": sha256(folder / GOLDEN), "tolerance": TOLERANCE},
        "min_return": float(model.min_return),
        "discount": float(model.discount),
        "planner": draccus.encode(artifact.planner),
        "controller_id": artifact.controller_id,
        "features": artifact.manifest["features"],
        "artifact": {
            "manifest_sha256": sha256(artifact.path / MANIFEST),
            "weights_sha256": artifact.manifest["files"][WEIGHTS],
            "datasets": artifact.manifest.get("datasets", []),
        },
    }


# --- networks ------------------------------------------------------------------------
type Tensors = dict[str, Tensor]


def _observe(
    model: WorldModel,
    h: Tensor,
    z: Tensor,
    action: Tensor,
    depth: Tensor,
    state: Tensor,
    is_first: Tensor,
) -> Carry:
    """`WorldModel.observe`: depth (B, 48, 64) mm as float32, whole numbers, 0 = not measured."""
    near = pooled_nearness(depth, model.config.depth_max_m)
    return model.observe_near(Carry(h, z), action, near, state, is_first)


_STEP: Final = ("h", "z", "action")
_NEXT: Final = ("h_next", "z_next")
#: Name -> inputs, outputs, function of the model and the inputs.
NETWORKS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...], Callable[..., Any]]]] = {
    "observe": ((*_STEP, "depth", "state", "is_first"), _NEXT, _observe),
    "imagine": (_STEP, _NEXT, lambda model, h, z, a: model.imagine(Carry(h, z), a)),
    "value": (_STEP, ("value",), lambda model, h, z, a: model.value(Carry(h, z), a)),
    "termination": (
        ("h", "z"),
        ("termination",),
        lambda model, h, z: model.termination(Carry(h, z)),
    ),
    "reward": (_STEP, ("reward",), lambda model, h, z, a: model.reward(Carry(h, z), a)),
}


class ExportedNetwork(nn.Module):
    """An entry of `NETWORKS`."""

    def __init__(self, model: WorldModel, name: str) -> None:
        super().__init__()
        self.model = model
        self.inputs, self.outputs, self._function = NETWORKS[name]

    def forward(self, *tensors: Tensor) -> Tensor | Carry:
        found: Tensor | Carry = self._function(self.model, *tensors)
        return found


def networks_of(model: WorldModel) -> dict[str, ExportedNetwork]:
    """The networks of this model, by name; reward only if it is predicted."""
    names = [name for name in NETWORKS if name != "reward" or model.reward_head is not None]
    return {name: ExportedNetwork(model, name) for name in names}


def pooled_nearness(depth_mm: Tensor, max_m: float) -> Tensor:
    """`egovcp.model.depth.nearness` in operations of ONNX: 3 x 3 pooling."""
    far = float(math.ceil(1e3 * max_m))
    depth = torch.where(depth_mm == 0, far, depth_mm.clamp(0.0, far)).floor()[:, None]
    nearest = -F.max_pool2d(-depth, 3, stride=1, padding=1)
    closed = F.max_pool2d(nearest, 3, stride=1, padding=1)[:, 0]
    return (1.0 - closed * (1e-3 / max_m)).clamp(0.0, 1.0)


def golden_inputs(model: WorldModel, batch: int, seed: int = 0) -> Tensors:
    """Inputs that reach every branch: holes, near and far pixels, first rows of episodes."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator)

    image, robot = model.robot.depth, model.robot
    depth = (uniform(*image) * 1.2e3 * model.config.depth_max_m).floor()
    return {
        "h": normal(model.config.hidden).tanh(),
        "z": normal(model.config.latent),
        "action": 2.0 * uniform(robot.action_dim) - 1.0,
        "depth": depth.masked_fill(uniform(*image) < 0.1, 0.0),
        "state": model.state_mean + 3.0 * model.state_std * normal(robot.state_dim),
        "is_first": torch.arange(batch) % 3 == 0,
    }


@torch.no_grad()
def reference(model: WorldModel, inputs: Tensors) -> dict[str, Tensors]:
    """Network -> its outputs, computed by the world model and not by the exported modules."""
    carry = Carry(inputs["h"], inputs["z"])
    depth = inputs["depth"].to(torch.int32)  # as on the robot
    action, state, is_first = inputs["action"], inputs["state"], inputs["is_first"]
    observed = model.observe(carry, action, depth, state, is_first)
    imagined = model.imagine(carry, action)
    answers = {
        "observe": dict(zip(_NEXT, observed, strict=True)),
        "imagine": dict(zip(_NEXT, imagined, strict=True)),
        "value": {"value": model.value(carry, action)},
        "termination": {"termination": model.termination(carry)},
    }
    if model.reward_head is not None:
        answers["reward"] = {"reward": model.reward(carry, action)}
    return answers


def write_graph(network: ExportedNetwork, inputs: Tensors, path: Path) -> None:
    """Trace ``network`` and write it to ``path``; its first axis, `batch`, is dynamic."""
    import onnx

    arguments = tuple(inputs[name] for name in network.inputs)
    with warnings.catch_warnings():
        # The newer exporter needs another package and half a minute.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network.eval(),
            arguments,
            str(path),
            dynamo=False,
            opset_version=OPSET,
            input_names=list(network.inputs),
            output_names=list(network.outputs),
            dynamic_axes={name: {0: "batch"} for name in (*network.inputs, *network.outputs)},
        )
    made = onnx.load(str(path))
    with torch.no_grad():
        outputs = network(*arguments)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    for described, tensor in zip(made.graph.output, outputs, strict=True):
        # The trace lacks fixed sizes.
        for axis, size in zip(
            described.type.tensor_type.shape.dim[1:], tensor.shape[1:], strict=True
        ):
            axis.dim_value = size
    onnx.checker.check_model(made, full_check=True)
    onnx.save(made, str(path))
