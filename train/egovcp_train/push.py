"""``egovcp-push``: a policy artifact to the Hub."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from egovcp.artifact import load_artifact
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.hub import PublishConfig, is_repo_id, publish
from egovcp.outputs import write_report
from egovcp_train.publish import publication, report

PROG = "egovcp-push"


@dataclass(frozen=True)
class FolderConfig:
    """Which policy artifact."""

    path: str = ""
    """Folder of the artifact, OUTPUT_DIR/checkpoints/last/pretrained_model of a run."""


@dataclass(frozen=True)
class PushConfig(PublishConfig):
    """Publish a policy artifact and its card on the Hub in one commit.

    The artifact is checked first. A push that failed can be repeated: it completes what is
    missing, and commits nothing if nothing differs.
    """

    policy: FolderConfig = field(default_factory=FolderConfig)
    """The artifact."""
    message: str = ""
    """Title of the commit; empty: how long it was trained."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(PushConfig, push, argv, prog=PROG)


def push(config: PushConfig) -> None:
    """Check, publish, and say how to use it.

    Raises:
        UsageError: the folder or the id is missing or wrong.
        ArtifactError: the artifact is damaged.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    if not Path(config.policy.path).is_dir() or not config.policy.path:
        raise UsageError(
            f"--policy.path={config.policy.path!r}: expected the folder of an artifact, such as "
            "runs/ball/checkpoints/last/pretrained_model"
        )
    if not is_repo_id(config.repo_id):
        raise UsageError(f"--repo_id={config.repo_id!r}: expected user/name, where to publish")
    artifact = load_artifact(config.policy.path)
    plain = publication(artifact, config.repo_id, config.private, config.message)
    target = replace(plain, branch=config.branch, tag=config.tag)
    published = publish(target, config.network)
    report(target, published)
    facts = {"repo_id": config.repo_id, "branch": config.branch, "tag": config.tag}
    write_report(config.json, {**facts, **asdict(published)})
