"""Finds a dataset and its selected episodes.

A dataset is a folder, LeRobot's local folder, or on the Hub at a pinned commit. A selection is
written ``[0, 5, 7]``, ``0:1334`` or ``[0:100, 250]``.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import as_flag_value
from egovcp.data import schema
from egovcp.data.dataset_files import create_json
from egovcp.dataset_options import DatasetConfig
from egovcp.errors import DataError, UsageError, suggest_path
from egovcp.files import read_json, user_path
from egovcp.hub import HubFileCache, RetryPolicy, is_repo_id, snapshot

_RETRY_POLICY = RetryPolicy()
_PART = re.compile(r"(\d{1,18})|(\d{0,18}):(\d{0,18})", re.ASCII)


@dataclass(frozen=True)
class Source:
    """A dataset folder and, if it was downloaded, its repository and commit."""

    root: Path
    repo_id: str
    commit: str = ""


def lerobot_home() -> Path:
    """``$HF_LEROBOT_HOME``, the folder in which LeRobot keeps datasets by id."""
    from huggingface_hub.constants import HF_HOME

    return user_path(os.environ.get("HF_LEROBOT_HOME", f"{HF_HOME}/lerobot"))


def local_root(config: DatasetConfig) -> Path:
    """The folder that ``config`` names: its root, or LeRobot's folder for the repo id.

    Raises:
        UsageError: bad or missing id, or a revision given with a folder.
    """
    if config.root and config.revision:
        raise UsageError(
            "--dataset.revision selects a version on the Hub and cannot be checked for a folder; "
            "drop it, or drop --dataset.root"
        )
    if config.root:
        return user_path(config.root).absolute()
    _require_repo_id(config.repo_id)
    return lerobot_home() / config.repo_id


def locate(config: DatasetConfig, retry: RetryPolicy = _RETRY_POLICY) -> Source:
    """Find the dataset; download it only if no root is given, and no local copy exists or a
    revision is given.

    If the Hub cannot be reached, a complete earlier download is used.

    Raises:
        UsageError: bad or missing id, or a revision given with a folder.
        DataError: there is no dataset.
        EnvironmentFailure: the Hub cannot be reached, or refuses.
    """
    root = local_root(config)
    if (root / schema.INFO_PATH).is_file() and not config.revision:
        return read_source(root, config.repo_id)
    if config.root:
        require_folder(root)
        raise DataError(f"no dataset at {root}: {schema.INFO_PATH} is missing")
    folder = snapshot(config.repo_id, config.revision, retry, cache_dir=hub_cache())
    return Source(folder, config.repo_id, commit=folder.name)


def locate_on_demand(
    config: DatasetConfig, retry: RetryPolicy = _RETRY_POLICY
) -> tuple[Source, HubFileCache | None]:
    """As `locate`, but of a dataset on the Hub only its `meta` folder is downloaded.

    The cache downloads its other files when they are needed; None: all files are in the folder.
    """
    if is_local(config):
        return locate(config, retry), None
    cache = HubFileCache(config.repo_id, config.revision, retry, hub_cache(), ["meta/*"])
    return Source(cache.folder, cache.repo_id, cache.commit), cache


def require_folder(root: Path) -> None:
    """Raise `DataError`, which suggests a similar name, unless ``root`` is a folder."""
    if not os.path.lexists(root):
        raise DataError(f"no such folder: {root}{suggest_path(root)}")
    if not root.is_dir():
        raise DataError(f"{root} is not a folder; expected the folder of a dataset")


def is_local(config: DatasetConfig) -> bool:
    """Whether the dataset is a folder: the root, or LeRobot's if no revision is given."""
    there = (local_root(config) / schema.INFO_PATH).is_file()
    return bool(config.root) or (there and not config.revision)


def write_source(source: Source) -> None:
    """Write ``meta/source.json``, which identifies the commit of a downloaded folder."""
    content = {"repo_id": source.repo_id, "commit": source.commit}
    create_json(source.root / schema.SOURCE_PATH, content)


def read_source(root: Path, repo_id: str = "") -> Source:
    """The source of a folder, with the commit in ``meta/source.json`` if that is of ``repo_id``."""
    path = root / schema.SOURCE_PATH
    if not path.is_file():
        return Source(root, repo_id)
    try:
        content = read_json(path)
        found = Source(root, str(content["repo_id"]), str(content["commit"]))
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is damaged; remove it, or pull the dataset again") from error
    return found if repo_id in ("", found.repo_id) else Source(root, repo_id)


def _require_repo_id(repo_id: str) -> None:
    if not repo_id:
        raise UsageError(
            "no dataset is named; give --dataset.repo_id=user/name or --dataset.root=FOLDER"
        )
    if not is_repo_id(repo_id):
        raise UsageError(f"--dataset.repo_id={repo_id!r} is not of the form user/name")


def hub_cache() -> Path:
    """LeRobot's folder of downloads."""
    return lerobot_home() / "hub"


def select_episodes(text: str, count: int, flag: str = "--dataset.episodes") -> NDArray[np.int64]:
    """The selected ones of ``count`` episodes, ascending and unique; all if ``text`` is empty.

    ``text`` holds numbers and half-open ranges ``first:end``, separated by commas; either end of a
    range may be omitted. A single number needs brackets: YAML reads an unquoted ``1:30`` as
    the number 90, which must not be taken for an episode. ``flag`` is the option, for messages.
    """
    inner = text.strip()
    if not inner:
        return np.arange(count)
    given = f"{flag}={as_flag_value(text)}"
    if inner[0] + inner[-1] in ("[]", "()"):
        inner = inner[1:-1]
    elif inner.isdigit():
        number = as_flag_value(inner)
        raise UsageError(
            f"{given}: for a single episode write [{number}], for the first ones 0:{number}; in "
            f"YAML, quote a range: '0:{number}'"
        )
    parts = [_part(part.strip(), given, count) for part in inner.split(",")]
    wanted: NDArray[np.int64] = np.unique(np.concatenate(parts))
    return wanted


def _part(part: str, given: str, count: int) -> NDArray[np.int64]:
    found = _PART.fullmatch(part)
    if found is None:
        raise UsageError(
            f"{given}: {as_flag_value(part)!r} is not an episode; expected numbers, [0, 5, 7], a "
            "half-open range, 0:1334, or both, [0:100, 250]"
        )
    number, first, end = found.groups()
    start = int(number or first or 0)
    stop = start + 1 if number else int(end or count)
    if start >= stop:
        raise UsageError(
            f"{given}: {as_flag_value(part)} selects no episode; there are {count}, and a range "
            "FIRST:END needs FIRST < END"
        )
    if stop > count:
        raise UsageError(
            f"{given} names episode {stop - 1}, but the dataset has {count} episodes, "
            f"0 to {count - 1}"
        )
    return np.arange(start, stop)
