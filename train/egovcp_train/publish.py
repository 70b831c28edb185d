"""A policy to the Hub: the repository before training, the artifact and its card after."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

from egovcp.artifact import FILES, Artifact, load_artifact
from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.hub import Content, Publication, Published, RetryPolicy, ensure_repository, publish
from egovcp.terminal import echo
from egovcp_train.card import ASSETS, CARD, CURVES, card_text
from egovcp_train.config import PolicyConfig

RETRY_POLICY: Final = RetryPolicy()


def reserve_policy(policy: PolicyConfig) -> None:
    """See before training that the policy can be published, where that is asked for.

    Raises:
        UsageError: the repository is public and a private one is asked for.
        EnvironmentFailure: nobody is logged in, the Hub refuses, or cannot be reached.
    """
    if policy.push_to_hub:
        target = Publication(policy.repo_id, {}, "", private=policy.private, repo_type="model")
        ensure_repository(target, RETRY_POLICY)


def publication(
    artifact: Artifact, repo_id: str, private: bool = False, message: str = ""
) -> Publication:
    """The artifact with a card of its own, as one commit; nothing else that lies beside it."""
    folder = artifact.path
    names = [name for name in (*FILES, CURVES) if (folder / name).is_file()]
    contents = {name: Content(folder / name) for name in names}
    contents[CARD] = Content(card_text(artifact, repo_id).encode())
    return Publication(
        repo_id=repo_id,
        contents=contents,
        message=message or f"policy after {artifact.manifest.get('step', '?')} steps",
        owned=(ASSETS,),
        private=private,
        repo_type="model",
    )


def publish_trained(folder: Path, policy: PolicyConfig) -> None:
    """Publish what a run has written, and say where it is.

    Raises:
        EnvironmentFailure: it could not be published; the message says how to try again.
    """
    try:
        target = publication(load_artifact(str(folder)), policy.repo_id, policy.private)
        report(target, publish(target, RETRY_POLICY))
    except (EgovcpError, OSError) as error:
        private = ["--private"] if policy.private else []
        again = ["egovcp-push", f"--policy.path={folder}", f"--repo_id={policy.repo_id}", *private]
        raise EnvironmentFailure(
            f"{error}; the trained policy is complete in {folder}, only publishing it failed; "
            f"repeat that with: {shlex.join(again)}"
        ) from error


def report(target: Publication, published: Published) -> None:
    """Say where the policy is and how to use it."""
    name, commit = target.repo_id, published.commit
    echo(f"{name}@{target.branch} {'is now' if published.new else 'was already'} {commit}")
    echo(f"egovcp-eval --policy.path={name} --policy.revision={commit} --task=... --output_dir=...")
