"""``egovcp-eval-model``: measures a trained world model on recorded episodes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch

from egovcp.artifact import Artifact, load_artifact, returns_of
from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.cli import run_command
from egovcp.data import DatasetReader, EpisodeStore
from egovcp.dataset_options import SelectedDatasetConfig
from egovcp.errors import ArtifactError, UsageError
from egovcp.files import write_json
from egovcp.hardware import available_cores
from egovcp.manifest import finite_or_null
from egovcp.policy_options import PolicyOptions
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_train.checkpoint import prepare_output
from egovcp_train.datasets import EVALUATION_EPISODES
from egovcp_train.device import choose_device
from egovcp_train.heldout.pictures import draw, record, table
from egovcp_train.heldout.report import HeldoutReport, episode_batches, measure

PROG: Final = "egovcp-eval-model"
RESULT: Final = "heldout.json"


@dataclass(frozen=True)
class HeldoutConfig:
    """Measure a trained world model on whole recorded episodes, without a simulator.

    Open-loop prediction of depth and proprioception 1 to 16 ticks ahead beside "the last one
    repeated", prediction of terminations, calibration of Q, active latent dimensions; per task, as
    a table, heldout.json and pictures. docs/world_model.md explains each.
    """

    output_dir: str
    """New folder for heldout.json and the pictures."""
    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """Policy to measure."""
    dataset: SelectedDatasetConfig = field(default_factory=SelectedDatasetConfig)
    """Dataset with the episodes."""
    split: str = "heldout"
    """heldout, train or all; a hash decides which episodes are held out, in every training."""
    episodes: int = bounded(EVALUATION_EPISODES, least=0, most=1_000_000)
    """At most this many episodes of each task, evenly spread over the split; 0: all. Open-loop
    predictions use 64 of them."""
    stride: int = bounded(4, least=1)
    """Rows between the starts of open-loop predictions; 1: from each row."""
    pictures: bool = True
    """Write open_loop_TASK.png, value_TASK.png and open_loop.rrd."""
    threads: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """CPU threads; 0: all cores."""
    device: str = "auto"
    """cpu, cuda, or auto (cuda if there is one)."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(HeldoutConfig, evaluate, argv, prog=PROG)


def evaluate(config: HeldoutConfig) -> None:
    """Measure, print the table, write the JSON and the pictures.

    After Ctrl-C the measures of the episodes so far are written, marked as incomplete.

    Raises:
        UsageError: an option is wrong, the folder is not empty, or the policy is of another robot.
        ArtifactError: the policy is damaged, or of another low-level controller.
        DataError: the dataset is damaged.
        EnvironmentFailure: the folder cannot be written.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.policy.require()
    output = prepare_output(config.output_dir, resume=False, resumable=False)
    torch.set_num_threads(config.threads or available_cores())
    device = choose_device(config.device)
    reader = DatasetReader.open(config.dataset)
    artifact = load_artifact(config.policy.path, config.policy.revision)
    require_same_robot(artifact, reader)
    returns = returns_of(artifact)
    limit = config.episodes or None
    store = EpisodeStore.load([reader], config.split, returns, per_task=limit)
    model = artifact.world_model.to(device)
    with stop_on_signal() as received:
        stopped = partial(bool, received)
        report = measure(model, episode_batches(store, device), config.stride, stopped)
    requested = {task: store.tasks.count(task) for task in sorted(set(store.tasks))}
    played = {task: found["episodes"] for task, found in report.tasks.items()}
    complete = played == requested
    for task, found in report.tasks.items():
        if found["episodes"] < requested[task]:
            found |= {"incomplete": True, "episodes_requested": requested[task]}
    echo(table(report.tasks))
    run = _run(config, artifact, reader) | {"complete": complete}
    content = {"tasks": report.tasks, "all_tasks": report.metrics, "_run": run}
    output.mkdir(parents=True, exist_ok=True)
    write_json(output / RESULT, finite_or_null(content))
    if not complete:
        counts = [f"{task} {played.get(task, 0)} of {n}" for task, n in requested.items()]
        echo(f"INCOMPLETE: {', '.join(counts)} episodes measured")
        echo(f"metrics: {output / RESULT}")
        raise KeyboardInterrupt
    if config.pictures:
        _show(output, report, model.config.depth_max_m)
    echo(f"metrics: {output / RESULT}")


def require_same_robot(artifact: Artifact, reader: DatasetReader) -> None:
    """Raise unless policy and data have the same robot and low-level controller.

    Raises:
        UsageError: the robot, its sizes or its action box differ.
        ArtifactError: the low-level controller differs.
    """
    if artifact.robot != reader.robot:
        raise UsageError(
            f"{artifact.path} was trained on data of robot {artifact.robot.robot_type}, "
            f"{reader.root} is of robot {reader.robot.robot_type}, or their names, sizes or ranges "
            "of actions differ; choose a dataset of the policy's robot, such as its training data"
        )
    if artifact.controller_id != reader.controller_id:
        raise ArtifactError(
            f"{artifact.path} was trained on data of low-level controller "
            f"{artifact.controller_id!r}, {reader.root} was collected with "
            f"{reader.controller_id!r}: the same actions lead elsewhere; choose a dataset of the "
            "policy's controller"
        )


def _run(config: HeldoutConfig, artifact: Artifact, reader: DatasetReader) -> dict[str, Any]:
    return {
        "policy": str(artifact.path.absolute()),
        "step": artifact.manifest.get("step"),
        "dataset": {
            "repo_id": reader.source.repo_id,
            "revision": reader.source.commit,
            "episodes": reader.episodes,
        },
        "split": config.split,
        "stride": config.stride,
        "command": [PROG, *sys.argv[1:]],
    }


def _show(output: Path, report: HeldoutReport, depth_max_m: float) -> None:
    """Write the pictures and the recording."""
    from PIL import Image

    for name, picture in draw(report).items():
        Image.fromarray(picture).save(output / f"{name}.png", optimize=True)
        echo(f"picture: {output / name}.png")
    if recording := record(report, output, depth_max_m):
        echo(f"recording: rerun {recording}")
