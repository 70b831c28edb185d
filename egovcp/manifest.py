"""The JSON files of a policy artifact: its manifest, and LeRobot's processors.

The manifest holds the SHA-256 of every file and of itself, so that damage is noticed. An attacker
can renew the digests: every value is validated too.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from egovcp import spec
from egovcp.decode import DecodeError, require_type, shown
from egovcp.errors import ArtifactError
from egovcp.files import UnsafeFileError, read_json, write_json
from egovcp.robot_spec import G1, RobotSpec

SCHEMA_VERSION: Final = 2
MANIFEST: Final = "manifest.json"
SEAL: Final = "manifest_sha256"
FORMAT_KEYS: Final = ("schema_version", "egovcp_version", "features", "files", SEAL)
"""Entries that are made when an artifact is written; all others are its provenance."""

#: Type of each entry that is read; all but the first three are optional.
_TYPES: Final[Mapping[str, Any]] = {
    "controller_id": str,
    "files": dict[str, str],
    "egovcp_version": str,
    "step": int,
    "tasks": list[str],
    "command": list[str],
    "versions": dict[str, str],
    "datasets": list[dict[str, Any]],
    "heldout": dict[str, float | None],
    "closed_loop": dict[str, float | None],
    "heldout_tasks": dict[str, dict[str, Any]],
    "train_config": dict[str, Any],
}
_REQUIRED: Final = ("controller_id", "files", "egovcp_version")
_DATASET_TYPES: Final[Mapping[str, Any]] = {
    "repo_id": str | None,
    "revision": str | None,
    "episodes": str | None,
}
_DATASET_OPTIONS: Final[Mapping[str, Any]] = {
    "dataset": dict[str, Any] | None,
    "datasets": list[dict[str, Any]] | None,
}


def sealed(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest with the SHA-256 of its content.

    Raises:
        ValueError: it holds NaN or an infinite number.
    """
    plain = {k: v for k, v in manifest.items() if k != SEAL}
    content = json.loads(json.dumps(plain, allow_nan=False))
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return {**content, SEAL: hashlib.sha256(text.encode()).hexdigest()}


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest with its SHA-256.

    Raises:
        ArtifactError: it holds NaN or an infinite number.
    """
    with _finite(folder / MANIFEST):
        content = sealed(manifest)
    write_json_file(folder / MANIFEST, content)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read a manifest and check everything except the digests of the files.

    Raises:
        ArtifactError: it is missing, damaged, or made for another feature spec.
    """
    path = folder / MANIFEST
    manifest = read_object(path)
    found = manifest.get("schema_version")
    if found != SCHEMA_VERSION or isinstance(found, bool):
        raise ArtifactError(
            f"{path}: schema version {shown(found)}, this egovcp reads {SCHEMA_VERSION}; install "
            "the version that made it, or train again"
        )
    _check_features(path, manifest.get("features"))
    if manifest.get(SEAL) != sealed(manifest)[SEAL]:
        raise ArtifactError(
            f"{path}: its SHA-256 does not match; it was changed or damaged: fetch it again"
        )
    try:
        _check_types(manifest)
    except DecodeError as error:
        raise ArtifactError(f"{path}: {error}; the file is damaged") from error
    return manifest


def _check_features(path: Path, features: Any) -> None:
    expected = G1.to_json()
    if json.dumps(features, sort_keys=True) == json.dumps(expected, sort_keys=True):
        return
    if isinstance(features, dict) and "robot_type" in features:
        try:
            RobotSpec.from_json(features)
        except DecodeError as error:
            raise ArtifactError(f"{path}: {error}; the file is damaged") from error
        return
    found = features if isinstance(features, dict) else {}
    differing = [k for k in expected if found.get(k) != expected[k]]
    raise ArtifactError(
        f"{path}: made for another feature spec (differs in "
        f"{', '.join(differing) or 'extra keys'}); train again on data of this version"
    )


