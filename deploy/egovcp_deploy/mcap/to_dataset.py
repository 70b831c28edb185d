"""`egovcp-mcap to-dataset`: rollouts as episodes of a dataset, from the robot back to training."""

from __future__ import annotations

import hashlib
import os
import shlex
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from egovcp.cli import DatasetConfig
from egovcp.errors import DataError, UsageError
from egovcp.log.mcap_reader import ROW_TOPICS, RecordingReader
from egovcp.log.tick import RunInfo, Tick
from egovcp.packages import DATA_MODULES, require_packages
from egovcp.terminal import echo
from egovcp_deploy.pilot.states import State

if TYPE_CHECKING:
    from egovcp.data import Episode, Provenance


@dataclass(frozen=True)
class ToDatasetConfig:
    """Make a LeRobot dataset out of recorded rollouts, one episode each: row t is what was observed
    at tick t, the action as it was sent, the reward after it, and whether that was the end.

    The robots must have had the same low-level controller: what an action does depends on it.
    `egovcp-dataset merge` joins the dataset with others of that controller.
    """

    files: list[str] = field(default_factory=list)
    """The recordings, MCAP files."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Where the dataset goes; without a root, into LeRobot's local folder under its id."""
    gaps: Literal["refuse", "cut"] = "refuse"
    """What to do with a recording in which ticks are missing: rows of an episode are one period
    apart. refuse: nothing is written; cut: keep what comes before the first gap (not what comes
    after it, since an episode begins in the neutral pose)."""


CONFIG = ToDatasetConfig


def run(config: ToDatasetConfig) -> None:
    """Convert, and say what was kept.

    Raises:
        UsageError: no file is given, or the dataset exists.
        DataError: a file is no recording of ours, is damaged, has gaps, another controller, or
            repeats another file.
        EnvironmentFailure: what writes datasets is not installed.
    """
    if not config.files:
        raise UsageError("which recordings? egovcp-mcap to-dataset FILE... --dataset.root=ROOT")
    if config.dataset.revision:
        raise UsageError("--dataset.revision has no meaning for a new dataset; drop it")
    require_packages("egovcp-deploy", "writing a dataset", *DATA_MODULES)
    from egovcp.data import DatasetWriter
    from egovcp.data.destination import require_new, resolve_root
    from egovcp.data.source import local_root

    paths = [Path(os.path.expanduser(file)) for file in config.files]
    root = resolve_root(local_root(config.dataset))
    require_new(root)
    known = provenance(paths)
    require_different(paths, config.gaps)
    with DatasetWriter(root, known) as writer:
        for path in paths:
            episode, cut = read_episode(path, config.gaps)
            writer.add(episode)
            echo(f"{path}: {len(episode)} ticks{cut}")
    echo(f"{writer.root}: {writer.num_episodes} episodes, {writer.num_frames} frames")


def provenance(paths: Sequence[Path]) -> Provenance:
    """What the recordings have in common.

    Raises:
        DataError: they have different low-level controllers, or one does not say which.
    """
    from egovcp.data import Provenance
    from egovcp.rollouts import CONTROLLER

    infos = {path: RecordingReader(path).info for path in paths}
    ids = {path: info.hashes.get(CONTROLLER, "") for path, info in infos.items()}
    for path, controller in ids.items():
        if not controller:
            raise DataError(f"{path} does not say which low-level controller the robot had")
        if controller != ids[paths[0]]:
            raise DataError(
                f"{path} was recorded with the low-level controller {controller}, "
                f"{paths[0]} with {ids[paths[0]]}; make a dataset of each"
            )
    first = infos[paths[0]]
    command = shlex.join(["egovcp-mcap", "to-dataset", *(str(path.absolute()) for path in paths)])
    return Provenance(
        controller_id=ids[paths[0]],
        command=command,
        versions=dict(first.versions),
        config=_config(first),
    )


