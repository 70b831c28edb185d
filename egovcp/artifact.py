"""The policy artifact: a LeRobot ``pretrained_model`` folder.

    config.json        "type": "egovcp", network and planner configuration, features
    model.safetensors  weights and normalisation statistics
    policy_*.json      LeRobot's steps before and after the policy
    manifest.json      schema version, SHA-256 of all files and its own, data, controller, code

Loading never executes code: there is only safetensors and JSON. Other files in the folder, such as
a model card, are neither read nor fetched from the Hub.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import draccus
from safetensors.torch import save
from torch import Tensor

from egovcp.decode import DecodeError, decode, require_type, shown
from egovcp.errors import ArtifactError, UsageError
from egovcp.files import (
    JSON_LIMIT_BYTES,
    UnsafeFileError,
    read_bytes,
    removed_on_error,
    sha256,
    user_path,
    write_bytes,
)
from egovcp.hub import HubUnreachable, RetryPolicy, is_local_path, is_repo_id, snapshot
from egovcp.manifest import (
    MANIFEST,
    PROCESSORS,
    SCHEMA_VERSION,
    input_features,
    output_features,
    processors,
    read_manifest,
    read_object,
    write_json_file,
    write_manifest,
)
from egovcp.model import WorldModel, WorldModelConfig
from egovcp.model.weights import load_model, size_limit, tensor_shapes
from egovcp.plan import PlannerConfig, Policy, require_compatible
from egovcp.plan.config import require_affordable
from egovcp.robot_spec import G1, RobotSpec

if TYPE_CHECKING:
    from egovcp.data import ReturnConfig

CONFIG, WEIGHTS = "config.json", "model.safetensors"
#: All files of an artifact.
FILES: Final = (CONFIG, WEIGHTS, MANIFEST, *PROCESSORS)
#: Where a training run keeps its latest policy.
_IN_RUN: Final = "checkpoints/last/pretrained_model"
#: Folder of the policies that ship with the package, one folder each.
PRETRAINED: Final = Path(__file__).with_name("pretrained")
_RETRY_POLICY = RetryPolicy()


@dataclass(frozen=True)
class Artifact:
    """A loaded, validated policy."""

    path: Path
    world_model: WorldModel
    planner: PlannerConfig
    manifest: dict[str, Any]

    @property
    def robot(self) -> RobotSpec:
        """The robot of the training data."""
        return self.world_model.robot

    @property
    def controller_id(self) -> str:
        """Id of the low-level controller of the training data."""
        return str(self.manifest["controller_id"])

    def make_policy(
        self, num_envs: int = 1, seed: int = 0, planner: PlannerConfig | None = None
    ) -> Policy:
        """A policy for ``num_envs`` robots; ``planner`` overrides the artifact's own."""
        return Policy(self.world_model, planner or self.planner, num_envs, seed)

    def require_controller(self, controller_id: str) -> None:
        """Raise `ArtifactError` unless the robot runs the controller of the data."""
        if controller_id != self.controller_id:
            raise ArtifactError(
                f"{self.path} was trained on data of robot {self.robot.robot_type} with low-level "
                f"controller {self.controller_id!r}, but this robot has {controller_id!r}; give a "
                "policy of this robot, or choose the data's controller (--env.controller in "
                "simulation, --robot.controller on a robot)"
            )


def save_artifact(
    path: Path, model: WorldModel, planner: PlannerConfig, provenance: dict[str, Any]
) -> None:
    """Write the artifact to a temporary folder, then rename it into place.

    Args:
        path: folder to create; an older artifact there is replaced once the new one is
            complete, and stays on an error.
        provenance: entries of the manifest; must hold ``controller_id``.

    Raises:
        ArtifactError: the provenance names no controller, or a number in it is not finite.
    """
    _require_controller_id(path, provenance)
    config = {
        "type": "egovcp",
        "world_model": draccus.encode(model.config),
        "planner": draccus.encode(planner),
        "input_features": input_features(model.robot),
        "output_features": output_features(model.robot),
    }
    with replaced_folder(path) as work:
        write_artifact(
            work, config, model.state_dict(), provenance, processors(model.robot), model.robot
        )


def write_artifact(
    folder: Path,
    config: Mapping[str, Any],
    weights: Mapping[str, Tensor],
    provenance: Mapping[str, Any],
    processors: Mapping[str, Any],
    robot: RobotSpec = G1,
) -> None:
    """Write the files of an artifact into a folder that exists; see `save_artifact`.

    Args:
        config: LeRobot's configuration of the policy, with ``world_model`` and ``planner``.
        weights: the state of the world model.
        processors: JSON file name -> content; empty: they are not written.
        robot: the robot of the world model.

    Raises:
        ArtifactError: the provenance names no controller, or a number in it is not finite.
    """
    _require_controller_id(folder, provenance)
    write_json_file(folder / CONFIG, config)
    for name, content in processors.items():
        write_json_file(folder / name, content)
    tensors = {k: v.contiguous().cpu() for k, v in weights.items()}
    write_bytes(folder / WEIGHTS, save(tensors))
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "egovcp_version": version("egovcp"),
        "features": robot.to_json(),
        "files": {name: sha256(folder / name) for name in (CONFIG, WEIGHTS, *processors)},
        **provenance,
    }
    write_manifest(folder, manifest)


