"""The options that every command which publishes something shares."""

from __future__ import annotations

from dataclasses import dataclass, field

from egovcp.hub.retry import RetryPolicy
from egovcp.outputs import output_file


@dataclass(frozen=True)
class PublishConfig:
    """Where and how something is published in one commit; what it is, a subclass says."""

    repo_id: str = ""
    """Where to publish it, `user/name`."""
    private: bool = False
    """A new repository is private."""
    branch: str = "main"
    """Branch; made if need be."""
    tag: str = ""
    """A tag for this version; empty: none. It cannot be moved later."""
    message: str = ""
    """Title of the commit; empty: what was published says it."""
    network: RetryPolicy = field(default_factory=RetryPolicy)
    """How long to try."""
    json: str = output_file()
    """File for {"repo_id", "branch", "tag", "commit", "new"}; empty: none."""
