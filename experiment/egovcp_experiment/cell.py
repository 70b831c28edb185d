"""Cells: single runs of a command with its flags, and the commands that cells run.

Commands are named, not imported: applications do not depend on each other.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

from egovcp.artifact import policy_folder
from egovcp.data.schema import COLLECTION_PATH, HASHES_PATH
from egovcp.files import sha256
from egovcp.manifest import MANIFEST, SEAL, read_manifest
from egovcp.reactive import ReactiveNetwork

#: Artifact of egovcp-train, relative to the folder of the run.
ARTIFACT: Final = "checkpoints/last/pretrained_model"
#: Policy of egovcp-train-ppo, relative to a checkpoint.
PPO_POLICY: Final = "pretrained_model/ppo.safetensors"
#: Result file of a study of this package.
RESULT: Final = "result.json"

#: Minutes of an episode with a controller other than the planner and PPO; that of `constant`
#: includes its search.
_EPISODE_MINUTES: Final = {"hold": 0.003, "random": 0.003, "oracle": 0.003, "constant": 0.03}
#: Minutes of an episode of a study that simulates many variations of it.
_STUDY_MINUTES: Final = {"residuals": 0.15, "plan_terms": 0.035}

type Flags = Mapping[str, Any]
"""Name of a flag without dashes -> text, number, bool, list or mapping; references at any depth."""

type Record = Mapping[str, Any]
"""The stored result of a cell."""


@dataclass(frozen=True)
class CellOutput:
    """Reference to a file or folder that another cell writes."""

    cell: str
    """Name of that cell."""
    path: str = ""
    """Relative to its folder; empty: the folder itself."""


@dataclass(frozen=True)
class CellMetric:
    """Reference to a value in another cell's metrics."""

    cell: str
    """Name of that cell."""
    keys: tuple[str, ...]
    """Path in the nested metrics."""


@dataclass(frozen=True)
class ExternalPath:
    """Reference to a file or folder that no cell writes."""

    path: str
    """As the user wrote it."""


type Reference = CellOutput | CellMetric | ExternalPath


@dataclass(frozen=True)
class CellCommand:
    """A command that cells run, as ``MODULE.main(argv)``."""

    module: str
    """Module with `main`."""
    prog: str
    """The command as typed in a shell, for reports."""
    output: str
    """Flag for the output folder."""
    metrics: Callable[[Path], dict[str, Any]]
    """Reads the metrics to store from the output folder."""
    digest: Callable[[Path], str]
    """SHA-256 of the outputs that other cells read."""
    minutes: Callable[[Flags], float]
    """Estimate of the time that it takes with these flags, min, on two cores of an x86 CPU."""
    resume_flags: Callable[[Path], Flags | None] = lambda folder: None
    """Flags that resume an interrupted run in the folder; None: start again."""
    options: str = ""
    """``module:name`` of the dataclass of its options; empty: users give it no flags."""
    packages: tuple[str, ...] = ()
    """Optional modules that it imports."""
    exclusive: bool = False
    """Whether it measures time, so that no other cell may run at the same time."""


@dataclass(frozen=True)
class Cell:
    """One run of a command."""

    name: str
    """Unique in an output folder."""
    command: CellCommand
    flags: Flags = field(default_factory=dict)
    extra: tuple[str, ...] = ()
    """Further flags as the user wrote them, ``--name=value``."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the cells whose results it reads."""
        found: list[Reference] = []
        resolve(self.flags, found.append)
        return tuple(dict.fromkeys(r.cell for r in found if not isinstance(r, ExternalPath)))