def _config(info: RunInfo) -> dict[str, object]:
    """The run's configuration, without what is of one episode alone."""
    own = ("pose", "dataset", "index in the dataset", "scenario", "time_limit", "command")
    return {name: value for name, value in info.config.items() if name not in own}


def require_different(paths: Sequence[Path], gaps: str = "refuse") -> None:
    """Check that each recording holds another run, before anything is written.

    A copy of a recording is recognised by its rows. The copy may end earlier: a torn or damaged
    recording that was recovered begins with the same rows.

    Raises:
        DataError: two recordings have the same rows, or one cannot be converted.
    """
    seen: dict[bytes, list[tuple[Path, list[bytes]]]] = {}
    for path in paths:
        rows = _row_digests(read_episode(path, gaps)[0])
        for other, other_rows in seen.setdefault(rows[0], []):
            shared = min(len(rows), len(other_rows))
            if rows[:shared] == other_rows[:shared]:
                raise DataError(
                    f"{path} repeats {other}: its first {shared} rows are the same; give each "
                    "rollout once, as its longest recording"
                )
        seen[rows[0]].append((path, rows))


def _row_digests(episode: Episode) -> list[bytes]:
    """A digest of each row: what was observed, sent and earned."""
    columns = (episode.depth, episode.state, episode.action, episode.reward)
    rows = (b"".join(column[t].tobytes() for column in columns) for t in range(len(episode)))
    return [hashlib.blake2b(row, digest_size=16).digest() for row in rows]


def read_episode(path: Path, gaps: str = "refuse") -> tuple[Episode, str]:
    """A recording as an episode, and words on what was left out.

    Raises:
        DataError: not a recording of ours, it is damaged, ticks are missing, or a value is out of
            its range.
    """
    from egovcp.rollouts import episode_of

    reader = RecordingReader(path)
    try:
        moments = reader.raw_ticks()
        ticks = _until_over(_driven(raw.tick(ROW_TOPICS) for raw in moments))
        deque(moments, maxlen=0)  # read on to the end: damage may follow the episode
        reader.require_undamaged()
        whole, why = _before_gap(ticks)
        if why and gaps == "refuse":
            raise DataError(
                f"{why}; rows of an episode are one period apart. --gaps=cut keeps what comes "
                "before the first gap"
            )
        episode = episode_of(reader.info, whole)
        episode.validate()
    except DataError as error:
        place = "" if str(error).startswith(str(path)) else f"{path}: "
        raise DataError(f"{place}{error}") from error
    cut = f", cut: {why}" if why else ""
    return episode, cut if reader.complete else f"{cut}; the file is torn there"


def _driven(ticks: Iterator[Tick]) -> Iterator[Tick]:
    """The ticks from the planner's first to its last; before, a robot on the wall clock stands
    up, and after it is damped. A recording that knows no states is taken as it is."""
    begun = False
    for tick in ticks:
        if tick.mode in ("", State.RUN):
            begun = True
        elif begun and tick.mode != State.HOLD:
            return
        if begun:
            yield tick


def _until_over(ticks: Iterator[Tick]) -> list[Tick]:
    """The ticks up to the one that ends the episode; the robot may have been recorded longer."""
    kept = []
    for tick in ticks:
        kept.append(tick)
        if tick.terminated or tick.truncated:
            break
    return kept


def _is_first(tick: Tick) -> bool:
    """Whether the planner took over at ``tick``."""
    return tick.index == 0 or any(f"-> {State.RUN}" in event for event in tick.events)


def _before_gap(ticks: Sequence[Tick]) -> tuple[list[Tick], str]:
    """The ticks before the first gap, and where that is; empty if there is none."""
    from egovcp.rollouts import follows

    if ticks and not _is_first(ticks[0]):
        return [], "its first ticks are missing"
    for i in range(1, len(ticks)):
        before, tick = ticks[i - 1], ticks[i]
        if not follows(before, tick):
            count = tick.index - before.index - 1
            words = f"{count} ticks are missing" if count else "the robot paused"
            return list(ticks[:i]), f"{words} after tick {before.index}"
    return list(ticks), ""
