"""Files to the Hub in one commit: complete at once, or not there at all."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.hub.failures import LostUpdate, RepoType, explained, token
from egovcp.hub.retry import HubUnreachable, RetryPolicy, retrying

if TYPE_CHECKING:
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
    from huggingface_hub.hf_api import RepoFile

_MAIN = "main"


class Content:
    """One file to publish; its hashes are computed when asked for, once."""

    def __init__(self, source: Path | bytes) -> None:
        self.source = source

    @cached_property
    def sha256(self) -> str:
        """Name of a large file's content."""
        if isinstance(self.source, bytes):
            return hashlib.sha256(self.source).hexdigest()
        with self.source.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    @cached_property
    def git_oid(self) -> str:
        """Git's name of a small file's content."""
        content = self.source if isinstance(self.source, bytes) else self.source.read_bytes()
        header = b"blob %d\0" % len(content)
        return hashlib.sha1(header + content, usedforsecurity=False).hexdigest()


@dataclass(frozen=True)
class Publication:
    """What a repository shall hold."""

    repo_id: str
    contents: Mapping[str, Content]
    """By path in the repository."""
    message: str
    """Title of the commit."""
    owned: tuple[str, ...] = ()
    """Folders in which nothing else may remain."""
    branch: str = _MAIN
    private: bool = False
    """A new repository shows to its owner alone."""
    moving_tag: str = ""
    """A tag that follows the branch."""
    tag: str = ""
    """A tag for this commit, for good."""
    repo_type: RepoType = "dataset"
    """What kind of repository it is."""

    @property
    def failures(self) -> AbstractContextManager[None]:
        """`explained` for what is done to this repository."""
        return explained(self.repo_id, self.branch, writing=True, repo_type=self.repo_type)


@dataclass(frozen=True)
class Published:
    """Where it is now."""

    commit: str
    new: bool
    """False: the repository held just this already."""


@dataclass(frozen=True)
class _State:
    """A branch as it was when looked at."""

    head: str
    files: Mapping[str, RepoFile]


def publish(publication: Publication, retry: RetryPolicy) -> Published:
    """Make the branch hold the contents, then set the tags.

    Repeating it completes what an interrupted one has left undone: large files that have
    arrived stay there, and nothing is committed if nothing differs.

    Raises:
        UsageError: a private repository was asked for and the id has a public one, or the tag
            is another commit's.
        LostUpdate: somebody else has changed the branch meanwhile.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    with publication.failures, retrying(retry):
        from huggingface_hub import HfApi

        api = HfApi(token=token())
        _prepare(api, publication)
        seen = _look(api, publication, publication.branch)
        tags = _tags(api, publication)
        _require_free(publication, tags, seen)
        commit = seen.head
        if _operations(publication, seen):
            commit = _commit(api, publication, seen, retry)
        for tag in filter(None, (publication.moving_tag, publication.tag)):
            _set_tag(api, publication, tag, commit, tags.get(tag))
    return Published(commit, commit != seen.head)


def reserve(publication: Publication, retry: RetryPolicy) -> None:
    """Make the repository that a long computation is to fill, or see that one may write there.

    Raises:
        UsageError: the id is none, or names a public repository and a private one is asked for.
        EnvironmentFailure: nobody is logged in, the Hub refuses, or cannot be reached.
    """
    with publication.failures, retrying(retry):
        from huggingface_hub import HfApi

        if (known := token()) is None:
            raise EnvironmentFailure(
                f"nobody is logged in to the Hub, so {publication.repo_id} could not be "
                "published; run `hf auth login`, or set HF_TOKEN"
            )
        _prepare(HfApi(token=known), publication)


def _prepare(api: HfApi, publication: Publication) -> None:
    """The repository and the branch."""
    repo_id, repo_type, private = publication.repo_id, publication.repo_type, publication.private
    api.create_repo(repo_id, repo_type=repo_type, private=private or None, exist_ok=True)
    if private and not api.repo_info(repo_id, repo_type=repo_type).private:
        raise UsageError(
            f"{repo_id} exists and is public, --private was given; nothing was published; make "
            "it private on the Hub, or choose another id"
        )
    if publication.branch != _MAIN:
        api.create_branch(repo_id, repo_type=repo_type, branch=publication.branch, exist_ok=True)


def _look(api: HfApi, publication: Publication, revision: str) -> _State:
    from huggingface_hub.hf_api import RepoFile

    repo_id, repo_type = publication.repo_id, publication.repo_type
    head = api.repo_info(repo_id, repo_type=repo_type, revision=revision).sha
    assert head is not None
    tree = api.list_repo_tree(repo_id, repo_type=repo_type, revision=head, recursive=True)
    return _State(head, {entry.path: entry for entry in tree if isinstance(entry, RepoFile)})


def _tags(api: HfApi, publication: Publication) -> dict[str, str]:
    refs = api.list_repo_refs(publication.repo_id, repo_type=publication.repo_type)
    return {tag.name: tag.target_commit for tag in refs.tags}


def _require_free(publication: Publication, tags: Mapping[str, str], seen: _State) -> None:
    """A release's tag does not move."""
    at = tags.get(publication.tag)
    if at is None or publication.tag == publication.moving_tag:
        return
    if at != seen.head or _operations(publication, seen):
        raise UsageError(
            f"tag {publication.tag} of {publication.repo_id} is commit {at} already, and tags "
            "are kept; nothing was published; choose another --tag"
        )


