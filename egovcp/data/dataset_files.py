"""Disk writes of dataset files, so that tests can simulate disk failures."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import shutil
import sys
from pathlib import Path
from typing import IO, Any, Final

from egovcp.files import sync as sync

_AT_FDCWD: Final = -100
_RENAME_EXCHANGE: Final = 2  # linux/fs.h
_NO_LINK: Final = (errno.EPERM, errno.ENOTSUP, errno.EMLINK, errno.ENOSYS, errno.EXDEV)


def open_new(path: Path) -> IO[bytes]:
    """Open a new file for writing; its folder is created if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.open("xb")


def create_file(path: Path, content: bytes | memoryview) -> None:
    """Write a new file."""
    with open_new(path) as file:
        file.write(content)


def create_json(path: Path, content: Any) -> None:
    """Write a new file of ``content`` as strict JSON: NaN and infinities raise `ValueError`."""
    create_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def sync_tree(folder: Path) -> None:
    """Flush ``folder`` and everything in it to the disk."""
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def rename(source: Path, target: Path) -> None:
    """Move a file or folder, atomically; a file replaces another."""
    os.rename(source, target)


def link(source: Path, target: Path) -> None:
    """Hard-link ``source`` to ``target``; copies if the file system has no hard links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise
        shutil.copyfile(source, target)
        sync(target)


def exchange(one: Path, other: Path) -> None:
    """Swap two folders atomically.

    Raises:
        OSError: EINVAL or ENOSYS if the system or the file system does not support it.
    """
    is_linux = sys.platform.startswith("linux")
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if is_linux else None
    if renameat2 is None:  # the C library may be older than the system call
        raise OSError(errno.ENOSYS, "exchanging folders needs renameat2 of Linux", str(one))
    if renameat2(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), str(one))
