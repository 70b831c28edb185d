"""What a policy was trained with, from its manifest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from egovcp.artefact import Artefact
from egovcp.cli import WeightedDatasetConfig
from egovcp.data import ReturnConfig
from egovcp.decode import DecodeError, decode
from egovcp.errors import ArtefactError, UsageError
from egovcp.manifest import MANIFEST


def trained_with[C](artefact: Artefact, name: str, kind: type[C]) -> C:
    """The options of the training under ``name``; the defaults where the manifest has none.

    Raises:
        ArtefactError: they cannot be read.
    """
    return _decoded(artefact, name, kind, {})


def returns_of(artefact: Artefact, steps: int | None = None) -> ReturnConfig:
    """The return that Q was trained on; of ``steps`` ticks, if that is given.

    Raises:
        UsageError: it is not given, and the datasets of the training differed in it.
        ArtefactError: the manifest does not say what it was.
    """
    returns = trained_with(artefact, "returns", ReturnConfig)
    if steps is not None:
        returns = replace(returns, steps=steps)
        returns.check()
        return returns
    datasets = _decoded(artefact, "datasets", list[WeightedDatasetConfig], [])
    horizons = {d.root or d.repo_id: d.return_steps or returns.steps for d in datasets}
    found = set(horizons.values()) or {returns.steps}
    if len(found) > 1:
        each = ", ".join(f"{name}: {horizon}" for name, horizon in horizons.items())
        raise UsageError(
            f"{artefact.path} was trained on returns over as many ticks as each dataset wants "
            f"({each}); name the horizon that is meant, --return_steps={min(found)}, or take a "
            "policy of one"
        )
    return replace(returns, steps=found.pop())


def _decoded[C](artefact: Artefact, name: str, kind: type[C], default: object) -> C:
    options: Any = artefact.manifest.get("train_config", {})
    try:
        return decode(kind, options.get(name, default), f"train_config.{name}")
    except DecodeError as error:
        raise ArtefactError(
            f"{artefact.path / MANIFEST}: {error}; train again with this version"
        ) from error
