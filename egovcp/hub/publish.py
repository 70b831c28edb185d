"""Publishes files to the Hub in one commit: all of them or none."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.files import sha256
from egovcp.hub.errors import LostUpdate, RepoType, hub_token
from egovcp.hub.retry import RetryPolicy, call_hub
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo

if TYPE_CHECKING:
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete
    from huggingface_hub.hf_api import RepoFile

_MAIN = "main"


@dataclass(frozen=True)
class PublishConfig:
    """Options of every command that publishes something in one commit."""

    repo_id: str = ""
    """Repository to publish to, `user/name`."""
    private: bool = False
    """A new repository is private."""
    branch: str = "main"
    """Branch; created if it does not exist."""
    tag: str = ""
    """Tag for this version; empty: none. It cannot be moved later."""
    message: str = ""
    """Title of the commit; empty: a title that names what was published."""
    network: RetryPolicy = field(default_factory=RetryPolicy)
    """Attempts and time limits of requests."""
    json: str = output_file()
    """File for {"repo_id", "branch", "tag", "commit", "new"}; empty: none."""

    def publish(self, contents: Mapping[str, Content], title: str, **options: Any) -> str:
        """Publish, print the commit, and write the report; returns the SHA of the commit.

        Args:
            title: title of the commit if ``message`` is empty.
            options: further fields of `Publication`.
        """
        names = {"repo_id": self.repo_id, "branch": self.branch, "tag": self.tag}
        options |= {**names, "message": self.message or title, "private": self.private}
        published = publish(Publication(contents=contents, **options), self.network)
        state = "is now" if published.new else "was already"
        echo(f"{self.repo_id}@{self.branch} {state} {published.commit}")
        write_report(self.json, {**names, **asdict(published)})
        return published.commit


class Content:
    """One file to publish; each hash is computed once, when it is needed."""

    def __init__(self, source: Path | bytes) -> None:
        self.source = source

    @cached_property
    def sha256(self) -> str:
        """The Hub's hash of a large file."""
        if isinstance(self.source, Path):
            return sha256(self.source)
        return hashlib.sha256(self.source).hexdigest()

    @cached_property
    def git_oid(self) -> str:
        """Git's hash of a small file."""
        content = self.source if isinstance(self.source, bytes) else self.source.read_bytes()
        header = b"blob %d\0" % len(content)
        return hashlib.sha1(header + content, usedforsecurity=False).hexdigest()

    def matches(self, file: RepoFile) -> bool:
        """Whether a file on the Hub has this content."""
        if file.lfs is not None:
            return self.sha256 == file.lfs.sha256
        size = self.source.stat().st_size if isinstance(self.source, Path) else None
        return size in (None, file.size) and self.git_oid == file.blob_id


@dataclass(frozen=True)
class Publication:
    """The desired content of a repository."""

    repo_id: str
    contents: Mapping[str, Content]
    """By path in the repository."""
    message: str
    """Title of the commit."""
    owned: tuple[str, ...] = ()
    """Folders in which other files are deleted."""
    branch: str = _MAIN
    private: bool = False
    """A new repository is visible to its owner only."""
    moving_tag: str = ""
    """Tag that follows the branch."""
    tag: str = ""
    """Tag of this commit, which never moves."""
    repo_type: RepoType = "dataset"


@dataclass(frozen=True)
class Published:
    """The result of `publish`."""

    commit: str
    new: bool
    """False: the repository had the same content already."""


def publish(publication: Publication, retry: RetryPolicy) -> Published:
    """Make the branch hold the contents, then set the tags.

    A repeated call completes an interrupted one: large files that were uploaded are reused, and
    nothing is committed if nothing differs. Raises `LostUpdate` if another client changes the
    branch in the meantime.
    """
    publisher = _Publisher(publication, hub_token())
    return publisher.call(publisher.publish, retry)


def ensure_repository(publication: Publication, retry: RetryPolicy) -> None:
    """Create the repository and the branch, or check that they can be written to.

    Call it before a long computation whose result is to be published.
    """
    if (token := hub_token()) is None:
        raise EnvironmentFailure(
            f"not logged in to the Hub, so {publication.repo_id} could not be published; run "
            "`hf auth login`, or set HF_TOKEN"
        )
    publisher = _Publisher(publication, token)
    publisher.call(publisher.prepare, retry)


class _Branch(NamedTuple):
    head: str
    files: Mapping[str, RepoFile]


