"""A file that grows by whole pieces and reaches the disk at most a second late."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final

SYNC_PERIOD_S: Final = 1.0


class AppendFile:
    """Collects what is written and appends it at `flush`, as a whole or not at all.

    A killed process loses nothing that was flushed. Losing power loses at most ``sync_period_s``
    more than that: `flush` tells the disk to keep what it has, but no more often, since that
    may take long. When the disk is full the piece that did not fit is removed again, so that
    the file ends with a whole one; it is kept here, and the next `flush` tries again.

    Args:
        path: the file to create; raises `FileExistsError` when it exists.
        sync_period_s: seconds between two commands to the disk; infinity for none but the last.
    """

    def __init__(self, path: Path, sync_period_s: float = SYNC_PERIOD_S) -> None:
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()
        self._size = 0
        self._period = sync_period_s
        self._synced = time.monotonic()
        _sync_folder(path.absolute().parent)

    def write(self, data: bytes) -> int:
        """Collect ``data``."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Size of the file and of what has been collected."""
        return self._size + len(self._pending)

    def flush(self) -> None:
        """Append what has been collected; raises OSError after taking back a part of it."""
        try:
            _write_all(self._file.fileno(), self._pending)
        except OSError:
            os.ftruncate(self._file.fileno(), self._size)
            os.lseek(self._file.fileno(), self._size, os.SEEK_SET)
            raise
        self._size += len(self._pending)
        self._pending = bytearray()
        if time.monotonic() - self._synced >= self._period:
            self._sync()

    def close(self) -> None:
        """Append what has been collected, keep all of it on the disk, and close the file."""
        try:
            self.flush()
            self._sync()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without what has been collected."""
        self._file.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced = time.monotonic()


def _write_all(descriptor: int, data: bytearray) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def _sync_folder(folder: Path) -> None:
    """The name of a new file is kept, too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
