"""`egovcp-mcap to-dataset`: convert recorded rollouts to episodes of a dataset."""

from __future__ import annotations

import hashlib
import logging
import shlex
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from egovcp.dataset_options import DatasetConfig
from egovcp.errors import DataError, UsageError
from egovcp.files import user_path
from egovcp.log.mcap_reader import ROW_TOPICS, RecordingReader
from egovcp.log.tick import CONTROLLER, Tick
from egovcp.packages import DATA_MODULES, require_packages
from egovcp.terminal import echo, echo_lines
from egovcp_deploy.pilot.states import State

if TYPE_CHECKING:
    from egovcp.data import Episode, Provenance
    from egovcp_deploy.mcap.topics import Array, TopicMapping

#: Task of the episode of a recording that names none, as of a real robot.
UNKNOWN_TASK: Final = "unknown"
_IMAGE_NAMES = ["height", "width", "channels"]
_PER_EPISODE = ("pose", "dataset", "index in the dataset", "scenario", "time_limit", "command")


@dataclass(frozen=True)
class ToDatasetConfig:
    """Convert recorded rollouts to a LeRobot dataset, one episode each: row t is the observation
    of tick t, the action that was sent, the reward after it, and whether the episode ended.

    All robots must have had the same low-level controller, which determines the effect of actions.
    `egovcp-dataset merge` joins the dataset with others of that controller.
    """

    files: list[str] = field(default_factory=list)
    """The recordings, MCAP files."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The new dataset; without a root, it is written to LeRobot's local folder under its id."""
    mapping: str = ""
    """For recordings of other programs: a YAML or JSON file that maps their topics to features of
    a dataset, see docs/logs.md."""
    gaps: Literal["refuse", "cut"] = "refuse"
    """How to treat a recording with missing ticks, since rows of an episode are one period apart.
    refuse: fail; cut: keep the ticks before the first gap (not those after it, since an episode
    begins in the neutral pose)."""


def run(config: ToDatasetConfig, argv: Sequence[str]) -> None:
    """Convert the recordings and print what was kept. Raises `UsageError` without files or for an
    existing dataset, `DataError` for a file that is damaged, has gaps or another controller, or
    repeats another, and `EnvironmentFailure` if a package is missing."""
    if not config.files:
        raise UsageError(
            "no recordings given; usage: egovcp-mcap to-dataset FILE... --dataset.root=ROOT"
        )
    if config.dataset.revision:
        raise UsageError("--dataset.revision does not apply to a new dataset; omit it")
    require_packages("egovcp-deploy", "writing a dataset", *DATA_MODULES)
    from egovcp.data import DatasetWriter
    from egovcp.data.destination import require_new, resolve_root
    from egovcp.data.source import local_root

    paths = [user_path(file) for file in config.files]
    root = resolve_root(local_root(config.dataset))
    require_new(root)
    if config.mapping:
        _convert_topics(config, paths, root)
        return
    seen: list[tuple[Path, list[bytes]]] = []
    converted = []
    with DatasetWriter(root, shared_provenance(paths, shlex.join(argv))) as writer:
        for path in paths:
            episode, cut = read_episode(path, config.gaps)
            require_different(path, episode, seen)
            writer.add(episode)
            converted.append(f"{path}: {len(episode)} ticks{cut}")
    echo_lines(converted)
    echo(f"{writer.root}: {writer.num_episodes} episodes, {writer.num_frames} frames")


def _convert_topics(config: ToDatasetConfig, paths: Sequence[Path], root: Path) -> None:
    """Convert recordings of other programs; raises as `run`."""
    require_packages("egovcp-deploy", "--mapping", *DATA_MODULES, "lerobot")
    logging.getLogger("lerobot").setLevel(logging.ERROR)  # a page where torchcodec lacks FFmpeg
    from lerobot.datasets import LeRobotDataset

    from egovcp.data.writer import new_dataset
    from egovcp_deploy.mcap.topics import TopicMapping, TopicRecording

    mapping = TopicMapping.read(user_path(config.mapping))
    recordings = [(r, *r.gap()) for r in (TopicRecording(path, mapping) for path in paths)]
    for recording, kept, gap in recordings:
        if gap and (config.gaps == "refuse" or kept == 0):
            raise DataError(
                f"{recording.path}: {gap}; --gaps=cut keeps the rows before, and a topic under "
                "hold may pause"
            )
    with new_dataset(root) as folder:
        dataset: Any = None
        shapes: dict[str, tuple[int, ...]] = {}
        for recording, kept, _ in recordings:
            for row in islice(recording.rows(shapes), kept):
                if dataset is None:  # an empty one is false
                    features = _features(row, mapping)
                    name, videos = config.dataset.repo_id or root.name, mapping.video
                    dataset = LeRobotDataset.create(
                        name, mapping.fps, features, folder, use_videos=videos
                    )
                dataset.add_frame({**row, "task": mapping.task})
            dataset.save_episode()
        dataset.finalize()
    echo_lines(
        f"{recording.path}: {kept} rows{f', cut: {gap}' if gap else ''}"
        for recording, kept, gap in recordings
    )
    echo(f"{root}: {dataset.num_episodes} episodes, {dataset.num_frames} frames")


