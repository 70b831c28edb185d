"""What the manifest of a policy says about its training."""

from __future__ import annotations

from typing import Any

from egovcp.artefact import Artefact
from egovcp.data import ReturnConfig
from egovcp.decode import DecodeError, decode
from egovcp.errors import ArtefactError
from egovcp.manifest import MANIFEST


def returns_of(artefact: Artefact) -> ReturnConfig:
    """The return that Q was trained on; the default one if the manifest does not say.

    Raises:
        ArtefactError: the manifest says what this version does not understand.
    """
    options: Any = artefact.manifest.get("train_config", {})
    try:
        return decode(ReturnConfig, options.get("returns", {}), "train_config.returns")
    except DecodeError as error:
        raise ArtefactError(
            f"{artefact.path / MANIFEST}: {error}; train again with this version"
        ) from error
