"""The commands that cells run, and what is kept of each run.

They are named, not imported: applications know nothing of each other.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from egovcp.data.schema import COLLECTION_PATH, HASHES_PATH
from egovcp.files import sha256
from egovcp.manifest import MANIFEST, SEAL, read_manifest
from egovcp.reactive import ReactiveNetwork
from egovcp_experiment.cell import Flags, Tool

#: Where egovcp-train leaves its artifact, below the folder of the run.
ARTIFACT: Final = "checkpoints/last/pretrained_model"
#: The policy in a checkpoint of egovcp-train-ppo.
PPO_POLICY: Final = "pretrained_model/ppo.safetensors"
#: The file in which a study of this package leaves its figures.
RESULT: Final = "result.json"


def read_json(path: Path) -> Any:
    """The content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def _collected(folder: Path) -> dict[str, Any]:
    info = read_json(folder / "meta" / "info.json")
    collection = read_json(folder / COLLECTION_PATH)
    return {
        "episodes": info["total_episodes"],
        "steps": info["total_frames"],
        "controller_id": collection.get("controller_id", ""),
    }


def dataset_digest(folder: Path) -> str:
    """SHA-256 of the list of the SHA-256 of a dataset's files."""
    return sha256(folder / HASHES_PATH)


def _trained(folder: Path) -> dict[str, Any]:
    manifest = read_manifest(folder / ARTIFACT)
    return {"step": manifest["step"], "tasks": manifest["heldout_tasks"]}


def artifact_digest(folder: Path) -> str:
    """The SHA-256 that seals an artifact's manifest, and with it all of its files."""
    return str(read_manifest(folder)[SEAL])


def _trained_ppo(folder: Path) -> dict[str, Any]:
    policy = ReactiveNetwork.load(folder / "checkpoints" / "last" / PPO_POLICY)
    return {name: policy.provenance[name] for name in ("steps", "episodes")}


def _policies_digest(folder: Path) -> str:
    """SHA-256 of the list of the SHA-256 of all policies along the run."""
    checkpoints = sorted(p for p in (folder / "checkpoints").iterdir() if p.name.isdigit())
    lines = [f"{p.name} {sha256(p / PPO_POLICY)}" for p in checkpoints]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _played(folder: Path) -> dict[str, Any]:
    """Task -> controller -> figures, and under ``played`` every episode."""
    run = read_json(folder / "eval_run.json")["episodes"]
    return {
        task: {name: {**row, "played": _columns(run[task][name])} for name, row in rows.items()}
        for task, rows in read_json(folder / "eval.json").items()
    }


def _columns(episodes: list[Mapping[str, Any]]) -> dict[str, Any]:
    names = ("episode", "steps", "reward", "success")
    columns: dict[str, Any] = {name: [episode[name] for episode in episodes] for name in names}
    if "parts" in episodes[0]:
        parts = episodes[0]["parts"]
        columns["parts"] = {part: [e["parts"][part] for e in episodes] for part in parts}
    return columns


def _resumed(folder: Path) -> Flags | None:
    return {"resume": True} if (folder / "checkpoints" / "last").exists() else None


def _extended(folder: Path) -> Flags | None:
    return {"resume": True} if folder.exists() else None


COLLECT: Final = Tool(
    module="egovcp_collect.collect",
    output="dataset.root",
    figures=_collected,
    digest=dataset_digest,
    continued=_extended,
    prog="egovcp-collect",
)
TRAIN: Final = Tool(
    module="egovcp_train.train",
    output="output_dir",
    figures=_trained,
    digest=lambda folder: artifact_digest(folder / ARTIFACT),
    continued=_resumed,
    prog="egovcp-train",
    learns=True,
)
TRAIN_PPO: Final = Tool(
    module="egovcp_train.ppo.train",
    output="output_dir",
    figures=_trained_ppo,
    digest=_policies_digest,
    continued=_resumed,
    prog="egovcp-train-ppo",
    packages=("rsl_rl", "tensordict"),
    learns=True,
)
PLAY: Final = Tool(
    module="egovcp_deploy.evaluate",
    output="output_dir",
    figures=_played,
    digest=lambda folder: sha256(folder / "eval_run.json"),
    prog="egovcp-eval",
)


def study(name: str, alone: bool = False) -> Tool:
    """A study of this package, ``egovcp_experiment.studies.NAME``; alone: it measures time."""
    return Tool(
        module=f"egovcp_experiment.studies.{name}",
        output="output_dir",
        figures=lambda folder: dict(read_json(folder / RESULT)),
        digest=lambda folder: sha256(folder / RESULT),
        alone=alone,
    )


def given_digest(path: str) -> str:
    """What is known of something that no cell made: an artifact, a dataset, a file, or an id.

    Something on the Hub is known by its name alone.
    """
    folder = Path(os.path.expanduser(path))
    if (folder / MANIFEST).is_file():
        return artifact_digest(folder)
    if (folder / HASHES_PATH).is_file():
        return dataset_digest(folder)
    if folder.is_file():
        return sha256(folder)
    return hashlib.sha256(str(path).encode()).hexdigest()
