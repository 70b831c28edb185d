"""Where a subcommand writes: a new dataset never into one that it reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egovcp.data.destination import require_new, resolve_root
from egovcp.errors import UsageError


def new_folder(output_dir: str, sources: Sequence[Path]) -> Path:
    """The folder that ``--output_dir`` names.

    Raises:
        UsageError: none is given, it exists and is not empty, or it lies inside one of ``sources``.
        EnvironmentFailure: it is a mount point.
    """
    if not output_dir:
        raise UsageError("where does the new dataset go? give --output_dir=FOLDER")
    folder = resolve_root(output_dir)
    for source in sources:
        if folder.is_relative_to(source.resolve()):
            raise UsageError(f"--output_dir={output_dir} lies inside {source}; choose another")
    require_new(folder)
    return folder
