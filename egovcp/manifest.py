"""The manifest of a policy artifact: which files it has, and where the policy comes from.

The SHA-256 of every file is in the manifest, and so is the manifest's own: nothing in an artifact
changes unnoticed. Whoever can write the files can also write the digests, so that every value is
checked all the same.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from egovcp import spec
from egovcp.atomic import write_text
from egovcp.decode import DecodeError, require_type, shown
from egovcp.errors import ArtifactError
from egovcp.safe_files import UnsafeFileError, read_json

SCHEMA_VERSION: Final = 2
MANIFEST: Final = "manifest.json"
SEAL: Final = "manifest_sha256"

#: Type of each entry that is read somewhere; entries but for the first two may be absent.
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
    "return_scales": dict[str, tuple[float, float]],
    "train_config": dict[str, Any],
}
_REQUIRED: Final = ("controller_id", "files")
_DATASET_TYPES: Final[Mapping[str, Any]] = {
    "repo_id": str | None,
    "revision": str | None,
    "episodes": str | None,
}


def feature_spec() -> dict[str, Any]:
    """What an artifact reads and writes: names, shapes and the action box."""
    return {
        "spec_version": spec.SPEC_VERSION,
        "planner_hz": spec.PLANNER_HZ,
        "depth": [spec.DEPTH_ROWS, spec.DEPTH_COLS],
        "state_names": list(spec.STATE_NAMES),
        "action_names": list(spec.ACTION_NAMES),
        "action_box": {k: list(v) for k, v in dataclasses.asdict(spec.ACTION_BOX).items()},
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
    """Seal a manifest and write it.

    Raises:
        ArtifactError: it holds NaN or an infinite number.
    """
    try:
        content = sealed(manifest)
    except ValueError as error:
        raise ArtifactError(
            f"{folder / MANIFEST}: a number is NaN or infinite ({error}); expected finite numbers"
        ) from error
    write_json_file(folder / MANIFEST, content)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read a manifest and check everything but the digests of the files.

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
            f"{path}: its SHA-256 is not the one that it names; it was changed or damaged: fetch "
            "it again"
        )
    try:
        _check_types(manifest)
    except DecodeError as error:
        raise ArtifactError(f"{path}: {error}; the file is damaged") from error
    return manifest


def _check_features(path: Path, features: Any) -> None:
    expected = feature_spec()
    if json.dumps(features, sort_keys=True) == json.dumps(expected, sort_keys=True):
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


def finite_or_null(value: Any) -> Any:
    """A JSON value with null in place of every number that is NaN or infinite."""
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
    try:
        text = json.dumps(content, indent=2, allow_nan=False)
    except ValueError as error:
        raise ArtifactError(
            f"{path}: a number is NaN or infinite ({error}); expected finite numbers"
        ) from error
    write_text(path, text + "\n")
