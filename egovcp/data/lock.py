"""One writer per dataset."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from egovcp.errors import EnvironmentFailure


@contextmanager
def only_writer(root: Path, folder: Path) -> Iterator[None]:
    """Hold the lock of the dataset at ``root``, a file in ``folder``. The system frees it when the
    process ends, however it ends.

    Raises:
        EnvironmentFailure: at once, if another process holds it.
    """
    lock, owner = FileLock(folder / "lock"), folder / "owner"
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise EnvironmentFailure(
            f"{root} is being written by {_read(owner)}; wait for it, or choose another folder"
        ) from error
    try:
        owner.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        with suppress(OSError):
            owner.unlink(missing_ok=True)
        lock.release()


def _read(owner: Path) -> str:
    try:
        return owner.read_text(encoding="utf-8") or "another process"
    except OSError:
        return "another process"
