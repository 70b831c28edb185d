"""`egovcp-dataset check`: is every file and every frame of a dataset as it should be?"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from tqdm import tqdm

from egovcp.bounds import bounded
from egovcp.checks.dataset import dataset_problems
from egovcp.data import DatasetConfig, metadata
from egovcp.data.paths import hidden_files
from egovcp.data.source import local_root, locate
from egovcp.errors import DataError
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo, one_line


@dataclass(frozen=True)
class CheckConfig:
    """Read every file and every frame of a dataset, and name the file, episode and frame of
    whatever is wrong. Ends with exit code 3 if anything is."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, for which the network is never asked, or an id of the Hub."""
    max_problems: int = bounded(20, least=1)
    """Stop after this many problems."""
    json: str = output_file()
    """File for the result: {"ok", "episodes", "frames", "problems": [{"file", "episode", "frame",
    "problem"}]}; empty: none."""


CONFIG = CheckConfig


def run(config: CheckConfig) -> None:
    """Print every problem, and a summary.

    Raises:
        DataError: something is wrong.
    """
    root = local_root(config.dataset)
    if not (config.dataset.root and root.is_dir()):  # of a damaged one every problem is listed
        root = locate(config.dataset).root
    with _progress() as progress:
        found = list(islice(dataset_problems(root, progress), config.max_problems))
    episodes, frames = _size(root)
    problems = [as_json(error, root) for error in found]
    content = {"ok": not found, "episodes": episodes, "frames": frames, "problems": problems}
    write_report(config.json, content)
    for error in found:
        echo(one_line(error))
    if hidden := hidden_files(root / "data") + hidden_files(root / "meta"):
        echo(
            f"ignored {hidden} hidden files and folders such as ._NAME of macOS, which LeRobot "
            f"would read; remove them: find {_quoted(root / 'data')} {_quoted(root / 'meta')} "
            "-name '.*' -prune -exec rm -r {} +"
        )
    if found:
        raise DataError(_verdict(found, root, config.max_problems))
    echo(f"{root}: {episodes} episodes, {frames} frames, nothing wrong")


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _verdict(found: list[DataError], root: Path, limit: int) -> str:
    number = f"{len(found)} or more" if len(found) == limit else f"{len(found)}"
    return (
        f"{number} problem(s) in {root}, the first: {found[0]}; `egovcp-dataset repair {root} "
        "--output_dir=NEW` keeps the episodes that are sound"
    )


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    with tqdm(unit="ep", delay=1) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def _size(root: Path) -> tuple[int, int]:
    """Episodes and frames, as far as they are known."""
    try:
        info = metadata.load_info(root)
    except DataError:
        return 0, 0
    counts = (info.get(key) for key in ("total_episodes", "total_frames"))
    episodes, frames = (count if isinstance(count, int) else 0 for count in counts)
    return episodes, frames


def as_json(error: DataError, root: Path) -> dict[str, Any]:
    """A problem as the reports of `check` and `repair` have it."""
    file = Path(error.file)
    inside = bool(error.file) and file.is_relative_to(root)
    return {
        "file": file.relative_to(root).as_posix() if inside else error.file,
        "episode": error.episode,
        "frame": error.frame,
        "problem": error.problem or str(error),
    }
