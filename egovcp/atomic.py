"""Files and folders that are complete or not there at all, also after a crash."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def removed_on_error(path: Path) -> Iterator[Path]:
    """Remove a temporary file or folder if the block raises anything, Ctrl-C included.

    Args:
        path: need not exist; yielded.
    """
    try:
        yield path
    except BaseException:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        raise


def partial_path(path: Path) -> Path:
    """Where `write_bytes` writes before it renames."""
    return path.with_name(f".{path.name}.partial")


def write_bytes(path: Path, content: bytes, durable: bool = True) -> None:
    """Write a file, or replace it; its mode follows the umask.

    `tempfile` and `safetensors.save_file` would create it for its owner only.

    Args:
        path: the file; if anything fails it is as before, and nothing lies beside it.
        content: all of it.
        durable: wait until the disk has it.
    """
    with removed_on_error(partial_path(path)) as temporary:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        temporary.replace(path)


def write_text(path: Path, text: str, durable: bool = True) -> None:
    """Write a UTF-8 text file, or replace it; see `write_bytes`."""
    write_bytes(path, text.encode(), durable)


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as strict JSON: NaN and infinities raise `ValueError`."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
