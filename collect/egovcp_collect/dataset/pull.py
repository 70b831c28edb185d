"""`egovcp-dataset pull`: one commit of a dataset on the Hub to a folder."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path

from egovcp.data import DatasetConfig, DatasetReader, schema
from egovcp.data.destination import require_new, resolve_root, writer_lock
from egovcp.data.files import sync_tree
from egovcp.data.metadata import verify_hashes
from egovcp.data.source import Source, read_source, write_source
from egovcp.data.writer import publish_version
from egovcp.errors import DataError, UsageError
from egovcp.hub import RetryPolicy, fetch, is_repo_id, resolve
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo


@dataclass(frozen=True)
class PullConfig:
    """Download a dataset from the Hub, pinned to one commit, to a folder of its own.

    The folder appears when everything has arrived and its hashes agree. A pull that failed can
    be repeated: the files that have arrived are kept aside and used.
    """

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: its id on the Hub, and the revision; empty: the latest."""
    output_dir: str = ""
    """The new folder."""
    network: RetryPolicy = field(default_factory=RetryPolicy)
    """How long to try."""
    json: str = output_file()
    """File for {"repo_id", "commit", "root", "episodes", "frames"}; empty: none."""


CONFIG = PullConfig


def run(config: PullConfig) -> None:
    """Download, check, and say what came.

    Raises:
        UsageError: no id, or the folder is taken.
        DataError: the Hub has no such dataset, or what it has is damaged.
        EnvironmentFailure: the Hub cannot be reached, or refuses; the folder is a mount point.
    """
    repo_id = config.dataset.repo_id
    if config.dataset.root or not is_repo_id(repo_id):
        raise UsageError("pull takes the id of a dataset on the Hub, user/name")
    if not config.output_dir:
        raise UsageError("--output_dir is missing: the new folder for the dataset")
    root = resolve_root(config.output_dir)
    if not (root / schema.SOURCE_PATH).is_file():
        require_new(root)
    commit = resolve(repo_id, config.dataset.revision, config.network)
    if _is_there(root, repo_id, commit):
        echo(f"{root} is {repo_id}@{commit} already")
    else:
        require_new(root)
        _bring(Source(root, repo_id, commit), config.network)
    _report(config, DatasetReader.open(DatasetConfig(root=str(root))))


def _is_there(root: Path, repo_id: str, commit: str) -> bool:
    if not (root / schema.SOURCE_PATH).is_file() or read_source(root) != Source(
        root, repo_id, commit
    ):
        return False
    verify_hashes(root)
    return True


def _bring(source: Source, retry: RetryPolicy) -> None:
    """Everything into a folder aside, then that folder to its place."""
    aside = source.root.with_name(f".{source.root.name}.pull")
    files = aside / "files"
    files.mkdir(parents=True, exist_ok=True)
    with writer_lock(source.root, aside):
        try:
            fetch(source.repo_id, source.commit, files, retry)
        except BaseException:
            if not _has_arrived(files):
                shutil.rmtree(aside, ignore_errors=True)
            raise
        try:
            (files / schema.SOURCE_PATH).unlink(missing_ok=True)
            verify_hashes(files)
            DatasetReader.open(DatasetConfig(root=str(files)))
        except DataError:  # that is the commit itself: fetching it again would not help
            shutil.rmtree(aside)
            raise
        write_source(Source(files, source.repo_id, source.commit))
        sync_tree(files)
        publish_version(files, source.root)
    shutil.rmtree(aside, ignore_errors=True)


def _has_arrived(files: Path) -> bool:
    """Whether there is anything that the next attempt can use."""
    found = (path for path in files.rglob("*") if path.is_file() and path.stat().st_size)
    # in .cache huggingface_hub keeps locks and notes beside the parts of files
    return any(
        path.suffix == ".incomplete" or path.relative_to(files).parts[0] != ".cache"
        for path in found
    )


def _report(config: PullConfig, reader: DatasetReader) -> None:
    source = reader.source
    echo(f"{source.root}: {source.repo_id}@{source.commit}")
    echo(f"{len(reader)} episodes, {reader.num_frames} steps")
    echo(f"egovcp-train --dataset.root={source.root}")
    facts = {
        "repo_id": source.repo_id,
        "commit": source.commit,
        "root": str(source.root),
        "episodes": len(reader),
        "frames": reader.num_frames,
    }
    write_report(config.json, facts)
