"""Sealed episodes that wait to be committed: one file each, complete or not there at all.

A file's name holds the episode's number in the run and the SHA-256 of the content: it says by
itself whether it is whole.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pyarrow as pa

from egovcp.data import files
from egovcp.data.encoded import EncodedEpisode, from_buffer, to_bytes
from egovcp.errors import EnvironmentFailure
from egovcp.safe_files import sha256

_NAME: Final = re.compile(r"(\d{9})-([0-9a-f]{64})\.arrow")


@dataclass(frozen=True)
class SealedEpisode:
    """An encoded episode with its number in the run and the SHA-256 of its bytes."""

    number: int
    sha256: str
    payload: bytes

    @classmethod
    def of(cls, number: int, encoded: EncodedEpisode) -> SealedEpisode:
        """Seal an episode."""
        payload = to_bytes(encoded).to_pybytes()
        return cls(number, hashlib.sha256(payload).hexdigest(), payload)

    def require_whole(self) -> None:
        """Raise `EnvironmentFailure` unless the bytes are those that were sealed; for episodes
        that have travelled."""
        if hashlib.sha256(self.payload).hexdigest() != self.sha256:
            raise EnvironmentFailure(
                f"episode {self.number} arrived damaged: its SHA-256 is not {self.sha256}"
            )


class Spool:
    """A folder of sealed episodes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put(self, sealed: SealedEpisode) -> None:
        """Store an episode; it is there, whole and flushed to the disk, or not at all."""
        name = f"{sealed.number:09d}-{sealed.sha256}.arrow"
        partial = self.folder / f".{name}.{os.getpid()}"
        try:
            files.write_bytes(partial, sealed.payload)
            files.sync(partial)
            files.rename(partial, self.folder / name)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
        files.sync(self.folder)

    def numbers(self) -> set[int]:
        """Numbers of the episodes that are here."""
        return {number for number, _, _ in self._files()}

    def get(self, number: int) -> EncodedEpisode | None:
        """The episode, or None if it is not here or not whole (then it is removed)."""
        for path in self.folder.glob(f"{number:09d}-*.arrow"):
            found = _read(path)
            if found is not None:
                return found
            path.unlink(missing_ok=True)
        return None

    def drop_before(self, number: int) -> None:
        """Forget the episodes with lower numbers."""
        for found, _, path in self._files():
            if found < number:
                path.unlink(missing_ok=True)

    def sweep(self) -> None:
        """Remove what interrupted writers left, and what is not whole any more."""
        for path in self.folder.glob(".*"):
            path.unlink(missing_ok=True)  # a worker that outlived its service may be at it, too
        for _, _, path in self._files():
            if _read(path) is None:
                path.unlink(missing_ok=True)

    def size(self) -> int:
        """Bytes on disk."""
        return sum(path.stat().st_size for _, _, path in self._files() if path.exists())

    def _files(self) -> Iterator[tuple[int, str, Path]]:
        for path in sorted(self.folder.iterdir()):
            match = _NAME.fullmatch(path.name)
            if match:
                yield int(match[1]), match[2], path


def _read(path: Path) -> EncodedEpisode | None:
    """The episode in a sealed file; None if the content is not what was sealed."""
    match = _NAME.fullmatch(path.name)
    if match is None or sha256(path) != match[2]:
        return None
    return from_buffer(pa.memory_map(str(path)).read_buffer())
