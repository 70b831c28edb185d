"""What the mutations of a dataset have in common."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from egovcp.data.metadata import hashed_files
from egovcp.files import sha256, write_json
from tests.support.file_mutations import Random

from .damage import (
    COLLECTION,
    DATA,
    EPISODES,
    HASHES,
    INFO,
    MORE_DATA,
    MORE_EPISODES,
    STATS,
    TASKS,
)

type Mutate = Callable[[Path, Random], str]
"""Damages the dataset; returns the files, separated by ``|``, one of which must be named."""

JSON_FILES: Final = (INFO, STATS, COLLECTION)
PARQUET_FILES: Final = (DATA, MORE_DATA, EPISODES, MORE_EPISODES, TASKS)
ALL_FILES: Final = (*JSON_FILES, *PARQUET_FILES)
#: Damage in one file may first show in another one that contradicts it.
ANY_FILE: Final = "|".join((*ALL_FILES, HASHES))
MARKER: Final = "code-was-executed"
SPARSE_BYTES: Final = 1 << 40


def write_hashes(root: Path) -> None:
    """List the SHA-256 of the files as they are now."""
    write_json(root / HASHES, {name: sha256(root / name) for name in hashed_files(root)})


def settle_hashes(root: Path, rng: Random) -> None:
    """Remove the list of SHA-256, or renew it."""
    (root / HASHES).unlink()
    if rng.random() < 0.5:
        write_hashes(root)
