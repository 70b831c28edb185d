"""Checks the files and folders that a command will write before its work starts.

    @dataclass(frozen=True)
    class InfoConfig:
        json: str = output_file()

`egovcp.cli` checks such options after parsing. `write_report` writes the file.
"""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import suppress
from dataclasses import field
from pathlib import Path
from typing import Any, Final

from egovcp.bounds import as_flag_value, leaf_options
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.files import UnsafeFileError, partial_path, require_regular, user_path, write_text

STDOUT: Final = "-"
"""Standard output, where an option allows it."""

_KEY: Final = "output_file"


def output_file(*, or_stdout: bool = False) -> str:
    """A dataclass field for a file to write, or `STDOUT` if allowed; default: empty, no file."""
    exceptions = ("", STDOUT) if or_stdout else ("",)
    option: str = field(default="", metadata={_KEY: exceptions})
    return option


def check_output_files(config: Any, prefix: str = "") -> None:
    """Call `require_output_file` for every `output_file` of a dataclass and nested ones."""
    for name, option, value in leaf_options(config, prefix):
        if _KEY in option.metadata and value not in option.metadata[_KEY]:
            require_output_file(value, name)


def require_output_file(file: str, option: str) -> None:
    """Raise unless ``file`` is a regular file, or a new file can be created there.

    Files are replaced by renaming, which would replace a FIFO, a device or a dangling link too.

    Args:
        file: its path; ``~`` is expanded; missing folders are allowed.
        option: the flag, for messages.

    Raises:
        UsageError: another kind of file exists, a parent is a file, or the name is too long.
        EnvironmentFailure: no permission, or a read-only file system.
    """
    path, named = user_path(file), f"{option}={as_flag_value(file)}"
    try:
        if os.path.lexists(path):
            require_regular(path)
        else:
            nearest_existing(partial_path(path))  # raises if the name is too long
    except UnsafeFileError as error:
        raise UsageError(f"{named} cannot be a file: found {error}") from error
    except PermissionError as error:
        raise EnvironmentFailure(f"{named}: {error.strerror}") from error
    except FileNotFoundError as error:
        raise UsageError(f"{named} is a symbolic link to nothing; remove it") from error
    except OSError as error:
        raise UsageError(f"{named} cannot be a file: {error.strerror}") from error
    existing = nearest_existing(path.parent)
    if not existing.is_dir():
        raise UsageError(f"{named} cannot be a file: {existing} is not a folder")
    try:
        require_writable(path.parent)
    except EnvironmentFailure as error:
        raise EnvironmentFailure(f"{named}: {error}") from error


def require_not_input(file: str, option: str, *inputs: Path) -> None:
    """Raise `UsageError` if ``file`` is one of the ``inputs``, or lies in one that is a folder."""
    path = user_path(file).resolve()
    for source in (source.resolve() for source in inputs if file):
        if path == source or path.is_relative_to(source):
            raise UsageError(f"{option}={as_flag_value(file)} is part of the input; name another")


def require_writable(folder: Path) -> None:
    """Raise unless files can be created in ``folder``, or the folder itself can be created.

    Raises:
        EnvironmentFailure: no permission or space, or a parent is a file or a broken link.
        OSError: the path is too long.
    """
    existing = nearest_existing(folder)
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise EnvironmentFailure(f"cannot write to {existing}: {error.strerror}") from error


def write_report(file: str, content: Any, durable: bool = True) -> None:
    """Write strict JSON to the file of --json, if any; missing folders are created.

    Raises:
        UsageError: the path is a folder, or below a file.
        ValueError: ``content`` holds NaN or infinite numbers.
    """
    if not file:
        return
    path = user_path(file)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n", durable)
    except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        raise UsageError(f"--json={file} cannot be a file: {error.strerror}") from error


def nearest_existing(path: Path) -> Path:
    """The path or its nearest existing parent; links are not followed."""
    for candidate in (path, *path.absolute().parents):
        with suppress(FileNotFoundError, NotADirectoryError):
            candidate.lstat()
            return candidate
    raise FileNotFoundError(str(path))
