"""The policy artefact: a LeRobot ``pretrained_model`` folder that explains itself.

    config.json        "type": "egovcp", network and planner configuration, features
    model.safetensors  weights and normalisation statistics
    policy_*.json      the steps LeRobot takes before and after the policy
    manifest.json      schema version, SHA-256 of all files and its own, data, controller, code

safetensors and JSON only: loading an artefact never executes code. Other files beside these, such
as a model card and its pictures, are no part of it: neither read nor, from the Hub, fetched.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import draccus
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from egovcp import spec
from egovcp.errors import ArtefactError, UsageError
from egovcp.hub import RetryPolicy, snapshot
from egovcp.model import WorldModel, WorldModelConfig
from egovcp.plan import PlannerConfig, Policy, require_answers
from egovcp.processors import INPUT_FEATURES, OUTPUT_FEATURES, PROCESSORS

SCHEMA_VERSION = 2
_NONE: Final[Mapping[str, Any]] = {}
#: Options of models made before there were these, where the default is another.
_BEFORE: Final[Mapping[str, Any]] = {"flight": {"enabled": False}}
SEAL = "manifest_sha256"
CONFIG, WEIGHTS, MANIFEST = "config.json", "model.safetensors", "manifest.json"
_PATTERNS = ("*.json", "*.safetensors")
_RETRY_POLICY = RetryPolicy()


@dataclass(frozen=True)
class Artefact:
    """A loaded, validated policy."""

    path: Path
    world_model: WorldModel
    planner: PlannerConfig
    manifest: dict[str, Any]

    @property
    def controller_id(self) -> str:
        """The low-level controller of the data; the policy drives no other."""
        return str(self.manifest["controller_id"])

    def make_policy(
        self, num_envs: int = 1, seed: int = 0, planner: PlannerConfig | None = None
    ) -> Policy:
        """A policy for ``num_envs`` robots; ``planner`` overrides the artefact's own."""
        return Policy(self.world_model, planner or self.planner, num_envs, seed)

    def require_controller(self, controller_id: str) -> None:
        """Raise `ArtefactError` unless the robot runs the controller of the data."""
        if controller_id != self.controller_id:
            raise ArtefactError(
                f"{self.path} was trained on data of low-level controller {self.controller_id!r}, "
                f"but the robot runs {controller_id!r}; choose the data's "
                "(--env.controller in simulation, --robot.controller on a robot), or collect data "
                "with this one and train again"
            )


def feature_spec() -> dict[str, Any]:
    """What an artefact reads and writes: names, shapes and the action box."""
    return {
        "spec_version": spec.SPEC_VERSION,
        "planner_hz": spec.PLANNER_HZ,
        "depth": [spec.DEPTH_ROWS, spec.DEPTH_COLS],
        "state_names": list(spec.STATE_NAMES),
        "action_names": list(spec.ACTION_NAMES),
        "action_box": {k: list(v) for k, v in dataclasses.asdict(spec.ACTION_BOX).items()},
    }


def save_artefact(
    path: Path, model: WorldModel, planner: PlannerConfig, provenance: dict[str, Any]
) -> None:
    """Write the artefact to a temporary folder, then rename it into place.

    Args:
        path: folder to create; an older artefact there is replaced once the new one is
            complete, and stays if anything fails.
        provenance: JSON-able; must hold ``controller_id`` and says which data and
            command made the policy.

    Raises:
        ArtefactError: the provenance names no controller.
    """
    _require_controller_id(path, provenance)
    work = path.with_name(path.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    config = {
        "type": "egovcp",
        "world_model": draccus.encode(model.config),
        "planner": draccus.encode(planner),
        "input_features": INPUT_FEATURES,
        "output_features": OUTPUT_FEATURES,
    }
    write_artefact(work, config, model.state_dict(), provenance, PROCESSORS)
    _replace(path, work)


def write_artefact(
    folder: Path,
    config: Mapping[str, Any],
    weights: Mapping[str, Tensor],
    provenance: Mapping[str, Any],
    processors: Mapping[str, Any],
) -> None:
    """Write the files of an artefact into a folder that exists; see `save_artefact`.

    Args:
        config: LeRobot's configuration of the policy, with ``world_model`` and ``planner``.
        weights: the state of the world model.
        processors: JSON file name -> content; may be empty if somebody else writes them.

    Raises:
        ArtefactError: the provenance names no controller.
    """
    _require_controller_id(folder, provenance)
    _write_json(folder / CONFIG, config)
    for name, content in processors.items():
        _write_json(folder / name, content)
    save_file({k: v.contiguous().cpu() for k, v in weights.items()}, folder / WEIGHTS)
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "egovcp_version": version("egovcp"),
        "features": feature_spec(),
        "files": {name: _sha256(folder / name) for name in (CONFIG, WEIGHTS, *processors)},
        **provenance,
    }
    _write_json(folder / MANIFEST, sealed(manifest))