class _Publisher:
    def __init__(self, publication: Publication, token: str | None) -> None:
        from huggingface_hub import HfApi

        self._api = HfApi(token=token)
        self._wanted = publication
        self._first: _Branch | None = None  # before the first attempt
        self._repo: dict[str, Any] = {
            "repo_id": publication.repo_id,
            "repo_type": publication.repo_type,
        }

    def call[R](self, method: Callable[[], R], retry: RetryPolicy) -> R:
        wanted = self._wanted
        return call_hub(method, retry, wanted.repo_id, wanted.branch, True, wanted.repo_type)

    def publish(self) -> Published:
        wanted = self._wanted
        self.prepare()
        seen, tags = self.read_branch(wanted.branch), self.tags()
        self._first = self._first or seen
        self.require_free_tag(tags, seen)
        commit = seen.head
        if self.operations(seen):
            if seen.head != self._first.head:
                raise LostUpdate(
                    f"another client has published to {wanted.repo_id}@{wanted.branch} in the "
                    "meantime; nothing was published; check that version, then push again"
                )
            commit = self.commit(seen)
        for tag in filter(None, (wanted.moving_tag, wanted.tag)):
            self.set_tag(tag, commit, tags.get(tag))
        return Published(commit, commit != self._first.head)

    def prepare(self) -> None:
        private, branch = self._wanted.private, self._wanted.branch
        self._api.create_repo(**self._repo, private=private or None, exist_ok=True)
        if private and not self._api.repo_info(**self._repo).private:
            raise UsageError(
                f"{self._wanted.repo_id} exists and is public, but a private repository was asked "
                "for; nothing was published; make it private on the Hub, or choose another id"
            )
        if branch != _MAIN:
            self._api.create_branch(**self._repo, branch=branch, exist_ok=True)

    def read_branch(self, revision: str) -> _Branch:
        """Head and files of a branch or a commit."""
        from huggingface_hub.hf_api import RepoFile

        head = self._api.repo_info(**self._repo, revision=revision).sha
        assert head is not None
        tree = self._api.list_repo_tree(**self._repo, revision=head, recursive=True)
        return _Branch(head, {entry.path: entry for entry in tree if isinstance(entry, RepoFile)})

    def tags(self) -> dict[str, str]:
        refs = self._api.list_repo_refs(**self._repo)
        return {tag.name: tag.target_commit for tag in refs.tags}

    def require_free_tag(self, tags: Mapping[str, str], seen: _Branch) -> None:
        """Raise `UsageError` if the tag belongs to another commit."""
        tag, at = self._wanted.tag, tags.get(self._wanted.tag)
        if at is None or tag == self._wanted.moving_tag:
            return
        if at != seen.head or self.operations(seen):
            raise UsageError(
                f"tag {tag} of {self._wanted.repo_id} is commit {at} already, and tags do not "
                "move; nothing was published; choose another --tag"
            )

    def operations(self, state: _Branch) -> list[CommitOperationAdd | CommitOperationDelete]:
        """Additions and deletions that lead from ``state`` to the publication."""
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        wanted, there = self._wanted.contents, state.files
        owned = tuple(f"{folder}/" for folder in self._wanted.owned)
        stale = sorted(path for path in there.keys() - wanted.keys() if path.startswith(owned))
        changed = (
            path
            for path in sorted(wanted)
            if path not in there or not wanted[path].matches(there[path])
        )
        return [
            *(CommitOperationDelete(path, is_folder=False) for path in stale),
            *(CommitOperationAdd(path, wanted[path].source) for path in changed),
        ]

    def commit(self, seen: _Branch) -> str:
        """Upload, then commit on top of ``seen``; returns the SHA of the commit."""
        from huggingface_hub import CommitOperationAdd

        branch, operations = self._wanted.branch, self.operations(seen)
        additions = [o for o in operations if isinstance(o, CommitOperationAdd)]
        self._api.preupload_lfs_files(
            **self._repo, additions=additions, revision=branch, free_memory=False
        )
        made: str = self._api.create_commit(
            **self._repo,
            operations=operations,
            commit_message=self._wanted.message,
            revision=branch,
            parent_commit=seen.head,
        ).oid
        if left := self.operations(self.read_branch(made)):
            raise EnvironmentFailure(
                f"{self._wanted.repo_id}@{branch} differs from what was sent in "
                f"{left[0].path_in_repo}; is there a .gitignore in the repository?"
            )
        return made

    def set_tag(self, tag: str, commit: str, at: str | None) -> None:
        """Set a tag, as LeRobot does: the Hub cannot move one, only remove and create it."""
        from huggingface_hub.errors import RevisionNotFoundError

        if at == commit:
            return
        if at is not None:
            with contextlib.suppress(RevisionNotFoundError):
                self._api.delete_tag(**self._repo, tag=tag)
        self._api.create_tag(**self._repo, tag=tag, revision=commit, exist_ok=True)
