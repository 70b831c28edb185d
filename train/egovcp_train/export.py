"""``egovcp-export``: a policy with weights in half precision, for shipping."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

import torch
from torch import Tensor

from egovcp.artifact import (
    CONFIG,
    WEIGHTS,
    Artifact,
    load_artifact,
    replaced_folder,
    write_artifact,
)
from egovcp.cli import run_command
from egovcp.data.destination import resolve_root
from egovcp.errors import ArtifactError, UsageError
from egovcp.files import write_text
from egovcp.manifest import FORMAT_KEYS, PROCESSORS
from egovcp.policy_options import PolicyOptions
from egovcp.terminal import echo
from egovcp_train.checkpoint import prepare_output
from egovcp_train.publish import CARD, CURVES, card_text

PROG = "egovcp-export"
SOURCE: Final = "half_precision_of"
"""Entry of the manifest: SHA-256 of the weights before rounding."""
_FLAG: Final = re.compile(r"(--[\w.-]+=|)(.*)", re.DOTALL)
_PARENT_FOLDERS: Final = re.compile(r"(?<![\w.~/:])/(?:[^\s/\"'\[\]{},]+/)+(?=[^\s/])")


@dataclass(frozen=True)
class ExportConfig:
    """Write a copy of a policy with weights in half precision (float16), and its card."""

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy."""
    output_dir: str = ""
    """New folder for the copy."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(ExportConfig, export, argv, prog=PROG)


def export(config: ExportConfig) -> None:
    """Write the copy and its card.

    Raises:
        UsageError: policy or folder are missing, or the folder is not empty.
        ArtifactError: the policy is damaged, or a weight exceeds the range of float16.
        EnvironmentFailure: the folder cannot be written, or the Hub cannot be reached.
    """
    if not config.policy.path or not config.output_dir:
        raise UsageError("--policy.path and --output_dir are needed: the policy, and a new folder")
    # Absolute: a relative path could be the name of a shipped policy, or have no last component.
    output = resolve_root(config.output_dir)
    prepare_output(str(output), resume=False, resumable=False)
    artifact = load_artifact(config.policy.path, config.policy.revision)
    with replaced_folder(output) as work:
        write_half_precision(artifact, work)
        write_text(work / CARD, card_text(load_artifact(str(work)), "", output))
    echo(f"{output / WEIGHTS}: {(output / WEIGHTS).stat().st_size / 1e6:.1f} MB")


def write_half_precision(artifact: Artifact, folder: Path) -> None:
    """Write a copy of an artifact with float16 weights to the existing ``folder``.

    The statistics of the data stay float32. `load_artifact` converts all to float32. Of absolute
    paths in the provenance, which mean nothing on another machine, only the names remain.

    Raises:
        ArtifactError: a weight exceeds the range of float16.
    """
    source, manifest = artifact.path, artifact.manifest
    provenance = {k: _without_folders(v) for k, v in manifest.items() if k not in FORMAT_KEYS}
    if SOURCE not in provenance:
        provenance[SOURCE] = manifest["files"][WEIGHTS]
    processors = [name for name in PROCESSORS if name in manifest["files"]]
    read = {n: json.loads((source / n).read_text("utf-8")) for n in (CONFIG, *processors)}
    config = read.pop(CONFIG)
    weights = half_precision_weights(artifact)
    write_artifact(folder, config, weights, provenance, read, artifact.robot)
    if (source / CURVES).is_file():
        (folder / CURVES).parent.mkdir()
        shutil.copy(source / CURVES, folder / CURVES)


def half_precision_weights(artifact: Artifact) -> dict[str, Tensor]:
    """State of the world model with float16 parameters and float32 buffers.

    Raises:
        ArtifactError: a weight exceeds the range of float16.
    """
    model = artifact.world_model
    weights = model.state_dict()
    limit = torch.finfo(torch.float16).max
    for name, _ in model.named_parameters():
        if float(weights[name].abs().max()) > limit:
            raise ArtifactError(
                f"{artifact.path}: {name} holds a weight beyond the range of float16, {limit:.0f}; "
                "keep the policy in single precision"
            )
        weights[name] = weights[name].half()
    return weights


def _without_folders(value: Any) -> Any:
    """A JSON value with absolute paths in its strings replaced by their last component."""
    match value:
        case str():
            flag, path = _FLAG.fullmatch(value).groups()  # type: ignore[union-attr]  # never None
            name = PurePosixPath(path).name if path.startswith("/") else ""
            return f"{flag}{name or _PARENT_FOLDERS.sub('', path)}"
        case Mapping():
            return {key: _without_folders(item) for key, item in value.items()}
        case list():
            return [_without_folders(item) for item in value]
    return value