def _check_types(manifest: Mapping[str, Any]) -> None:
    for name, kind in _TYPES.items():
        if name in manifest:
            require_type(manifest[name], kind, name)
        elif name in _REQUIRED:
            raise DecodeError(f"{name} is missing")
    for index, dataset in enumerate(manifest.get("datasets", [])):
        for name, kind in _DATASET_TYPES.items():
            require_type(dataset.get(name), kind, f"datasets[{index}].{name}")
        if dataset.get("revision") and not dataset.get("repo_id"):
            raise DecodeError(f"datasets[{index}].repo_id is missing")
    options = manifest.get("train_config", {})
    for name, kind in _DATASET_OPTIONS.items():
        require_type(options.get(name), kind, f"train_config.{name}")
    for dataset in [options.get("dataset") or {}, *(options.get("datasets") or [])]:
        require_type(dataset.get("root"), str | None, "root of a dataset in train_config")


def finite_or_null(value: Any) -> Any:
    """A JSON value with NaN and infinite numbers replaced by null."""
    match value:
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {key: finite_or_null(item) for key, item in value.items()}
        case list() | tuple():
            return [finite_or_null(item) for item in value]
    return value


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file of an artifact.

    Raises:
        ArtifactError: the file is missing, not a regular file, too large, not plain JSON, or holds
            something else.
    """
    try:
        content = read_json(path)
    except OSError as error:
        raise ArtifactError(f"{path}: {error.strerror}; not a policy artifact") from error
    except UnsafeFileError as error:
        raise ArtifactError(f"{path}: {error}; the file is damaged") from error
    if not isinstance(content, dict):
        raise ArtifactError(f"{path}: expected a JSON object, found {shown(content)}")
    return content


def write_json_file(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file of an artifact.

    Raises:
        ArtifactError: it holds NaN or an infinite number.
    """
    with _finite(path):
        write_json(path, content)


@contextmanager
def _finite(path: Path) -> Iterator[None]:
    """Turn the ValueError of `json.dumps` for NaN and infinities into `ArtifactError`."""
    try:
        yield
    except ValueError as error:
        raise ArtifactError(
            f"{path}: a number is NaN or infinite ({error}); expected finite numbers"
        ) from error


# --- LeRobot's processors ---------------------------------------------------------
# LeRobot requires these files. Their steps change no number: the world model normalises its inputs.
def input_features(robot: RobotSpec) -> dict[str, Any]:
    """LeRobot's description of the observations."""
    return {
        spec.DEPTH_KEY: {"type": "VISUAL", "shape": [1, *robot.depth]},
        spec.STATE_KEY: {"type": "STATE", "shape": [robot.state_dim]},
    }


def output_features(robot: RobotSpec) -> dict[str, Any]:
    """LeRobot's description of the actions."""
    return {spec.ACTION_KEY: {"type": "ACTION", "shape": [robot.action_dim]}}


_IDENTITY = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")


def _step(name: str, **config: Any) -> dict[str, Any]:
    return {"registry_name": name, "config": config}


def _normalisation(name: str, features: dict[str, Any]) -> dict[str, Any]:
    return _step(name, eps=1e-8, features=features, norm_map=_IDENTITY)


def _pipeline(name: str, *steps: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "steps": list(steps)}


_TO_CPU = _step("device_processor", device="cpu", float_dtype=None)


def processors(robot: RobotSpec = G1) -> dict[str, dict[str, Any]]:
    """File name -> content."""
    inputs, outputs = input_features(robot), output_features(robot)
    return {
        "policy_preprocessor.json": _pipeline(
            "policy_preprocessor",
            _step("rename_observations_processor", rename_map={}),
            _step("to_batch_processor"),
            _TO_CPU,
            _normalisation("normalizer_processor", {**inputs, **outputs}),
        ),
        "policy_postprocessor.json": _pipeline(
            "policy_postprocessor",
            _normalisation("unnormalizer_processor", outputs),
            _TO_CPU,
        ),
    }


#: Those of the G1.
PROCESSORS: Final = processors()