def resolve(value: Any, reference_value: Callable[[Reference], Any]) -> Any:
    """The value with each reference replaced by ``reference_value(reference)``."""
    if isinstance(value, CellOutput | CellMetric | ExternalPath):
        return reference_value(value)
    if isinstance(value, Mapping):
        return {name: resolve(part, reference_value) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [resolve(part, reference_value) for part in value]
    return value


def to_argv(flags: Flags) -> list[str]:
    """``--name=value`` of flags without references."""
    return [f"--{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in flags.items()]


def read_json(path: Path) -> Any:
    """The content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def checkpoint_artifact(step: int) -> str:
    """Artifact of egovcp-train after ``step`` gradient steps, relative to the folder of the run."""
    return f"checkpoints/{step:06d}/pretrained_model"


def external_digest(path: str) -> str:
    """SHA-256 of a policy, dataset or file; of a dataset of other tools only of its path."""
    folder = policy_folder(path)
    if (folder / MANIFEST).is_file():
        return _artifact_digest(folder)
    if (folder / HASHES_PATH).is_file():
        return sha256(folder / HASHES_PATH)
    if folder.is_file():
        return sha256(folder)
    return hashlib.sha256(path.encode()).hexdigest()


def _artifact_digest(folder: Path) -> str:
    return str(read_manifest(folder)[SEAL])


def _collect_metrics(folder: Path) -> dict[str, Any]:
    info = read_json(folder / "meta" / "info.json")
    collection = read_json(folder / COLLECTION_PATH)
    return {
        "episodes": info["total_episodes"],
        "steps": info["total_frames"],
        "controller_id": collection.get("controller_id", ""),
    }


def _train_metrics(folder: Path) -> dict[str, Any]:
    manifest = read_manifest(folder / ARTIFACT)
    return {"step": manifest["step"], "tasks": manifest["heldout_tasks"]}


def _ppo_metrics(folder: Path) -> dict[str, Any]:
    policy = ReactiveNetwork.load(folder / "checkpoints" / "last" / PPO_POLICY)
    return {name: policy.provenance[name] for name in ("steps", "episodes")}


def _ppo_digest(folder: Path) -> str:
    """Of the policies of all checkpoints."""
    return _digest_of_checkpoints(folder, lambda checkpoint: sha256(checkpoint / PPO_POLICY))


def _train_digest(folder: Path) -> str:
    """Of the policies of all checkpoints."""
    return _digest_of_checkpoints(folder, lambda p: _artifact_digest(p / "pretrained_model"))


def _digest_of_checkpoints(folder: Path, digest: Callable[[Path], str]) -> str:
    checkpoints = sorted(p for p in (folder / "checkpoints").iterdir() if p.name.isdigit())
    lines = [f"{checkpoint.name} {digest(checkpoint)}" for checkpoint in checkpoints]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _eval_metrics(folder: Path) -> dict[str, Any]:
    """Task -> controller -> metrics; ``played`` has a column per episode quantity."""
    run = read_json(folder / "eval_run.json")["episodes"]
    return {
        task: {name: {**row, "played": _columns(run[task][name])} for name, row in rows.items()}
        for task, rows in read_json(folder / "eval.json").items()
    }


def _columns(episodes: list[Mapping[str, Any]]) -> dict[str, Any]:
    names = ("episode", "steps", "reward", "success")
    columns: dict[str, Any] = {name: [episode[name] for episode in episodes] for name in names}
    for name in ("parts", "terms"):
        if name in episodes[0]:
            keys = episodes[0][name]
            columns[name] = {key: [episode[name][key] for episode in episodes] for key in keys}
    return columns


def _play_minutes(flags: Flags) -> float:
    controllers = str(flags["controllers"]).split(",")
    return float(flags["episodes"]) * sum(_EPISODE_MINUTES.get(c, 0.012) for c in controllers)


def _resume_from_checkpoint(folder: Path) -> Flags | None:
    return {"resume": True} if (folder / "checkpoints" / "last").exists() else None


COLLECT: Final = CellCommand(
    module="egovcp_collect.collect",
    prog="egovcp-collect",
    output="dataset.root",
    metrics=_collect_metrics,
    digest=lambda folder: sha256(folder / HASHES_PATH),
    minutes=lambda flags: 0.0012 * float(flags["episodes"]),
    options="egovcp_collect.config:CollectConfig",
    resume_flags=lambda folder: {"resume": True},  # staged episodes are beside the folder
)
TRAIN: Final = CellCommand(
    module="egovcp_train.train",
    prog="egovcp-train",
    output="output_dir",
    metrics=_train_metrics,
    digest=_train_digest,
    minutes=lambda flags: 0.0095 * float(flags["steps"]),
    options="egovcp_train.config:TrainConfig",
    resume_flags=_resume_from_checkpoint,
)
TRAIN_PPO: Final = CellCommand(
    module="egovcp_train.ppo.train",
    prog="egovcp-train-ppo",
    output="output_dir",
    metrics=_ppo_metrics,
    digest=_ppo_digest,
    minutes=lambda flags: 3e-5 * float(flags["steps"]),
    options="egovcp_train.ppo.train:PpoTrainConfig",
    resume_flags=_resume_from_checkpoint,
    packages=("rsl_rl", "tensordict"),
)
PLAY: Final = CellCommand(
    module="egovcp_deploy.evaluate",
    prog="egovcp-eval",
    output="output_dir",
    metrics=_eval_metrics,
    digest=lambda folder: sha256(folder / "eval_run.json"),
    minutes=_play_minutes,
    options="egovcp_deploy.evaluate:EvalConfig",
)


@cache
def study(name: str, exclusive: bool = False) -> CellCommand:
    """The study ``egovcp_experiment.studies.NAME``."""
    module = f"egovcp_experiment.studies.{name}"
    return CellCommand(
        module=module,
        prog=f"python -m {module}",
        output="output_dir",
        metrics=lambda folder: dict(read_json(folder / RESULT)),
        digest=lambda folder: sha256(folder / RESULT),
        minutes=lambda flags: _STUDY_MINUTES.get(name, 0.03) * float(flags.get("episodes", 100)),
        exclusive=exclusive,
    )