def sealed(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A manifest with the SHA-256 of all that it says, so that no word of it changes unnoticed."""
    content = json.loads(json.dumps({k: v for k, v in manifest.items() if k != SEAL}))
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return {**content, SEAL: hashlib.sha256(text.encode()).hexdigest()}


def _require_controller_id(path: Path, provenance: Mapping[str, Any]) -> None:
    if not isinstance(provenance.get("controller_id"), str):
        raise ArtefactError(f"{path}: the provenance of a policy must hold its controller_id")


def _replace(path: Path, new: Path) -> None:
    """Put folder ``new`` in the place of ``path``, whose old content stays until it is there."""
    old = path.with_name(path.name + ".old")
    shutil.rmtree(old, ignore_errors=True)
    if path.exists():
        path.rename(old)
    try:
        new.rename(path)
    except OSError:
        if old.exists():
            old.rename(path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def load_artefact(path: str, revision: str = "", retry: RetryPolicy = _RETRY_POLICY) -> Artefact:
    """Load and validate a policy from a folder or, failing that, a Hub model id.

    If the Hub cannot be reached, an earlier download of that revision serves.

    Args:
        path: the folder, or `user/name`.
        revision: branch, tag or commit SHA on the Hub; empty: the latest. The name of
            `Artefact.path` is the commit's SHA then.
        retry: how often and how long the Hub is asked.

    Raises:
        ArtefactError: missing, tampered with, or made for another feature spec.
        UsageError: a revision is asked of a folder.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    folder = _locate(path, revision, retry)
    manifest = _read_json(folder / MANIFEST)
    _check_manifest(folder, manifest)
    config, planner = read_options(folder)
    try:
        require_answers(config, planner)
        model = WorldModel(config)
        model.load_state_dict(load_file(folder / WEIGHTS))
    except (RuntimeError, SafetensorError, UsageError, ValueError) as error:
        reason = " ".join(str(error).split())[:300]
        raise ArtefactError(
            f"{folder}: weights and configuration disagree: {reason}; a policy of another version "
            "of egovcp has to be trained again with this one"
        ) from error
    return Artefact(folder, model.eval(), planner, manifest)


def read_options(folder: Path) -> tuple[WorldModelConfig, PlannerConfig]:
    """What the policy in a folder is and how it plans, without its weights, nothing validated.

    Raises:
        ArtefactError: they are missing or not readable.
    """
    config = _read_json(folder / CONFIG)
    try:
        model = _decode(WorldModelConfig, config, "world_model", _BEFORE)
        return model, _decode(PlannerConfig, config, "planner")
    except (
        KeyError,
        TypeError,
        UsageError,
        ValueError,
        draccus.utils.DraccusException,
    ) as error:
        reason = " ".join(str(error).split())[:300]
        raise ArtefactError(
            f"{folder / CONFIG}: {reason}; a policy of another version of egovcp has to be trained "
            "again with this one"
        ) from error


def _decode[C](
    config_class: type[C], config: dict[str, Any], key: str, absent: Mapping[str, Any] = _NONE
) -> C:
    """The dataclass under ``key``; raises KeyError, TypeError, UsageError or DraccusException.

    Options that are ``absent`` have the values given there, others their defaults.
    """
    values = config[key]
    if not isinstance(values, dict):
        raise TypeError(f"{key} is {type(values).__name__}, expected an object")
    decoded: C = draccus.decode(config_class, {**absent, **values})
    return decoded


def _locate(path: str, revision: str, retry: RetryPolicy) -> Path:
    folder = Path(path)
    if folder.is_dir() and not revision:
        return folder
    if folder.is_dir():
        raise UsageError(
            f"{path} is a folder, and revision {revision} pins a policy of the Hub; drop the one "
            "or the other"
        )
    if folder.exists() or not _is_hub_id(path):
        raise ArtefactError(
            f"no policy artefact at {path!r}: expected a folder with {CONFIG}, {WEIGHTS} and "
            f"{MANIFEST} (a run's checkpoints/last/pretrained_model) or a Hub id 'user/name'"
        )
    return snapshot(path, revision, retry, "model", patterns=_PATTERNS)


def _is_hub_id(text: str) -> bool:
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils._validators import validate_repo_id

    try:
        validate_repo_id(text)
    except HFValidationError:
        return False
    return "/" in text


def _check_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    found = manifest.get("schema_version")
    if found != SCHEMA_VERSION:
        raise ArtefactError(
            f"{folder / MANIFEST}: schema version {found!r}, this egovcp reads "
            f"{SCHEMA_VERSION}; install the version that made it, or train again"
        )
    if manifest.get("features") != feature_spec():
        ours, theirs = feature_spec(), _object(manifest, "features")
        differing = [k for k in ours if theirs.get(k) != ours[k]]
        raise ArtefactError(
            f"{folder / MANIFEST}: made for another feature spec (differs in "
            f"{', '.join(differing) or 'extra keys'}); train again on data of this version"
        )
    if not isinstance(manifest.get("controller_id"), str):
        raise ArtefactError(f"{folder / MANIFEST}: no controller_id; the file is damaged")
    if manifest.get(SEAL) != sealed(manifest)[SEAL]:
        raise ArtefactError(
            f"{folder / MANIFEST}: its SHA-256 is not the one that it names; it was changed or "
            "damaged: fetch it again"
        )
    files = _object(manifest, "files")
    for name in (CONFIG, WEIGHTS, *(name for name in PROCESSORS if name in files)):
        expected, found = files.get(name), _sha256(folder / name)
        if found != expected:
            raise ArtefactError(
                f"{folder / name}: SHA-256 is {found[:12]}..., the manifest says "
                f"{str(expected)[:12]}...; the file was changed or damaged: fetch it again"
            )


def _object(manifest: dict[str, Any], key: str) -> dict[str, Any]:
    """The object under ``key``; empty where the manifest has none."""
    value = manifest.get(key)
    return value if isinstance(value, dict) else {}


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ArtefactError(f"{path}: {error.strerror}; the artefact is incomplete") from error


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ArtefactError(f"{path}: {error.strerror}; not a policy artefact") from error
    except ValueError as error:
        raise ArtefactError(f"{path}: not valid JSON ({error}); the file is damaged") from error
    if not isinstance(content, dict):
        raise ArtefactError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
