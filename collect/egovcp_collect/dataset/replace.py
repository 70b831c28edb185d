"""Result files: written whole, in the place of an older one."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from egovcp.atomic import write_text
from egovcp.errors import UsageError


def write_report(file: str, content: Any) -> None:
    """Write the result of a command to ``--json=file``; nothing if it is empty.

    Raises:
        UsageError: the path is a folder, or lies below a file.
    """
    if not file:
        return
    try:
        replace_json(Path(os.path.expanduser(file)), content)
    except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        raise UsageError(f"--json={file} cannot be a file: {error.strerror}") from error


def replace_json(path: Path, content: Any) -> None:
    """Write ``content`` as JSON, strictly: NaN and infinities raise `ValueError`."""
    replace_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a whole file in the place of any other: a reader sees the old or the new one.

    Never writes through a link, so that an older version of the dataset keeps its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
