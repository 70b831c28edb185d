"""A cache folder for compiled code that no other user can write to.

Ownership and permissions are checked as OpenSSH checks ``~/.ssh``. The SHA-256 of each file is
stored in ``NAME.sha256``, in the format of ``sha256sum``.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from egovcp.errors import EnvironmentFailure
from egovcp.files import UnsafeFileError, read_bytes, removed_on_error, sync

_WRITABLE_BY_OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH
_LARGEST_FILE: Final = 64 << 20


def user_cache_folder() -> Path | None:
    """``$XDG_CACHE_HOME/egovcp`` or ``~/.cache/egovcp``; None if the user has no home folder, as in
    ``docker run --user 12345``."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(root):
        return Path(root) / "egovcp"
    try:
        return Path.home() / ".cache" / "egovcp"
    except RuntimeError:
        return None


class TrustedCache:
    """A cache folder, created with mode 0700 if it is missing.

    Raises:
        EnvironmentFailure: another user owns it or can write to it, or it is a symbolic link.
        OSError: it cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        _make_private(folder)
        if folder.is_symlink():
            raise EnvironmentFailure(
                f"the cache folder {folder} is a symbolic link, expected a folder; remove it, or "
                "set XDG_CACHE_HOME to another folder"
            )
        for ancestor in _ancestors(folder):
            _require_trusted(ancestor, sticky=True)
        _require_trusted(folder, sticky=False)

    def read(self, name: str) -> bytes | None:
        """Content of a file; None if it is missing, not trusted, or does not match its digest."""
        try:
            content, digest = self._read(name), self._read(_digest_name(name))
        except (OSError, UnsafeFileError):
            return None
        return content if digest == _digest_line(name, content) else None

    def write(self, name: str, content: bytes) -> None:
        """Write a file and its digest durably and atomically.

        Raises:
            OSError: it cannot be written.
        """
        self._write(name, content)
        self._write(_digest_name(name), _digest_line(name, content))
        sync(self.folder)

    def _read(self, name: str) -> bytes:
        path = self.folder / name
        if path.is_symlink() or _distrust(path.stat()):
            raise UnsafeFileError("not trusted")
        return read_bytes(path, _LARGEST_FILE)

    def _write(self, name: str, content: bytes) -> None:
        with (
            tempfile.NamedTemporaryFile(dir=self.folder, delete=False) as file,  # mode 0600
            removed_on_error(Path(file.name)) as temporary,
        ):
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.rename(temporary, self.folder / name)


def load_library(content: bytes, name: str) -> ctypes.CDLL:
    """Load a shared library from memory (Linux); debuggers show its name.

    Raises:
        OSError: it is not a library for this machine, or there is no /proc.
    """
    if not hasattr(os, "memfd_create"):
        raise OSError("only Linux loads libraries from memory")
    descriptor = os.memfd_create(name)  # stays open: the loader identifies libraries by path
    with os.fdopen(descriptor, "wb", closefd=False) as file:
        file.write(content)
    return ctypes.CDLL(f"/proc/self/fd/{descriptor}")


def _make_private(folder: Path) -> None:
    """Create a folder and its missing parents, all with mode 0700."""
    if not folder.parent.exists():
        _make_private(folder.parent)
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)


def _ancestors(folder: Path) -> Iterator[Path]:
    """The parents of a folder, links resolved, up to the home folder or the root."""
    try:
        home: Path | None = Path.home().resolve()
    except RuntimeError:
        home = None
    for ancestor in folder.resolve().parents:
        yield ancestor
        if ancestor == home:
            return


def _distrust(status: os.stat_result, sticky: bool = False) -> str:
    """Why another user may have changed a file or folder; empty: none can.

    Args:
        sticky: accept a folder with the sticky bit that others can write to, such as ``/tmp``.
    """
    if status.st_uid not in (0, os.geteuid()):
        return f"belongs to user id {status.st_uid}, expected {os.geteuid()}"
    mode = stat.S_IMODE(status.st_mode)
    if mode & _WRITABLE_BY_OTHERS and not (sticky and mode & stat.S_ISVTX):
        return f"can be written by other users (mode {mode:04o})"
    return ""


def _require_trusted(path: Path, sticky: bool) -> None:
    if reason := _distrust(path.stat(), sticky):
        remedy = f"chmod go-w {path}, or " if "written" in reason else ""
        raise EnvironmentFailure(
            f"the cache folder is not safe to load code from: {path} {reason}; {remedy}set "
            "XDG_CACHE_HOME to a folder of your own"
        )


def _digest_name(name: str) -> str:
    return f"{name}.sha256"


def _digest_line(name: str, content: bytes) -> bytes:
    return f"{hashlib.sha256(content).hexdigest()}  {name}\n".encode()
