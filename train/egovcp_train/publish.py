"""Publication of a policy on the Hub: ``egovcp-push``, the policy's card, its training curves."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import chain, repeat
from pathlib import Path
from typing import Any, Final

from egovcp.artifact import FILES, PRETRAINED, Artifact, load_artifact, policy_folder
from egovcp.cli import run_command
from egovcp.errors import EgovcpError, EnvironmentFailure, UsageError
from egovcp.files import write_text
from egovcp.hub import (
    Content,
    Publication,
    PublishConfig,
    RetryPolicy,
    ensure_repository,
    is_repo_id,
)
from egovcp.packages import SIMULATOR_MODULES, is_installed, versions_of
from egovcp.robot_spec import RobotSpec
from egovcp.terminal import echo
from egovcp_train.config import PolicyConfig

PROG: Final = "egovcp-push"
RETRY_POLICY: Final = RetryPolicy()
CARD: Final = "README.md"
ASSETS: Final = "assets"
CURVES: Final = f"{ASSETS}/training.png"
_PACKAGES: Final = ("egovcp", "egovcp-train", "torch", "numpy")
#: Metric -> its meaning.
_METRICS: Final = {
    "value/r2": "share of the variance of its target that Q explains",
    "value/slope": "regression of the target on Q; 1 is calibrated",
    "value/ranking": "correlation of the advantages of actions by Q and by its target",
    "latent/active": "dimensions of z that carry information",
    "latent/kl": "KL divergence of posterior and prior, nats per step",
    "object_rmse_m": "root mean squared error of the decoded position of the object",
}
#: Title of a panel -> label of a curve -> scalar.
_PANELS: Final[Mapping[str, Mapping[str, str]]] = {
    "loss": {"total": "loss/total"},
    "Q on held-out episodes": {"R²": "heldout/value/r2", "ranking": "heldout/value/ranking"},
}

type Series = tuple[list[int], list[float]]


# --- egovcp-push ---------------------------------------------------------------------
@dataclass(frozen=True)
class FolderConfig:
    """The policy to publish."""

    path: str = ""
    """Folder of the artifact, OUTPUT_DIR/checkpoints/last/pretrained_model of a run, or `contact`,
    which ships with egovcp (a folder of that name: `./contact`)."""


@dataclass(frozen=True)
class PolicyPushConfig(PublishConfig):
    """Publish a policy artifact and its card on the Hub in one commit.

    The artifact is checked first. A push that failed can be repeated: it completes what is
    missing, and commits nothing if nothing differs.
    """

    policy: FolderConfig = field(default_factory=FolderConfig)
    """Policy to publish."""
    message: str = ""
    """Title of the commit; empty: `policy after N steps`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(PolicyPushConfig, push, argv, prog=PROG)


