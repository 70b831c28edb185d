"""What the manifest of a policy says about its training."""

from __future__ import annotations

from typing import Any

from egovcp.artifact import Artifact
from egovcp.data import ReturnConfig
from egovcp.decode import DecodeError, decode
from egovcp.errors import ArtifactError
from egovcp.manifest import MANIFEST


def returns_of(artifact: Artifact) -> ReturnConfig:
    """The return that Q was trained on; the default one if the manifest does not say.

    Raises:
        ArtifactError: the manifest says what this version does not understand.
    """
    options: Any = artifact.manifest.get("train_config", {})
    try:
        return decode(ReturnConfig, options.get("returns", {}), "train_config.returns")
    except DecodeError as error:
        raise ArtifactError(
            f"{artifact.path / MANIFEST}: {error}; train again with this version"
        ) from error
