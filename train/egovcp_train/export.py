"""``egovcp-export``: the planner's networks as ONNX, with vectors that prove them.

observe.onnx ... termination.onnx   see `egovcp_train.onnx_networks`
golden.safetensors                  inputs/NAME and outputs/NETWORK/NAME, from the original
export.json                         features, controller, planner, SHA-256 and shapes
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import draccus
import numpy as np
import torch
from safetensors.torch import load_file, save

from egovcp.artifact import WEIGHTS, Artifact, load_artifact
from egovcp.atomic import removed_on_error, write_bytes
from egovcp.cli import run_command
from egovcp.errors import ArtifactError, UsageError
from egovcp.manifest import MANIFEST
from egovcp.packages import require_packages
from egovcp.policy_options import PolicyOptions
from egovcp.terminal import echo
from egovcp_train.onnx_networks import (
    NETWORKS,
    OPSET,
    REWARD,
    golden_inputs,
    networks_of,
    reference,
    write_graph,
)
from egovcp_train.output import prepare_output

PROG = "egovcp-export"
SCHEMA: Final = "egovcp-onnx-1"
GOLDEN, REPORT = "golden.safetensors", "export.json"
TOLERANCE: Final = 1e-4  # of the reference's magnitude where that exceeds 1
_ROWS: Final = 7  # of the golden vectors; other than what is traced
_TRACED_ROWS: Final = 2


@dataclass(frozen=True)
class ExportConfig:
    """Write the networks that the planner calls as ONNX, and prove them with onnxruntime.

    Beside them lie golden vectors, inputs and the outputs of the original, by which any other
    runtime can be proved as well.
    """

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The artifact."""
    output_dir: str = ""
    """New folder for the networks."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(ExportConfig, export, argv, prog=PROG)


def export(config: ExportConfig) -> None:
    """Write, prove, and say how far the networks are from the original.

    Raises:
        UsageError: artifact or folder are not named, or the folder holds something.
        ArtifactError: the artifact is damaged, or a network does not say what the original says.
        EnvironmentFailure: onnx or onnxruntime is missing, or the folder cannot be written.
    """
    if not config.policy.path or not config.output_dir:
        raise UsageError(
            "--policy.path and --output_dir are needed: the artifact, and a new folder"
        )
    _require_packages()
    output = prepare_output(config.output_dir, resume=False, resumable=False)
    artifact = load_artifact(config.policy.path, config.policy.revision)
    with removed_on_error(output.with_name(output.name + ".partial")) as work:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        errors = write_export(artifact, work)
        os.replace(work, output)
    for name, error in errors.items():
        echo(f"{output / name}.onnx: at most {error:.1e} from the original")
    echo(f"golden vectors: {output / GOLDEN}; description: {output / REPORT}")


def write_export(artifact: Artifact, folder: Path) -> dict[str, float]:
    """Write everything to the existing ``folder``; network -> its largest error.

    Raises:
        ArtifactError: a network does not say what the original says, or the planner would ask for
            more than they say.
    """
    model = artifact.world_model
    _require_exportable(artifact)
    for name, network in networks_of(model).items():
        write_graph(network(model), golden_inputs(model, _TRACED_ROWS, 1), folder / f"{name}.onnx")
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
    """Raise `ArtifactError` for a planner that asks what the networks do not answer."""
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
    _require_packages()
    golden = load_file(folder / GOLDEN)
    errors: dict[str, float] = {}
    present = REWARD if (folder / "reward.onnx").exists() else {}
    for name in {**NETWORKS, **present}:
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
    return float(
        np.max(
            [
                np.max(np.abs(a - b) / np.maximum(1.0, np.abs(b)))
                for answer in found
                for a, b in zip(answer, expected, strict=True)
            ]
        )
    )


def _report(artifact: Artifact, folder: Path, golden: dict[str, torch.Tensor]) -> dict[str, Any]:
    """What another runtime must know besides the graphs."""

    model = artifact.world_model
    networks = {name: network(model) for name, network in networks_of(model).items()}

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
                "sha256": _sha256(folder / f"{name}.onnx"),
                "inputs": {key: described(f"inputs/{key}") for key in network.inputs},
                "outputs": {key: described(f"outputs/{name}/{key}") for key in network.outputs},
            }
            for name, network in networks.items()
        },
        "golden": {"file": GOLDEN, "sha256": _sha256(folder / GOLDEN), "tolerance": TOLERANCE},
        "min_return": float(artifact.world_model.min_return),
        "discount": float(artifact.world_model.discount),
        "planner": draccus.encode(artifact.planner),
        "controller_id": artifact.controller_id,
        "features": artifact.manifest["features"],
        "artifact": {
            "manifest_sha256": _sha256(artifact.path / MANIFEST),
            "weights_sha256": artifact.manifest["files"][WEIGHTS],
            "datasets": artifact.manifest.get("datasets", []),
        },
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_packages() -> None:
    require_packages("egovcp-train", PROG, "onnx", "onnxruntime")
