"""`egovcp-dataset push` and `pull`: a dataset to and from the Hub, as one commit."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from egovcp.checks import check_dataset
from egovcp.data import DatasetConfig, DatasetReader, schema
from egovcp.data.committer import work_folder
from egovcp.data.dataset_files import sync_tree
from egovcp.data.destination import require_new, resolve_root, writer_lock
from egovcp.data.metadata import verify_hashes
from egovcp.data.source import Source, read_source, write_source
from egovcp.data.writer import publish_version
from egovcp.errors import DataError, UsageError
from egovcp.hub import Content, PublishConfig, RetryPolicy, fetch, is_repo_id, resolve
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo
from egovcp_collect.dataset.card import ASSETS, CARD, card_text, print_missing_licence
from egovcp_collect.progress import progress_bar

#: Folders of a LeRobot dataset: other files in them on the Hub belong to an earlier version.
_OWNED: Final = ("data", "meta", "videos", "images", ASSETS)


@dataclass(frozen=True)
class DatasetPushConfig(PublishConfig):
    """Publish a dataset and its card on the Hub in one commit, and tag it for LeRobot.

    A README.md in its folder is published as it is; without one, a card is written for the Hub. The
    dataset is checked first. A failed push can be repeated: it uploads what is missing, and
    makes no commit if nothing differs.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder on disk."""
    branch: str = "main"
    """Branch, which is created if needed. LeRobot's version tag follows `main` only."""
    message: str = ""
    """Title of the commit; empty: the numbers of episodes and frames, and the tasks."""


@dataclass(frozen=True)
class PullConfig:
    """Download one commit of a dataset from the Hub to a new folder.

    The folder appears when all files have arrived and their hashes agree. A failed pull can be
    repeated: it continues with the files that have arrived.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: its id on the Hub, and optionally a revision; default: the latest commit."""
    output_dir: str = ""
    """The new folder."""
    network: RetryPolicy = field(default_factory=RetryPolicy)
    """Timeouts and retries."""
    json: str = output_file()
    """File for {"repo_id", "commit", "root", "episodes", "frames"}; empty: none."""


def run_push(config: DatasetPushConfig) -> None:
    """Check and publish."""
    if not config.dataset.root:
        raise UsageError("push takes the folder of a dataset; fetch one with `pull` first")
    if not is_repo_id(config.repo_id):
        raise UsageError(f"--repo_id={config.repo_id!r}: expected user/name, where to publish")
    reader = DatasetReader.open(config.dataset)
    work = work_folder(reader.root)
    if work.exists():
        raise DataError(
            f"the collection of {reader.root} is unfinished ({work} exists); wait for its end, or "
            "complete it with `egovcp-collect --resume`"
        )
    contents = _contents(reader.root)
    with progress_bar("checking") as progress:
        check_dataset(DatasetConfig(root=str(reader.root)), progress)
    tasks = sorted({reader.task(i) for i in range(len(reader))})
    size = f"{len(reader)} episodes, {reader.num_frames} frames"
    if CARD in contents:
        echo(f"{CARD} is published as it is; `egovcp-dataset card` writes it anew")
    else:
        contents[CARD] = Content(card_text(reader, config.repo_id).encode())
        print_missing_licence(reader)
    commit = config.publish(
        contents,
        f"{size}: {', '.join(tasks)}",
        owned=_OWNED,
        moving_tag=schema.CODEBASE_VERSION if config.branch == "main" else "",
    )
    echo(f"egovcp-train --dataset.repo_id={config.repo_id} --dataset.revision={commit}")


def _contents(root: Path) -> dict[str, Content]:
    """Every file except hidden ones and the note of the source."""
    contents: dict[str, Content] = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root)
        if any(part.startswith(".") for part in name.parts):
            continue
        if path.is_symlink():
            raise DataError(f"{path} is a link; a dataset to publish holds plain files")
        if path.is_file() and name.as_posix() != schema.SOURCE_PATH:
            contents[name.as_posix()] = Content(path)
    return contents


def run_pull(config: PullConfig) -> None:
    """Download, check, and print the result."""
    repo_id = config.dataset.repo_id
    if config.dataset.root or not is_repo_id(repo_id):
        raise UsageError("pull takes the id of a dataset on the Hub, user/name")
    if not config.output_dir:
        raise UsageError("--output_dir is missing; name the folder of the new dataset")
    root = resolve_root(config.output_dir)
    is_download = (root / schema.SOURCE_PATH).is_file()
    if not is_download:
        require_new(root)
    commit = resolve(repo_id, config.dataset.revision, config.network)
    source = Source(root, repo_id, commit)
    if is_download and read_source(root) == source:
        verify_hashes(root)
        echo(f"{root} is {repo_id}@{commit} already")
    else:
        require_new(root)
        _download(source, config.network)
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    echo(f"{root}: {reader.source.repo_id}@{reader.source.commit}")
    echo(f"{len(reader)} episodes, {reader.num_frames} frames")
    echo(f"egovcp-train --dataset.root={root}")
    result = {
        "repo_id": reader.source.repo_id,
        "commit": reader.source.commit,
        "root": str(reader.source.root),
        "episodes": len(reader),
        "frames": reader.num_frames,
    }
    write_report(config.json, result)


def _download(source: Source, retry: RetryPolicy) -> None:
    """Download to a hidden folder beside the destination, check, and move it into place."""
    work = source.root.with_name(f".{source.root.name}.pull")
    files = work / "files"
    files.mkdir(parents=True, exist_ok=True)
    with writer_lock(source.root, work):
        try:
            fetch(source.repo_id, source.commit, files, retry)
        except BaseException:
            if not _has_content(files):
                shutil.rmtree(work, ignore_errors=True)
            raise
        try:
            (files / schema.SOURCE_PATH).unlink(missing_ok=True)
            verify_hashes(files)
            DatasetReader.open(DatasetConfig(root=str(files)))
        except DataError:  # the commit itself is damaged: downloading it again would not help
            shutil.rmtree(work)
            raise
        write_source(Source(files, source.repo_id, source.commit))
        sync_tree(files)
        publish_version(files, source.root)
    shutil.rmtree(work, ignore_errors=True)


def _has_content(files: Path) -> bool:
    """Whether another attempt can continue with a file or a part of one."""
    return any(
        # huggingface_hub keeps locks and metadata in .cache, beside the parts of files
        path.suffix == ".incomplete" or path.relative_to(files).parts[0] != ".cache"
        for path in files.rglob("*")
        if path.is_file() and path.stat().st_size
    )
