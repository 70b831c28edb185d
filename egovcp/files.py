"""Safe reading and atomic writing of files.

Reading: a downloaded dataset or policy may hold a FIFO that never ends, a link to a device,
gigabytes of JSON, or deeply nested JSON that overflows the parser. These are refused with
`UnsafeFileError`. Its message has no path: callers turn it into an error that names the file.
Functions with a path raise OSError if the file is missing or cannot be read.

Writing: a file or folder is complete or absent, also after a crash.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

JSON_LIMIT_BYTES: Final = 4 << 20
"""Default size limit of a JSON file. Parsed JSON takes up to about 30 times as much memory."""
JSON_LIMIT_DEPTH: Final = 32
"""Limit of how deeply lists and objects are nested."""

_KINDS: Final[Mapping[int, str]] = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}
_STRING: Final = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"', re.DOTALL)
_DEPTH_CHANGE: Final = np.zeros(256, dtype=np.int8)  # by character
_DEPTH_CHANGE[list(b"[{")] = 1
_DEPTH_CHANGE[list(b"]}")] = -1


class UnsafeFileError(ValueError):
    """A file is not a regular file, is too large, or holds invalid or unsafe JSON."""


def user_path(path: str | Path) -> Path:
    """The path with ``~`` replaced by the home folder."""
    return Path(os.path.expanduser(path))  # `Path.expanduser` raises for unknown users


def require_regular(path: Path, limit_bytes: int | None = None) -> os.stat_result:
    """Raise unless ``path`` is a regular file of bounded size; links are followed.

    The file is not opened; for libraries that open it themselves.
    """
    found = path.stat()
    _check(found, limit_bytes)
    return found


def open_regular(path: Path, limit_bytes: int | None = None) -> BufferedReader:
    """Open a regular file of bounded size for reading; never blocks on a FIFO or a device."""
    require_regular(path, limit_bytes)  # before opening: opening a device can have effects
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC), "rb")
    try:
        _check(os.fstat(file.fileno()), limit_bytes)  # in case it was replaced
    except BaseException:
        file.close()
        raise
    return file


def read_bytes(path: Path, limit_bytes: int) -> bytes:
    """The content of a regular file of at most ``limit_bytes``."""
    with open_regular(path, limit_bytes) as file:
        content = file.read(limit_bytes + 1)  # files of /proc have size 0
    if len(content) > limit_bytes:
        raise UnsafeFileError(_too_large("more", limit_bytes))
    return content


def read_text(path: Path, limit_bytes: int) -> str:
    """The content of a UTF-8 text file; see `read_bytes`."""
    try:
        return read_bytes(path, limit_bytes).decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnsafeFileError(f"byte {error.start} is not UTF-8") from error


def read_json(path: Path, limit_bytes: int = JSON_LIMIT_BYTES) -> Any:
    """The content of a JSON file; see `read_text` and `parse_json`."""
    return parse_json(read_text(path, limit_bytes))


def parse_json(text: str) -> Any:
    """The value of an untrusted JSON text.

    Raises:
        UnsafeFileError: it is not JSON, nested more deeply than `JSON_LIMIT_DEPTH`, or holds a
            string that is not valid Unicode, or a number that is not finite.
    """
    check_depth(text)
    try:
        content = json.loads(text, parse_float=_finite, parse_constant=_refuse_constant)
    except UnsafeFileError:
        raise
    except ValueError as error:  # JSONDecodeError, or an integer of more than 4300 digits
        raise UnsafeFileError(f"not JSON: {error}") from error
    if "\\ud" in text.lower():  # escapes of surrogates: only pairs are valid
        try:
            json.dumps(content, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise UnsafeFileError("holds a string that is not valid Unicode") from error
    return content


def sha256(path: Path, limit_bytes: int | None = None) -> str:
    """Hexadecimal SHA-256 of a regular file."""
    with open_regular(path, limit_bytes) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(found: os.stat_result, limit_bytes: int | None) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "no regular file")
        raise UnsafeFileError(f"{kind}, expected a regular file")
    if limit_bytes is not None and found.st_size > limit_bytes:
        raise UnsafeFileError(_too_large(f"{found.st_size}", limit_bytes))


def _too_large(found: str, limit_bytes: int) -> str:
    return f"too large: {found} bytes, expected at most {limit_bytes}"


def check_depth(text: str) -> None:
    """Raise `UnsafeFileError` if brackets outside strings are nested more deeply than
    `JSON_LIMIT_DEPTH`."""
    bare = np.frombuffer(_STRING.sub("", text).encode("utf-8", "replace"), dtype=np.uint8)
    if len(bare) and _DEPTH_CHANGE[bare].cumsum(dtype=np.int32).max() > JSON_LIMIT_DEPTH:
        raise UnsafeFileError(f"nested more than {JSON_LIMIT_DEPTH} levels deep")


def _finite(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise UnsafeFileError(f"holds the number {text[:20]}, which is infinite")
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise UnsafeFileError(f"holds {name}, expected finite numbers")


# --- writing ----------------------------------------------------------------------
@contextmanager
def removed_on_error(path: Path) -> Iterator[Path]:
    """Yield ``path``; remove that file or folder if the block raises, also on Ctrl-C."""
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
    """The temporary file of `write_bytes`."""
    return path.with_name(f".{path.name}.partial")


def write_bytes(path: Path, content: bytes, durable: bool = True) -> None:
    """Create or replace a file; on an error the old file stays and no other file is left.

    The mode follows the umask (`tempfile` would make it readable by its owner only).

    Args:
        durable: call fsync.
    """
    with removed_on_error(partial_path(path)) as temporary:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        temporary.replace(path)


def sync(path: Path) -> None:
    """Flush one file or folder to the disk; that of a folder makes the names in it durable."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str, durable: bool = True) -> None:
    """Create or replace a UTF-8 text file; see `write_bytes`."""
    write_bytes(path, text.encode(), durable)


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as strict JSON: NaN and infinities raise `ValueError`."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
