"""Where a dataset lies: a folder, LeRobot's local cache, or the Hub at a pinned commit."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from egovcp.cli import DatasetConfig
from egovcp.data import schema
from egovcp.errors import DataError, EnvironmentFailure, UsageError

_REPO_ID = re.compile(r"\w[\w.-]*/\w[\w.-]*", re.ASCII)


@dataclass(frozen=True)
class Source:
    """A dataset folder and, if it came from the Hub, the commit that it is."""

    root: Path
    repo_id: str
    commit: str = ""


def lerobot_home() -> Path:
    """``$HF_LEROBOT_HOME``, the folder in which LeRobot keeps datasets by id."""
    from huggingface_hub.constants import HF_HOME

    return Path(os.environ.get("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot")).expanduser()


def local_root(config: DatasetConfig) -> Path:
    """The folder that ``config`` names: its root, or LeRobot's place for the repo id.

    Raises:
        UsageError: neither root nor a well-formed repo id is given.
    """
    if config.root:
        return Path(config.root).expanduser().absolute()
    _require_repo_id(config.repo_id)
    return lerobot_home() / config.repo_id


def locate(config: DatasetConfig) -> Source:
    """Find the dataset; download it only if no root is given and no local copy exists.

    Raises:
        UsageError: bad or missing id, or a revision asked of a folder.
        DataError: no dataset there.
        EnvironmentFailure: the Hub cannot be reached.
    """
    root = local_root(config)
    if config.root and config.revision:
        raise UsageError(
            "--dataset.revision pins a dataset of the Hub and cannot be checked for a folder; "
            "drop it, or drop --dataset.root"
        )
    if (root / schema.INFO_PATH).is_file() and not config.revision:
        return Source(root, config.repo_id)
    if config.root:
        raise DataError(
            f"no dataset at {root}: {schema.INFO_PATH} is missing; check --dataset.root"
        )
    return _download(config)


def is_repo_id(text: str) -> bool:
    """Whether ``text`` has the form of an id on the Hub, ``user/name``."""
    return bool(_REPO_ID.fullmatch(text)) and ".." not in text


def _require_repo_id(repo_id: str) -> None:
    if not repo_id:
        raise UsageError("which dataset? give --dataset.repo_id=user/name or --dataset.root=FOLDER")
    if not is_repo_id(repo_id):
        raise UsageError(f"--dataset.repo_id={repo_id!r} is not of the form user/name")


def _download(config: DatasetConfig) -> Source:
    import httpx
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import (
        GatedRepoError,
        HfHubHTTPError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    name = f"{config.repo_id}@{config.revision or 'main'}"
    try:
        folder = snapshot_download(
            config.repo_id,
            repo_type="dataset",
            revision=config.revision or None,
            cache_dir=lerobot_home() / "hub",
        )
    except RevisionNotFoundError as error:
        raise DataError(f"the Hub has dataset {config.repo_id}, but not {name}") from error
    except GatedRepoError as error:
        raise DataError(f"dataset {name} is gated; ask its owner for access") from error
    except RepositoryNotFoundError as error:
        raise DataError(
            f"no dataset {name}, neither in {lerobot_home()} nor on the Hub (or it is private: "
            "run `hf auth login`)"
        ) from error
    except (
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        HfHubHTTPError,
        httpx.HTTPError,
    ) as error:
        raise EnvironmentFailure(
            f"cannot fetch dataset {name} from the Hub: {_first_line(error)}; check the network, "
            "or give --dataset.root"
        ) from error
    root = Path(folder)
    return Source(root, config.repo_id, commit=root.name)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
