"""Writes whole episodes as a LeRobot v3.0 dataset, straight to parquet.

Everything goes to a temporary folder beside the destination, which appears under its
own name only when it is complete: an interrupted run leaves nothing half-made.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema, stats
from egovcp.data.episode import Episode
from egovcp.data.files import sync, sync_tree, write_json
from egovcp.data.hashes import write_hashes
from egovcp.data.parquet import EpisodesTable, RollingParquet, data_table
from egovcp.errors import UsageError


@dataclass(frozen=True)
class Provenance:
    """How a dataset came to be; stored in ``meta/collection.json``."""

    controller_id: str
    """Low-level controller that turned the actions into joint targets."""
    seed: int | None = None
    """Seed of the collection."""
    command: str = ""
    """Command line that repeats it."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Installed version of each package that shapes the data."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Complete configuration of the simulator and of the behaviour policy."""


def require_new(root: Path) -> None:
    """Raise `UsageError` if ``root`` exists; nothing is ever overwritten."""
    if root.exists() or root.is_symlink():
        raise UsageError(
            f"output folder {root} exists already; choose another --dataset.root or remove it"
        )


def _make_parent(root: Path) -> None:
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise UsageError(f"output folder {root} would lie below a file; choose another") from error


class DatasetWriter:
    """Adds episodes one by one; ``finalize`` makes the dataset appear at ``root``.

    As a context manager it finalizes on success and discards everything on an error.
    """

    def __init__(
        self, root: str | Path, provenance: Provenance, max_file_bytes: int = schema.FILE_MB * 10**6
    ) -> None:
        """Create the temporary folder.

        Raises:
            UsageError: ``root`` exists, or cannot exist.
        """
        self.root = Path(root).absolute()
        require_new(self.root)
        self.provenance = provenance
        self.num_episodes = 0
        self.num_frames = 0
        self._max_file_bytes = max_file_bytes
        self._tasks: dict[str, int] = {}
        self._metadata: list[dict[str, Any]] = []
        _make_parent(self.root)
        self._folder = self.root.with_name(f".{self.root.name}.{secrets.token_hex(4)}.partial")
        self._folder.mkdir()
        self._data = RollingParquet(self._folder, schema.DATA_PATH, dictionary=False)
        self._episodes = EpisodesTable(self._folder)

    def add(self, episode: Episode) -> None:
        """Append a complete episode.

        Raises:
            DataError: the episode is not valid (see `Episode.validate`).
        """
        episode.validate(f"episode {self.num_episodes}")
        columns = self._columns(episode)
        if self._data.bytes_written >= self._max_file_bytes:
            self._data.roll()
        self._data.write(data_table(episode.depth, columns))
        row = {
            "episode_index": self.num_episodes,
            "tasks": [episode.task],
            "length": len(episode),
            "data/chunk_index": self._data.chunk_index,
            "data/file_index": self._data.file_index,
            "dataset_from_index": self.num_frames,
            "dataset_to_index": self.num_frames + len(episode),
        }
        self._episodes.add(row, stats.episode_stats(episode.depth, columns))
        facts = {"task": episode.task, "length": len(episode), "time_limit": episode.time_limit}
        facts["sha256"] = episode.digest()
        self._metadata.append({**facts, "metadata": dict(episode.metadata)})
        self.num_episodes += 1
        self.num_frames += len(episode)

    def finalize(self) -> Path:
        """Complete the files, move the folder to ``root`` and return it.

        Raises:
            UsageError: no episode was added, or ``root`` has appeared meanwhile.
        """
        if self.num_episodes == 0:
            self.discard()
            raise UsageError(f"no episode was written to {self.root}; nothing to keep")
        self._data.close()
        totals = self._episodes.close()
        self._write_tasks()
        write_json(self._folder / schema.INFO_PATH, self._info())
        write_json(self._folder / schema.STATS_PATH, stats.to_json(totals, self.num_frames))
        write_json(self._folder / schema.COLLECTION_PATH, self._collection())
        write_hashes(self._folder)
        sync_tree(self._folder)
        require_new(self.root)
        self._folder.rename(self.root)
        sync(self.root.parent)
        return self.root

    def discard(self) -> None:
        """Remove everything written so far."""
        self._data.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.finalize()
        else:
            self.discard()

    def _columns(self, episode: Episode) -> dict[str, NDArray[np.generic]]:
        frames = np.arange(len(episode), dtype=np.int64)
        task_index = self._tasks.setdefault(episode.task, len(self._tasks))
        return {
            spec.STATE_KEY: episode.state,
            spec.ACTION_KEY: episode.action,
            spec.REWARD_KEY: episode.reward,
            spec.DONE_KEY: episode.done,
            spec.SUCCESS_KEY: episode.success,
            spec.TRUNCATED_KEY: episode.truncated,
            "timestamp": (frames / spec.PLANNER_HZ).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full_like(frames, self.num_episodes),
            "index": frames + self.num_frames,
            "task_index": np.full_like(frames, task_index),
        }

    def _write_tasks(self) -> None:
        import pandas as pd  # LeRobot reads the task names from a pandas index

        names = pd.Index(list(self._tasks), name="task")
        frame = pd.DataFrame({"task_index": list(self._tasks.values())}, index=names)
        frame.to_parquet(self._folder / schema.TASKS_PATH)

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": schema.CODEBASE_VERSION,
            "fps": spec.PLANNER_HZ,
            "features": schema.info_features(self.provenance.controller_id),
            "total_episodes": self.num_episodes,
            "total_frames": self.num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": schema.CHUNK_FILES,
            "data_files_size_in_mb": schema.FILE_MB,
            "video_files_size_in_mb": 200,
            "data_path": schema.DATA_PATH,
            "video_path": None,
            "robot_type": schema.ROBOT_TYPE,
            "splits": {"train": f"0:{self.num_episodes}"},
        }

    def _collection(self) -> dict[str, Any]:
        return {
            "collection_version": schema.COLLECTION_VERSION,
            "spec_version": spec.SPEC_VERSION,
            **asdict(self.provenance),
            "episodes": self._metadata,
        }
