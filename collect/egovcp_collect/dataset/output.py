"""Where a subcommand writes: a new dataset never into one that it reads, and its report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from egovcp.data.writer import require_new
from egovcp.errors import UsageError


def new_folder(output_dir: str, sources: Sequence[Path]) -> Path:
    """The folder that ``--output_dir`` names.

    Raises:
        UsageError: none is given, it exists, or it lies inside one of ``sources``.
    """
    if not output_dir:
        raise UsageError("where does the new dataset go? give --output_dir=FOLDER")
    folder = Path(output_dir).expanduser().absolute()
    for source in sources:
        if folder.resolve().is_relative_to(source.resolve()):
            raise UsageError(f"--output_dir={output_dir} lies inside {source}; choose another")
    require_new(folder)
    return folder


def write_report(file: str, content: Any) -> None:
    """Write ``--json=file``, over an older report; nothing if ``file`` is empty.

    Raises:
        UsageError: the path is a folder, or lies below a file.
    """
    if not file:
        return
    path = Path(file).expanduser()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except (FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        raise UsageError(f"--json={file} cannot be a file: {error.strerror}") from error