def _require_controller_id(path: Path, provenance: Mapping[str, Any]) -> None:
    if not isinstance(provenance.get("controller_id"), str):
        raise ArtifactError(f"{path}: the provenance of a policy must hold its controller_id")


@contextmanager
def replaced_folder(path: Path) -> Iterator[Path]:
    """A new folder that replaces ``path`` at the end of the block; on an error ``path`` stays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    private = Path(tempfile.mkdtemp(prefix=".egovcp-", dir=path.parent))
    old = private.with_name(private.name + ".old")  # not within: that is removed on an error
    with removed_on_error(private):
        new = private / "new"
        new.mkdir()  # `mkdtemp` would make it readable by its owner only
        yield new
        try:
            if path.exists():
                path.rename(old)
            new.rename(path)
        except BaseException:
            if old.exists() and not path.exists():
                old.rename(path)
            raise
    private.rmdir()
    shutil.rmtree(old, ignore_errors=True)


def load_artifact(path: str, revision: str = "", retry: RetryPolicy = _RETRY_POLICY) -> Artifact:
    """Load and validate a policy: one that ships with egovcp, a folder, or a Hub model id.

    If the Hub cannot be reached, an earlier download of that revision is used.

    Args:
        path: name of a shipped policy (`contact`), folder, or `user/name`, the first that exists.
            A folder of the name of a shipped policy is written with a slash: `./contact`.
        revision: branch, tag or commit SHA on the Hub; empty: the latest. The name of
            `Artifact.path` is the commit's SHA then.
        retry: retries of requests to the Hub.

    Raises:
        ArtifactError: missing, tampered with, made for another feature spec, or with weights or
            options that cannot be used.
        UsageError: a revision is given for a folder or a shipped policy.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    folder = _locate(path, revision, retry)
    manifest = read_manifest(folder)
    digests = manifest["files"]
    for name in (CONFIG, *(name for name in PROCESSORS if name in digests)):
        with _readable(folder / name, "the file is damaged"):
            digest = sha256(folder / name, JSON_LIMIT_BYTES)
        _require_digest(folder / name, digest, digests.get(name))
    _check_processors(folder)
    config, planner = read_options(folder)
    robot = RobotSpec.from_json(manifest["features"])
    model = _load_weights(folder, config, digests.get(WEIGHTS), robot)
    return Artifact(folder, model, planner, manifest)


def read_options(folder: Path) -> tuple[WorldModelConfig, PlannerConfig]:
    """World model and planner configuration of the policy in a folder, without its weights.

    Raises:
        ArtifactError: missing, damaged, or too expensive for this machine.
    """
    config = read_object(folder / CONFIG)
    try:
        if config.get("type") != "egovcp":
            raise DecodeError(f'type is {shown(config.get("type"))}, expected "egovcp"')
        model = decode(WorldModelConfig, config.get("world_model"), "world_model")
        planner = decode(PlannerConfig, config.get("planner"), "planner")
        require_compatible(model, planner)
    except (DecodeError, UsageError) as error:
        raise ArtifactError(
            f"{folder / CONFIG}: {error}; a policy of another version of egovcp has to be trained "
            "again with this one"
        ) from error
    try:
        require_affordable(model, planner)
    except UsageError as error:
        raise ArtifactError(f"{folder / CONFIG}: {error}") from error
    return model, planner


def _load_weights(
    folder: Path, config: WorldModelConfig, digest: object, robot: RobotSpec
) -> WorldModel:
    path = folder / WEIGHTS
    try:
        shapes = tensor_shapes(config, robot)
    except ValueError as error:
        raise ArtifactError(f"{folder / CONFIG}: {error}") from error
    remedy = f"expected the weights of the networks in {CONFIG}: fetch or train the policy again"
    with _readable(path, remedy):
        content = read_bytes(path, size_limit(shapes))
        _require_digest(path, hashlib.sha256(content).hexdigest(), digest)
        return load_model(config, shapes, content, robot)


def shipped_policies() -> list[str]:
    """Names of the policies that ship with this package."""
    return sorted(manifest.parent.name for manifest in PRETRAINED.glob(f"*/{MANIFEST}"))


def policy_folder(path: str) -> Path:
    """Folder that ``path`` names unless it is a Hub id: a shipped policy, else a folder."""
    if path in shipped_policies():
        return PRETRAINED / path
    return user_path(path)


