"""A temporary folder per run, which the next run removes if this one was killed.

The folder holds a file that the process has locked: the system releases the lock when the process
ends, in whatever way. Each folder gets its name only once its lock is held, so that none can be
seen without it.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

_PREFIX: Final = "egovcp-run-"
_NEW_PREFIX: Final = ".egovcp-new-"
_LOCK: Final = "lock"


@contextmanager
def run_folder(parent: Path | None = None) -> Iterator[Path]:
    """A folder for the sockets of one run; removed afterwards, as are those of killed runs.

    Args:
        parent: where; None: the system's temporary directory.
    """
    parent = parent or Path(tempfile.gettempdir())
    remove_stale(parent)
    new = Path(tempfile.mkdtemp(prefix=_NEW_PREFIX, dir=parent))
    lock = os.open(new / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    folder = new.with_name(_PREFIX + new.name.removeprefix(_NEW_PREFIX))
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        new.rename(folder)
        yield folder
    finally:
        for path in (new, folder):
            shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def remove_stale(parent: Path) -> None:
    """Remove the folders in ``parent`` of this user's runs whose process is gone."""
    for folder in parent.glob(f"{_PREFIX}*"):
        with suppress(OSError):  # of another user, or removed by another run just now
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
            finally:
                os.close(lock)
