"""The SHA-256 of every file of a dataset, in ``meta/sha256.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from egovcp.data import metadata, schema
from egovcp.data.parquet import damaged, open_parquet
from egovcp.data.paths import files_below, require_file
from egovcp.errors import DataError
from egovcp.safe_files import sha256

#: Below these folders every file must be listed.
_COVERED = ("data", "meta")
_UNLISTED = (schema.HASHES_PATH, schema.SOURCE_PATH)
_LIST_BYTES: Final = 256 << 20  # 10^6 shards
_OTHER_BYTES: Final = 1 << 30


def load_hashes(root: Path) -> Mapping[str, str]:
    """Relative path -> SHA-256; empty for a dataset that other tools wrote.

    Raises:
        DataError: the list is damaged.
    """
    path = root / schema.HASHES_PATH
    if not path.exists():
        return {}
    require_file(root, path)
    hashes = metadata.load_object(path, limit_bytes=_LIST_BYTES)
    if not hashes or not all(isinstance(value, str) for value in hashes.values()):
        raise DataError.at(path, "expected the SHA-256 of each file")
    return hashes


def covered(root: Path) -> list[str]:
    """Relative paths of the files that the list must hold, sorted."""
    found = (
        path.relative_to(root).as_posix()
        for folder in _COVERED
        for path in files_below(root / folder)
    )
    return sorted(set(found) - set(_UNLISTED))


def verify_hashes(root: Path) -> None:
    """Compare every file with the list, if there is one.

    Raises:
        DataError: naming the first file that is missing, not listed, or different.
    """
    for error in hash_problems(root):
        raise error


def hash_problems(root: Path) -> Iterator[DataError]:
    """Every file that is missing, not listed, or different; nothing if there is no list."""
    hashes = load_hashes(root)
    present = set(covered(root)) if hashes else set()
    for name in sorted({*hashes, *present}):
        if name not in hashes:
            yield DataError.at(root / name, f"not listed in {schema.HASHES_PATH}; remove it")
        elif name not in present:
            yield DataError.at(root / name, "missing; the dataset is incomplete")
        else:
            yield from _difference(root, name, hashes[name])


def _difference(root: Path, name: str, expected: str) -> Iterator[DataError]:
    path = root / name
    try:
        require_file(root, path)
        if path.suffix == ".parquet":
            open_parquet(path)  # refuses huge sparse files, which would take hours to hash
        with damaged(path):
            found = sha256(path, None if path.suffix == ".parquet" else _OTHER_BYTES)
    except DataError as error:
        yield error
        return
    if found != expected:
        yield DataError.at(
            root / name, f"damaged: its SHA-256 is not the one in {schema.HASHES_PATH}"
        )