def _features(row: Mapping[str, Array], mapping: TopicMapping) -> dict[str, Any]:
    """LeRobot's description of the features of a row."""
    image = {"dtype": "video" if mapping.video else "image", "names": _IMAGE_NAMES}
    found: dict[str, Any] = {}
    for key, value in row.items():
        names = mapping.names.get(key)
        if names and (value.ndim == 3 or len(names) != len(value)):
            actual = "is an image" if value.ndim == 3 else f"has {len(value)} values"
            given = f"--mapping: names.{key} has {len(names)} names"
            raise UsageError(f"{given}, but the feature {actual}")
        if value.ndim == 3:
            found[key] = {"shape": value.shape, **image}
            if value.dtype == "uint16":
                found[key]["info"] = {"is_depth_map": True}
        else:
            found[key] = {"dtype": str(value.dtype), "shape": value.shape, "names": names}
    return found


def shared_provenance(paths: Sequence[Path], command: str) -> Provenance:
    """What the recordings have in common; configuration and versions are the first's. Raises
    `DataError` if the low-level controllers differ, or one is not recorded."""
    from egovcp.data import Provenance

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
    return Provenance(
        controller_id=ids[paths[0]],
        command=command,
        versions=dict(first.versions),
        config={name: value for name, value in first.config.items() if name not in _PER_EPISODE},
        origin="recorded",
    )


def require_different(path: Path, episode: Episode, seen: list[tuple[Path, list[bytes]]]) -> None:
    """Add the digests of the rows to ``seen``; raise `DataError` if another recording there begins
    with the same rows. A copy may end earlier, as a truncated recording that was recovered."""
    columns = (episode.depth, episode.state, episode.action, episode.reward)
    content = (b"".join(c[t].tobytes() for c in columns) for t in range(len(episode)))
    rows = [hashlib.blake2b(row, digest_size=16).digest() for row in content]
    for other, other_rows in seen:
        shared = min(len(rows), len(other_rows))
        if rows[:shared] == other_rows[:shared]:
            raise DataError(
                f"{path} repeats {other}: its first {shared} rows are the same; give each "
                "rollout once, as its longest recording"
            )
    seen.append((path, rows))


def read_episode(path: Path, gaps: str) -> tuple[Episode, str]:
    """Convert a recording to an episode; the text says what was left out. Raises `DataError` if it
    is not ours, damaged, or has missing ticks or invalid values."""
    from egovcp.rollouts import episode_of

    reader = RecordingReader(path)
    try:
        raw_ticks = reader.raw_ticks()
        ticks = list(_episode_ticks(raw.tick(ROW_TOPICS) for raw in raw_ticks))
        deque(raw_ticks, maxlen=0)  # read on to the end: damage may follow the episode
        reader.require_undamaged()
        kept, gap = _before_gap(ticks, reader.info.fps)
        if gap and (gaps == "refuse" or not kept):
            rest = "--gaps=cut keeps what comes before the first gap" if kept else "Nothing is left"
            raise DataError(f"{gap}; rows of an episode are one period apart. {rest}")
        info = replace(reader.info, task=reader.info.task or UNKNOWN_TASK)
        episode = episode_of(info, kept)
        episode.validate()
    except DataError as error:
        place = "" if str(error).startswith(str(path)) else f"{path}: "
        raise DataError(f"{place}{error}") from error
    cut = f", cut: {gap}" if gap else ""
    return episode, cut if reader.complete else f"{cut}; the file is truncated there"


def _episode_ticks(ticks: Iterator[Tick]) -> Iterator[Tick]:
    """The ticks from the first to the last in RUN, without those in which a robot on the wall clock
    stands up or is damped; all ticks of a recording without states. None follows the one that ends
    the episode."""
    begun = False
    for tick in ticks:
        if tick.mode in ("", State.RUN):
            begun = True
        elif begun and tick.mode != State.HOLD:
            return
        if begun:
            yield tick
            if tick.terminated or tick.truncated:
                return


def _before_gap(ticks: Sequence[Tick], fps: int) -> tuple[list[Tick], str]:
    """The ticks before the first gap, and where that is; empty if there is none."""
    from egovcp.rollouts import follows

    if ticks:
        first = ticks[0]
        entered_run = any(f"-> {State.RUN}" in event for event in first.events)
        if first.index > 0 and not entered_run:
            return [], "its first ticks are missing"
    for i, (before, tick) in enumerate(pairwise(ticks), start=1):
        if not follows(before, tick, fps):
            count = tick.index - before.index - 1
            what = f"{count} ticks are missing" if count else "the robot paused"
            return list(ticks[:i]), f"{what} after tick {before.index}"
    return list(ticks), ""