def _operations(
    publication: Publication, state: _State
) -> list[CommitOperationAdd | CommitOperationDelete]:
    """What a commit on top of ``state`` must add and delete."""
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    wanted, there = publication.contents, state.files
    stale = [
        path
        for path in there
        if path not in wanted and path.startswith(tuple(f"{o}/" for o in publication.owned))
    ]
    return [
        *(CommitOperationDelete(path, is_folder=False) for path in sorted(stale)),
        *(
            CommitOperationAdd(path, wanted[path].source)
            for path in sorted(wanted)
            if path not in there or not _same(wanted[path], there[path])
        ),
    ]


def _same(content: Content, file: RepoFile) -> bool:
    if file.lfs is not None:
        return content.sha256 == file.lfs.sha256
    size = content.source.stat().st_size if isinstance(content.source, Path) else None
    return size in (None, file.size) and content.git_oid == file.blob_id


def _commit(api: HfApi, publication: Publication, seen: _State, retry: RetryPolicy) -> str:
    """Upload, then commit on top of what was seen; the SHA of the commit."""
    from huggingface_hub import CommitOperationAdd

    operations = _operations(publication, seen)
    repo_id, repo_type = publication.repo_id, publication.repo_type
    additions = [o for o in operations if isinstance(o, CommitOperationAdd)]
    api.preupload_lfs_files(
        repo_id,
        additions,
        repo_type=repo_type,
        revision=publication.branch,
        free_memory=False,
    )
    for attempt in range(1, retry.attempts + 1):
        try:
            with publication.failures:
                made = api.create_commit(
                    repo_id,
                    operations,
                    commit_message=publication.message,
                    repo_type=repo_type,
                    revision=publication.branch,
                    parent_commit=seen.head,
                )
        except (HubUnreachable, LostUpdate) as error:
            now = _look(api, publication, publication.branch)
            if not _operations(publication, now):
                return now.head  # it has arrived, only the answer was lost
            if now.head != seen.head:
                raise _lost(publication, seen, now) from error
            if attempt == retry.attempts:
                raise
            time.sleep(retry.pause(attempt))
        else:
            _require_complete(publication, _look(api, publication, made.oid))
            return made.oid
    raise AssertionError("unreachable")


def _lost(publication: Publication, seen: _State, now: _State) -> LostUpdate:
    name = f"{publication.repo_id}@{publication.branch}"
    return LostUpdate(
        f"somebody else has published to {name} meanwhile: it was {seen.head} and is {now.head} "
        "now; nothing was published; look at what is there, then push again"
    )


def _require_complete(publication: Publication, state: _State) -> None:
    left = _operations(publication, state)
    if left:
        raise EnvironmentFailure(
            f"{publication.repo_id}@{state.head} is not what was sent: {left[0].path_in_repo} "
            "differs; is there a .gitignore in the repository?"
        )


def _set_tag(api: HfApi, publication: Publication, tag: str, commit: str, at: str | None) -> None:
    """Set a tag, as LeRobot does: the Hub cannot move one, only remove and create it."""
    from huggingface_hub.errors import RevisionNotFoundError

    repo_id, repo_type = publication.repo_id, publication.repo_type
    if at == commit:
        return
    if at is not None:
        with contextlib.suppress(RevisionNotFoundError):
            api.delete_tag(repo_id, tag=tag, repo_type=repo_type)
    api.create_tag(repo_id, tag=tag, revision=commit, repo_type=repo_type, exist_ok=True)
