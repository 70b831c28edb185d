"""A commit of the Hub to a folder: resumable, and compared with what the Hub says it holds."""

from __future__ import annotations

import hashlib
import logging
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.hub.failures import RepoType, explained, token
from egovcp.hub.retry import HubUnreachable, RetryPolicy, retrying

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

_LOG = logging.getLogger(__name__)
#: What the Hub keeps beside a dataset, and is none of it.
_FOREIGN = (".gitattributes", ".gitignore")
_WORKERS = 4


def resolve(repo_id: str, revision: str, retry: RetryPolicy) -> str:
    """The commit SHA of a branch, a tag or a shortened SHA.

    Raises:
        DataError: there is no such dataset or revision.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    with explained(repo_id, revision), retrying(retry):
        from huggingface_hub import HfApi

        commit = HfApi(token=token()).dataset_info(repo_id, revision=revision or None).sha
        assert commit is not None
        return commit


def snapshot(
    repo_id: str,
    revision: str,
    retry: RetryPolicy,
    repo_type: RepoType = "dataset",
    cache_dir: Path | None = None,
    patterns: Sequence[str] | None = None,
) -> Path:
    """The folder, in the library's cache, of a revision's files; its name is the commit SHA.

    If the Hub cannot be reached, a complete earlier download serves.

    Args:
        repo_id: `user/name`.
        revision: branch, tag or commit SHA; empty: the latest.
        retry: how often and how long to try.
        repo_type: what kind of repository it is.
        cache_dir: the cache; None: the library's own.
        patterns: of the files to bring; None: all.

    Raises:
        DataError: there is no such dataset or revision.
        ArtifactError: there is no such model or revision.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    from huggingface_hub import snapshot_download

    bring = partial(
        snapshot_download,
        repo_id,
        repo_type=repo_type,
        revision=revision or "main",
        cache_dir=cache_dir,
        allow_patterns=None if patterns is None else list(patterns),
    )
    try:
        with explained(repo_id, revision, repo_type=repo_type), retrying(retry):
            return Path(bring(token=token()))
    except HubUnreachable as error:
        try:
            found = Path(bring(local_files_only=True))
        except OSError:  # nothing, or not all of it
            raise error from None
        _LOG.warning("%s; taking the earlier download of commit %s", error, found.name)
        return found


def fetch(repo_id: str, commit: str, folder: Path, retry: RetryPolicy) -> None:
    """Make ``folder`` hold exactly the files of a commit.

    What an interrupted call has brought is used; files that do not belong are removed.

    Raises:
        EnvironmentFailure: the Hub cannot be reached, refuses, or sends something else than it
            lists; the damaged file is removed, so that the next call fetches it anew.
    """
    with explained(repo_id, commit), retrying(retry):
        from huggingface_hub import HfApi, snapshot_download

        listing = _listing(HfApi(token=token()), repo_id, commit)
        _remove_others(folder, listing)
        snapshot_download(
            repo_id,
            repo_type="dataset",
            revision=commit,
            local_dir=folder,
            ignore_patterns=list(_FOREIGN),
            max_workers=_WORKERS,
        )
    for path, file in listing.items():
        _require_same(folder / path, file)
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # LeRobot would download again


def _listing(api: HfApi, repo_id: str, commit: str) -> dict[str, RepoFile]:
    from huggingface_hub.hf_api import RepoFile

    tree = api.list_repo_tree(repo_id, repo_type="dataset", revision=commit, recursive=True)
    files = {entry.path: entry for entry in tree if isinstance(entry, RepoFile)}
    for path in files:
        if path.startswith("/") or ".." in path.split("/"):
            raise DataError(f"{repo_id}@{commit} holds {path!r}, a place outside the dataset")
    return {path: file for path, file in files.items() if path not in _FOREIGN}


def _remove_others(folder: Path, listing: dict[str, RepoFile]) -> None:
    for path in folder.rglob("*"):
        name = path.relative_to(folder)
        if path.is_file() and name.parts[0] != ".cache" and name.as_posix() not in listing:
            path.unlink()


def _require_same(path: Path, file: RepoFile) -> None:
    if _digest(path, file) != (file.lfs.sha256 if file.lfs is not None else file.blob_id):
        path.unlink(missing_ok=True)
        raise EnvironmentFailure(
            f"{file.path} is not what the Hub says it is: its hash differs; the file was removed "
            "and is fetched anew by the next try"
        )


def _digest(path: Path, file: RepoFile) -> str:
    if not path.is_file():
        return ""
    if file.lfs is None:
        content = path.read_bytes()
        header = b"blob %d\0" % len(content)
        return hashlib.sha1(header + content, usedforsecurity=False).hexdigest()
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
