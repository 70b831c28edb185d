"""Repository ids, and downloads of one commit: resumable, compared with the Hub's list of files."""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from egovcp.errors import DataError, EnvironmentFailure
from egovcp.hub.errors import HubUnreachable, RepoType, hub_token
from egovcp.hub.publish import Content
from egovcp.hub.retry import RetryPolicy, call_hub

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

_LOG = logging.getLogger(__name__)
_NAME: Final = r"[A-Za-z0-9_](?:[\w.-]*\w)?"
_REPO_ID: Final = re.compile(rf"{_NAME}/{_NAME}", re.ASCII)
_MAX_LENGTH: Final = 96
#: Files of the repository that are not part of the dataset.
_FOREIGN: Final = (".gitattributes", ".gitignore")
_WORKERS: Final = 4


def is_repo_id(text: str) -> bool:
    """Whether ``text`` has the form of an id on the Hub, ``user/name``."""
    return (
        len(text) <= _MAX_LENGTH
        and _REPO_ID.fullmatch(text) is not None
        and ".." not in text
        and "--" not in text
        and not text.endswith(".git")
    )


def is_local_path(text: str) -> bool:
    """Whether an argument that may be a folder or a Hub id means a folder, existing or not.

    It does if something of this name exists, if it has not the form of an id, or if its parent is
    an existing folder: ``runs/bal`` beside ``runs/ball`` is a mistyped folder.
    """
    if not is_repo_id(text) or os.path.lexists(text):
        return True
    return os.path.isdir(os.path.dirname(text))


def resolve(repo_id: str, revision: str, retry: RetryPolicy) -> str:
    """The commit SHA of a branch, a tag or a shortened SHA of a dataset."""
    from huggingface_hub import HfApi

    api = HfApi(token=hub_token())
    info = partial(api.dataset_info, repo_id, revision=revision or None)
    commit: str | None = call_hub(info, retry, repo_id, revision).sha
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
    """Download a revision to the library's cache; the folder's name is the commit SHA.

    If the Hub cannot be reached, a complete earlier download is used. Without ``patterns``, globs,
    all files are downloaded.
    """
    from huggingface_hub import snapshot_download

    download = partial(
        snapshot_download,
        repo_id,
        repo_type=repo_type,
        revision=revision or "main",
        cache_dir=cache_dir,
        allow_patterns=None if patterns is None else list(patterns),
    )
    try:
        online = partial(download, token=hub_token())
        return Path(call_hub(online, retry, repo_id, revision, repo_type=repo_type))
    except HubUnreachable as error:
        try:
            found = Path(download(local_files_only=True))
        except OSError:  # no earlier download, or an incomplete one
            raise error from None
        _LOG.warning("%s; using the earlier download of commit %s", error, found.name)
        return found


def fetch(repo_id: str, commit: str, folder: Path, retry: RetryPolicy) -> None:
    """Make ``folder`` hold exactly the files of a commit of a dataset.

    Files of an interrupted call are reused; other files are removed.

    Raises:
        EnvironmentFailure: the Hub cannot be reached, refuses, or sends a file that differs from
            its list; that file is removed, so that the next call downloads it again.
        DataError: the commit does not exist, or holds a path outside the dataset.
    """
    listing = call_hub(partial(_download, repo_id, commit, folder), retry, repo_id, commit)
    for name, file in listing.items():
        path = folder / name
        if not path.is_file() or not Content(path).matches(file):
            path.unlink(missing_ok=True)
            raise EnvironmentFailure(
                f"{name} differs from the Hub's hash of it; the file was removed and will be "
                "downloaded again by the next attempt"
            )
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # LeRobot would download again


def _download(repo_id: str, commit: str, folder: Path) -> dict[str, RepoFile]:
    """Remove foreign files and download the others; returns the Hub's list of them."""
    from huggingface_hub import HfApi, snapshot_download

    listing = _listing(HfApi(token=hub_token()), repo_id, commit)
    for found in folder.rglob("*"):
        relative = found.relative_to(folder)
        foreign = relative.parts[0] != ".cache" and relative.as_posix() not in listing
        if foreign and found.is_file():
            found.unlink()
    snapshot_download(
        repo_id,
        repo_type="dataset",
        revision=commit,
        local_dir=folder,
        ignore_patterns=list(_FOREIGN),
        max_workers=_WORKERS,
    )
    return listing


def _listing(api: HfApi, repo_id: str, commit: str) -> dict[str, RepoFile]:
    from huggingface_hub.hf_api import RepoFile

    tree = api.list_repo_tree(repo_id, repo_type="dataset", revision=commit, recursive=True)
    files = {entry.path: entry for entry in tree if isinstance(entry, RepoFile)}
    for path in files:
        if path.startswith("/") or ".." in path.split("/"):
            raise DataError(f"{repo_id}@{commit} holds {path!r}, a path outside the dataset")
    return {path: file for path, file in files.items() if path not in _FOREIGN}