def _locate(path: str, revision: str, retry: RetryPolicy) -> Path:
    folder = policy_folder(path)
    is_folder = os.path.isdir(folder)
    if is_folder and revision:
        kind = "a folder" if folder.parent != PRETRAINED else "a policy that ships with egovcp"
        raise UsageError(
            f"{path} is {kind}, and revision {revision} pins a policy of the Hub; drop the one "
            "or the other"
        )
    if is_folder:
        _require_artifact_folder(folder)
        return folder
    if not is_repo_id(path) or (is_local_path(path) and not revision):
        found = "not a folder" if os.path.lexists(folder) else "no such folder"
        raise ArtifactError(
            f"{found}: {path!r}; expected a policy folder with {CONFIG}, {WEIGHTS} and "
            f"{MANIFEST} (a run's {_IN_RUN}), a Hub id 'user/name' (with a revision such as main "
            "if a folder 'user' exists)"
            + "".join(f", or {name!r}, which ships with egovcp" for name in shipped_policies())
        )
    try:
        return snapshot(path, revision, retry, "model", patterns=FILES)
    except HubUnreachable as error:
        raise HubUnreachable(f"there is no folder {path!r}, and {error}") from error


def _require_artifact_folder(folder: Path) -> None:
    """Raise `ArtifactError`, which names the policy, for the folder of a training run."""
    if os.path.lexists(folder / MANIFEST):
        return
    for inner in (_IN_RUN, "last/pretrained_model", "pretrained_model"):
        if os.path.lexists(folder / inner / MANIFEST):
            raise ArtifactError(
                f"{folder} is the folder of a training run, not of a policy; its policy is "
                f"{folder / inner}"
            )


def _check_processors(folder: Path) -> None:
    """Raise `ArtifactError` unless LeRobot's processors name only registered steps.

    For other steps LeRobot would import a module that the file names.
    """
    for name in PROCESSORS:
        if not os.path.lexists(folder / name):
            continue
        try:
            steps = read_object(folder / name).get("steps")
            require_type(steps, list[dict[str, Any]], "steps")
            for index, step in enumerate(steps or []):
                require_type(step.get("registry_name"), str, f"steps[{index}].registry_name")
                if "class" in step:
                    raise DecodeError(f"steps[{index}] names a class to import")
        except DecodeError as error:
            raise ArtifactError(
                f"{folder / name}: {error}; expected steps that LeRobot has registered"
            ) from error


def _require_digest(path: Path, found: str, expected: object) -> None:
    if found != expected:
        raise ArtifactError(
            f"{path}: SHA-256 is {found[:12]}..., the manifest says {shown(str(expected)[:12])}; "
            "the file was changed or damaged: fetch it again"
        )


@contextlib.contextmanager
def _readable(path: Path, remedy: str) -> Iterator[None]:
    """Turn errors of reading a file into `ArtifactError`."""
    try:
        yield
    except OSError as error:
        raise ArtifactError(f"{path}: {error.strerror}; the artifact is incomplete") from error
    except UnsafeFileError as error:
        raise ArtifactError(f"{path}: {error}; {remedy}") from error


def returns_of(artifact: Artifact) -> ReturnConfig:
    """The configuration of the returns that Q was trained on; the default if not recorded.

    Raises:
        ArtifactError: its options are unknown to this version.
    """
    from egovcp.data import ReturnConfig  # needs the extra egovcp[data]

    options: Any = artifact.manifest.get("train_config", {})
    try:
        return decode(ReturnConfig, options.get("returns", {}), "train_config.returns")
    except DecodeError as error:
        raise ArtifactError(
            f"{artifact.path / MANIFEST}: {error}; train again with this version"
        ) from error


def require_same_returns(
    state: Mapping[str, Tensor], returns: ReturnConfig, where: str, flag: str = "--returns"
) -> None:
    """Raise `UsageError` unless the Q of a model that is trained on has the discount and the scale
    of the options ``flag``, which are part of its state.

    Args:
        state: `WorldModel.state_dict` of the model.
        where: what the model comes from, for the message.
    """
    is_scaled = bool(state["return_mean"] != 0 or state["return_std"] != 1)
    discount = float(state["discount"])
    gamma = returns.gamma if math.isclose(returns.gamma, discount, rel_tol=1e-6) else discount
    options = {
        "gamma": (f"{returns.gamma:.6g}", f"{gamma:.6g}"),
        "scale": (returns.scale, "dataset" if is_scaled else "none"),
    }
    for name, (given, found) in options.items():
        if given != found:
            raise UsageError(
                f"{flag}.{name}={given}, but the Q of {where} was trained with {found}; give "
                f"{flag}.{name}={found}, or start a new run without its weights"
            )
