"""The SHA-256 of every file of a dataset, in ``meta/sha256.json``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from egovcp.data import files, metadata, schema
from egovcp.errors import DataError

#: Below these folders every file must be listed.
_COVERED = ("data", "meta")
_UNLISTED = (schema.HASHES_PATH, schema.SOURCE_PATH)


def load_hashes(root: Path) -> Mapping[str, str]:
    """Relative path -> SHA-256; empty for a dataset that other tools wrote.

    Raises:
        DataError: the list is damaged.
    """
    path = root / schema.HASHES_PATH
    if not path.exists():
        return {}
    hashes = metadata.load_object(path)
    if not all(isinstance(value, str) for value in hashes.values()):
        raise DataError(f"{path}: expected the SHA-256 of each file")
    return hashes


def write_hashes(root: Path) -> None:
    """List every file of a dataset as it is now."""
    path = root / schema.HASHES_PATH
    path.unlink(missing_ok=True)
    files.write_json(path, {name: files.sha256(root / name) for name in covered(root)})


def covered(root: Path) -> list[str]:
    """Relative paths of the files that the list must hold, sorted."""
    found = (
        path.relative_to(root).as_posix()
        for folder in _COVERED
        for path in (root / folder).rglob("*")
        if not path.is_dir()
    )
    return sorted(set(found) - set(_UNLISTED))


def verify_hashes(root: Path) -> None:
    """Compare every file with the list, if there is one.

    Raises:
        DataError: naming the first file that is missing, not listed, or different.
    """
    hashes = load_hashes(root)
    if not hashes:
        return
    present = covered(root)
    for name in sorted({*hashes, *present}):
        if name not in hashes:
            raise DataError(f"{root / name} is not listed in {schema.HASHES_PATH}; remove it")
        if name not in present:
            raise DataError(f"{root / name} is missing; the dataset is incomplete")
        if files.sha256(root / name) != hashes[name]:
            raise DataError(
                f"{root / name} is damaged: its SHA-256 is not the one in {schema.HASHES_PATH}"
            )