def push(config: PolicyPushConfig) -> None:
    """Check and publish.

    Raises:
        UsageError: the folder or the id is missing or wrong; the repository is public and
            --private was given; the tag belongs to another commit.
        ArtifactError: the artifact is damaged.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    if not config.policy.path or not policy_folder(config.policy.path).is_dir():
        raise UsageError(
            f"--policy.path={config.policy.path!r}: expected the folder of an artifact, such as "
            "runs/ball/checkpoints/last/pretrained_model"
        )
    if not is_repo_id(config.repo_id):
        raise UsageError(f"--repo_id={config.repo_id!r}: expected user/name, where to publish")
    publish_artifact(load_artifact(config.policy.path), config)


# --- publication of a run ------------------------------------------------------------
def reserve_policy(policy: PolicyConfig) -> None:
    """Create the policy's repository on the Hub, or check that it can be written to.

    Does nothing unless the policy is to be published.

    Raises:
        UsageError: the repository is public and a private one is requested.
        EnvironmentFailure: the user is not logged in, or the Hub refuses or cannot be reached.
    """
    if policy.push_to_hub:
        target = Publication(policy.repo_id, {}, "", private=policy.private, repo_type="model")
        ensure_repository(target, RETRY_POLICY)


def publish_artifact(artifact: Artifact, config: PublishConfig) -> None:
    """Publish the artifact and its card as one commit, without other files of the folder, and print
    how to use it."""
    folder = artifact.path
    names = [name for name in (*FILES, CURVES) if (folder / name).is_file()]
    contents = {name: Content(folder / name) for name in names}
    contents[CARD] = Content(card_text(artifact, config.repo_id).encode())
    title = f"policy after {artifact.manifest.get('step', '?')} steps"
    commit = config.publish(contents, title, owned=(ASSETS,), repo_type="model")
    at = f"--policy.path={config.repo_id} --policy.revision={commit}"
    echo(f"egovcp-eval {at} --task=... --output_dir=...")


def publish_trained(folder: Path, policy: PolicyConfig) -> None:
    """Publish the policy of a run and print its address.

    Raises:
        EnvironmentFailure: it could not be published; the message has the command to repeat it.
    """
    try:
        target = PublishConfig(policy.repo_id, policy.private, network=RETRY_POLICY)
        publish_artifact(load_artifact(str(folder)), target)
    except (EgovcpError, OSError) as error:
        private = ["--private"] if policy.private else []
        again = ["egovcp-push", f"--policy.path={folder}", f"--repo_id={policy.repo_id}", *private]
        raise EnvironmentFailure(
            f"{error}; the trained policy is complete in {folder}, only publishing it failed; "
            f"repeat that with: {shlex.join(again)}"
        ) from error


# --- card ----------------------------------------------------------------------------
def training_versions() -> dict[str, str]:
    """Versions of Python and of the packages that training depends on."""
    return {"python": platform.python_version(), **versions_of(_PACKAGES)}


def write_card(folder: Path, run: Path, repo_id: str) -> None:
    """Write card and training curves to the folder of an artifact.

    Args:
        run: output folder of the run, whose records the curves show.
        repo_id: id on the Hub for the examples; empty: they name the folder.
    """
    draw_curves(run, folder / CURVES)
    write_text(folder / CARD, card_text(load_artifact(str(folder)), repo_id))


def card_text(artifact: Artifact, repo_id: str, folder: Path | None = None) -> str:
    """The card of a policy, from its manifest.

    Args:
        repo_id: id on the Hub, `user/name`, for the examples; empty: they name the folder, or the
            shipped policy.
        folder: the folder that they name; None: that of the artifact.
    """
    from huggingface_hub import ModelCard

    manifest, robot = artifact.manifest, artifact.robot
    command = manifest.get("command")
    versions = manifest.get("versions") or {"egovcp": manifest["egovcp_version"]}
    folder = folder or artifact.path
    is_shipped = folder.resolve().parent == PRETRAINED.resolve()
    local = folder.resolve().name if is_shipped else str(folder)
    title = repo_id.partition("/")[2] or "egovcp policy"
    card = ModelCard.from_template(
        _front_matter(manifest, title, robot),
        template_str=(files(__package__) / "model_card.md").read_text(encoding="utf-8"),
        title=title,
        name=repo_id or local,
        on_hub=bool(repo_id),
        other_robot="" if robot.is_g1 else robot.robot_type,
        tasks=[(task, _about(task)) for task in manifest.get("tasks", [])],
        datasets=_datasets(manifest),
        controller_id=artifact.controller_id,
        step=manifest.get("step", "an unknown number of"),
        command=shlex.join(command) if command else "not recorded",
        versions=", ".join(f"{name} {number}" for name, number in versions.items()),
        metrics=[
            (k, f"{v:.4g}", _METRICS.get(k, "")) for k, v in sorted(_metrics(manifest).items())
        ],
        curves=CURVES if (artifact.path / CURVES).is_file() else "",
        parameters=f"{sum(p.numel() for p in artifact.world_model.parameters()):,}",
        sizes=artifact.world_model.config,
        planner=artifact.planner,
        features=manifest["features"],
    )
    return f"{str(card).rstrip()}\n"


def _about(task: str) -> str:
    """What the robot has to do; empty if the task or the simulator is not installed."""
    if not all(map(is_installed, SIMULATOR_MODULES)):
        return ""
    from egovcp.sim.tasks.registry import describe_task

    return describe_task(task)


def _front_matter(manifest: Mapping[str, Any], title: str, robot: RobotSpec) -> Any:
    from huggingface_hub import EvalResult, ModelCardData

    datasets = manifest.get("datasets", [])
    on_hub = [d for d in datasets if d.get("revision")]
    results = [
        EvalResult(
            task_type="robotics",
            dataset_type=datasets[0]["repo_id"],
            dataset_name=datasets[0]["repo_id"],
            dataset_split="held-out episodes",
            dataset_revision=datasets[0]["revision"],
            metric_type=name,
            metric_value=value,
        )
        for name, value in sorted(_metrics(manifest).items())
        if on_hub and len(datasets) == 1  # a result names one dataset
    ]
    return ModelCardData(
        license="apache-2.0",
        library_name="egovcp",
        pipeline_tag="robotics",
        tags=["egovcp", "LeRobot", *_robot_tags(robot), "depth", "world-model"],
        datasets=[d["repo_id"] for d in on_hub] or None,
        model_name=title if results else None,
        eval_results=results or None,
    )


def _robot_tags(robot: RobotSpec) -> list[str]:
    if robot.is_g1:
        return [robot.robot_type, "humanoid"]
    return [robot.robot_type] if robot.robot_type != "unknown" else []


def _metrics(manifest: Mapping[str, Any]) -> dict[str, float]:
    """The held-out metrics; null stands for one that was not finite."""
    return {k: float(v) for k, v in manifest.get("heldout", {}).items() if v is not None}


def _datasets(manifest: Mapping[str, Any]) -> list[dict[str, str]]:
    """Id, commit, episodes and name of the folder of each dataset; empty text for what is not
    recorded."""
    options, names = manifest.get("train_config", {}), ("repo_id", "revision", "episodes")
    given = options.get("datasets") or [options.get("dataset") or {}]
    return [
        {name: entry.get(name) or "" for name in names}
        | {"root": Path(option.get("root") or "").name}
        for entry, option in zip(
            manifest.get("datasets", []), chain(given, repeat({})), strict=False
        )
    ]


# --- training curves -----------------------------------------------------------------
def draw_curves(run: Path, path: Path) -> None:
    """Draw the curves that the run in folder ``run`` has recorded; no file if there are none."""
    known = recorded_scalars(run / "tensorboard")
    panels = {
        title: {label: known[name] for label, name in names.items() if name in known}
        for title, names in _PANELS.items()
    }
    panels = {title: curves for title, curves in panels.items() if curves}
    if not panels:
        return
    from matplotlib.figure import Figure  # takes half a second

    figure = Figure(figsize=(4.0 * len(panels), 3.0), layout="constrained")
    for axes, (title, curves) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        for label, (steps, values) in curves.items():
            axes.plot(steps, values, label=label, marker="." if len(steps) < 20 else "")
        axes.set(title=title, xlabel="step")
        axes.grid(alpha=0.3)
        axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100, metadata={"Software": None})


def recorded_scalars(folder: Path) -> dict[str, Series]:
    """Scalar -> its steps and values, over all parts of a resumed run."""
    if not folder.is_dir():
        return {}
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(str(folder), size_guidance={"scalars": 10_000}).Reload()
    events = {name: found.Scalars(name) for name in found.Tags()["scalars"]}
    return {name: ([e.step for e in es], [e.value for e in es]) for name, es in events.items()}
