"""Checks of the folder to which a dataset is written, and its lock.

A dataset folder is replaced as a whole, by renaming folders beside it. The checks show before any
work starts whether that is possible.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.files import user_path
from egovcp.outputs import nearest_existing, require_not_input, require_writable


def resolve_root(root: str | Path) -> Path:
    """The absolute path of a dataset folder without symbolic links; it need not exist.

    Locks and renames must use this path: through a link they would replace the link, and two
    writers could hold different locks.
    """
    try:
        return user_path(root).resolve()
    except OSError as error:
        raise UsageError(f"{root}: {error.strerror}; give an absolute path") from error
    except RuntimeError as error:
        raise UsageError(f"{root} is a loop of symbolic links; remove it") from error


def is_vacant(root: Path) -> bool:
    """Whether a dataset can appear at ``root``: nothing is there, or an empty folder."""
    if not root.is_dir():
        return not os.path.lexists(root)
    with os.scandir(root) as entries:
        return next(entries, None) is None


def require_new(root: Path) -> None:
    """Raise unless ``root`` is absent or an empty folder, and can be created and replaced."""
    if not is_vacant(root):
        raise UsageError(
            f"output folder {root} exists already and is not empty; choose another or remove it"
        )
    if not nearest_existing(root.parent).is_dir():
        raise _below_file(root)
    require_writable(root.parent)
    require_replaceable(root)


def require_outside(root: Path, file: str, option: str = "--json") -> None:
    """Raise `UsageError` if the output ``file`` would be part of the dataset ``root``."""
    require_not_input(file, option, root / "data", root / "meta")


def require_replaceable(root: Path) -> None:
    """Raise `EnvironmentFailure` if ``root`` is a mount point, which cannot be renamed."""
    if os.path.ismount(root):
        raise EnvironmentFailure(
            f"{root} is a mount point; a dataset is replaced as a whole folder, which a mount "
            f"point does not allow: use a folder inside it, such as {root / 'dataset'}"
        )


def make_parent(root: Path) -> None:
    """Create the parent of ``root``; raises `UsageError` if that would be below a file."""
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise _below_file(root) from error


def _below_file(root: Path) -> UsageError:
    return UsageError(f"output folder {root} would be below a file; choose another")


@contextmanager
def writer_lock(root: Path, folder: Path) -> Iterator[None]:
    """Hold the lock of the dataset at ``root``, a file in ``folder``, within the block.

    The system releases it when the process ends. Raises `EnvironmentFailure` immediately if another
    process holds it.
    """
    lock, owner, holder = FileLock(folder / "lock"), folder / "owner", "another process"
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        with suppress(OSError):
            holder = owner.read_text(encoding="utf-8") or holder
        raise EnvironmentFailure(
            f"{root} is being written by {holder}; wait for it, or choose another folder"
        ) from error
    try:
        owner.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        with suppress(OSError):
            owner.unlink(missing_ok=True)
        lock.release()
