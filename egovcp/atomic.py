"""Files that are complete or not there at all, also after a crash."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


def write_text(path: Path, text: str) -> None:
    """Write a file, or replace it."""
    temporary = path.with_name(f".{path.name}.partial")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as strict JSON: NaN and infinities raise `ValueError`."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
