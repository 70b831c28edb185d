"""`egovcp-dataset check`: find every problem in the files and frames of a dataset."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from egovcp.bounds import bounded
from egovcp.checks.dataset import dataset_problems
from egovcp.data import DatasetConfig, metadata
from egovcp.data.destination import require_outside
from egovcp.data.source import local_root, locate
from egovcp.errors import DataError
from egovcp.outputs import output_file, write_report
from egovcp.terminal import echo, one_line
from egovcp_collect.progress import progress_bar


@dataclass(frozen=True)
class CheckConfig:
    """Read every file and every frame of a LeRobot v3 dataset, and list problems with file, episode
    and frame (the first 20; --max_problems). Exits with code 3 if there is one.

    Datasets that egovcp collected are also checked against their hashes and recorded digests, for
    repeated episodes, and for actions that agree with the commands. Of others, whatever their
    features, it prints in one line each what it cannot check."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset: a folder, which is checked without network access, or an id of the Hub."""
    max_problems: int = bounded(20, least=1)
    """List at most this many problems, then stop."""
    json: str = output_file()
    """File for the result: {"ok", "episodes", "frames", "problems": [{"file", "episode", "frame",
    "problem"}], "not_checked": [...], null if it stopped after max_problems}; empty: none."""


def run_check(config: CheckConfig) -> None:
    """Print the problems, and a summary.

    Raises:
        DataError: there is a problem, or no dataset.
        UsageError: bad or missing id, or a revision given with a folder.
        EnvironmentFailure: the Hub cannot be reached.
    """
    root = local_root(config.dataset)
    if not (config.dataset.root and root.is_dir()):  # `locate` would stop at the first problem
        root = locate(config.dataset).root
    require_outside(root, config.json)
    with progress_bar() as progress:
        notes: list[str] = []
        found = list(islice(dataset_problems(root, progress, notes), config.max_problems + 1))
    problems = found[: config.max_problems]
    stopped = len(found) > len(problems)
    episodes, frames = _size(root)
    result = {
        "ok": not problems,
        "episodes": episodes,
        "frames": frames,
        "problems": [problem_as_json(p, root) for p in problems],
        "not_checked": None if stopped else notes,
    }
    write_report(config.json, result)
    for problem in problems:
        echo(one_line(problem))
    if stopped:
        echo(f"stopped after {len(problems)} problems; the rest was not checked")
    for note in notes:
        echo(one_line(f"not checked: {note}"))
    if hidden := sum(len(list((root / name).rglob(".*"))) for name in ("data", "meta")):
        folders = shlex.join([str(root / "data"), str(root / "meta")])
        echo(
            f"ignored {hidden} hidden files and folders such as ._NAME of macOS, which LeRobot "
            f"would read; remove them: find {folders} -name '.*' -prune -exec rm -r {{}} +"
        )
    if problems:
        more = "more than " if stopped else ""
        raise DataError(
            f"{more}{len(problems)} problem(s) in {root}, the first: {problems[0]}; "
            f"`egovcp-dataset repair {shlex.quote(str(root))} --output_dir=NEW` keeps the valid "
            "episodes"
        )
    echo(f"{root}: {episodes} episodes, {frames} frames, nothing wrong")


def _size(root: Path) -> tuple[int, int]:
    """Episodes and frames according to ``info.json``; 0 where they are unknown."""
    try:
        info = metadata.load_v3_info(root)
    except DataError:
        return 0, 0
    counts = (info.get(key) for key in ("total_episodes", "total_frames"))
    episodes, frames = (count if isinstance(count, int) else 0 for count in counts)
    return episodes, frames


def problem_as_json(error: DataError, root: Path) -> dict[str, Any]:
    """A problem as in the reports of `check` and `repair`; the file is relative to ``root``."""
    file = Path(error.file)
    inside = bool(error.file) and file.is_relative_to(root)
    return {
        "file": file.relative_to(root).as_posix() if inside else error.file,
        "episode": error.episode,
        "frame": error.frame,
        "problem": error.problem or str(error),
    }
