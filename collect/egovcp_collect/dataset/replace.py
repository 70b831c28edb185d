"""Text files: written whole, in the place of an older one."""

from __future__ import annotations

from pathlib import Path

from egovcp.atomic import write_text


def replace_text(path: Path, text: str) -> None:
    """Write a whole file in the place of any other: a reader sees the old or the new one.

    Never writes through a link, so that an older version of the dataset keeps its own.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)
