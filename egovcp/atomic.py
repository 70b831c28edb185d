"""Files that are complete or not there at all, also after a crash."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, or replace it; its mode follows the umask.

    `tempfile` and `safetensors.save_file` would create it for its owner only.
    """
    temporary = path.with_name(f".{path.name}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, or replace it; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as strict JSON: NaN and infinities raise `ValueError`."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
