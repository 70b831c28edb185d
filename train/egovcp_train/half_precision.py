"""Policy artifacts with weights in half precision: half the size, for shipping."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from egovcp.artifact import CONFIG, WEIGHTS, Artifact, write_artifact
from egovcp.errors import ArtifactError
from egovcp.manifest import FORMAT_KEYS, PROCESSORS
from egovcp_train.publish import CURVES

SOURCE: Final = "half_precision_of"
"""Entry of the manifest: SHA-256 of the weights before rounding."""
_PARENT_FOLDERS: Final = re.compile(r"(?<![\w.~/:])/(?:[^\s/\"'\[\]{},]+/)+(?=[^\s/])")


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
            return _PARENT_FOLDERS.sub("", value)
        case Mapping():
            return {key: _without_folders(item) for key, item in value.items()}
        case list():
            return [_without_folders(item) for item in value]
    return value
