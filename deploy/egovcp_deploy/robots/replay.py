"""Plays a recorded run back through a policy.

Observations and sent actions are the recorded ones, whatever the policy plans. So its recurrence
repeats the recorded run's bit for bit, and the run can be inspected again or shown to another
model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import DataError, UsageError
from egovcp.log.mcap_reader import read_recording
from egovcp.log.tick import CameraView, Tick
from egovcp.packages import DATA_MODULES, require_packages
from egovcp.sim.config import CameraConfig
from egovcp_deploy.pilot.states import State
from egovcp_deploy.robots.base import ActionResult, RobotObservation

if TYPE_CHECKING:
    from egovcp.data import DatasetReader

RECORDING_ENDS: Final = "recording ends"


@dataclass(frozen=True)
class RecordedRun:
    """One run; row t is o_t and the result of a_t."""

    source: str
    """File, or dataset and episode."""
    controller_id: str
    """Low-level controller of the robot."""
    camera: CameraView
    observations: Sequence[RobotObservation]
    results: Sequence[ActionResult]

    def __post_init__(self) -> None:
        if not self.observations:
            raise DataError(f"{self.source} has no ticks; there is nothing to play back")

    def __len__(self) -> int:
        return len(self.observations)


class ReplayRobot:
    """`LockstepRobot` whose rollout i is the i-th recording.

    Args:
        count: number of recordings.
        load: reads the i-th.

    Raises:
        UsageError: there are none.
        DataError: the first is damaged.
    """

    def __init__(self, count: int, load: Callable[[int], RecordedRun]) -> None:
        if count < 1:
            raise UsageError("no recordings to play back")
        self.count = count
        self._load = load
        self._number = -1
        self.start(0)

    @property
    def controller_id(self) -> str:
        """Low-level controller of the recorded robot."""
        return self._run.controller_id

    @property
    def camera(self) -> CameraView:
        """The recorded mount; for an episode of a dataset, defaults replace what is not stored."""
        return self._run.camera

    def start(self, episode: int) -> None:
        """Go to the beginning of recording ``episode``.

        Raises:
            UsageError: there is no such recording.
            DataError: it is damaged.
        """
        if not 0 <= episode < self.count:
            raise UsageError(f"no recording {episode}; there are {self.count} recordings")
        if episode != self._number:
            self._run, self._number = self._load(episode), episode
        self._tick = 0

    def observe(self) -> RobotObservation:
        """Return the recorded observation."""
        return self._run.observations[self._tick]

    def act(self, action: NDArray[np.float64]) -> ActionResult:
        """Return the recorded result, ignoring ``action``, and advance one tick."""
        result = self._run.results[self._tick]
        if self._tick + 1 < len(self._run):
            self._tick += 1
        elif not result.terminated:
            end = () if result.truncated else (RECORDING_ENDS,)
            return replace(result, truncated=True, events=(*result.events, *end))
        return result

    def damp(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


def open_recordings(path: Path) -> ReplayRobot:
    """Open a recording, a folder of them as egovcp-deploy writes it, or a LeRobot dataset.

    Raises:
        UsageError: the path is none of these.
        DataError: it is damaged.
        EnvironmentFailure: the packages that read datasets are not installed.
    """
    if path.is_file():
        return ReplayRobot(1, lambda _: recorded_run(path))
    if (path / "meta" / "info.json").is_file():
        require_packages("egovcp-deploy", "reading a dataset", *DATA_MODULES)
        from egovcp.data import DatasetConfig, DatasetReader

        reader = DatasetReader.open(DatasetConfig(root=str(path)))
        return ReplayRobot(len(reader), lambda i: recorded_episode(reader, i))
    found = sorted(path.glob("*.mcap"), key=_number)
    if not found:
        raise UsageError(
            f"{path} is no recording, folder of recordings (*.mcap) or LeRobot dataset "
            "(meta/info.json)"
        )
    return ReplayRobot(len(found), lambda i: recorded_run(found[i]))


def _number(path: Path) -> tuple[int, str]:
    """Sort key that puts rollout-10 after rollout-9."""
    digits = "".join(c for c in path.stem if c.isdigit())
    return int(digits or 0), path.name


def recorded_run(path: Path) -> RecordedRun:
    """Read the run of an MCAP file, which may be torn.

    A run on the wall clock begins at the first tick in RUN, where the policy's recurrence started.

    Raises:
        DataError: not a recording of ours, damaged, or without ticks.
    """
    recording = read_recording(path, damaged_ok=False)
    first = next((i for i, tick in enumerate(recording.ticks) if tick.mode == State.RUN), 0)
    ticks = recording.ticks[first:]
    return RecordedRun(
        source=str(path),
        controller_id=recording.info.hashes.get("low_level_controller", ""),
        camera=recording.info.camera,
        observations=[
            RobotObservation(tick.depth, np.asarray(tick.state, np.float32), tick.base, tick.scene)
            for tick in ticks
        ],
        results=[_result(tick) for tick in ticks],
    )


def _result(tick: Tick) -> ActionResult:
    return ActionResult(
        sent=np.asarray(tick.action_sent, np.float64),
        reward=tick.reward,
        reward_terms=tick.reward_terms,
        terminated=tick.terminated,
        truncated=tick.truncated,
        success=tick.success,
        events=tick.events,
    )


def recorded_episode(reader: DatasetReader, index: int) -> RecordedRun:
    """Read one episode of a dataset.

    Raises:
        DataError: it is damaged.
    """
    episode = reader.read(index)
    mount = CameraConfig()
    pitch = float(reader.metadata(index).get("camera_pitch", CameraView.pitch))
    return RecordedRun(
        source=f"{reader.root}, episode {index}",
        controller_id=reader.controller_id,
        camera=CameraView("torso_link", mount.position, pitch, mount.vertical_fov),
        observations=[
            RobotObservation(depth, state.copy())
            for depth, state in zip(episode.depth, episode.state, strict=True)
        ],
        results=[
            ActionResult(
                sent=episode.action[t].astype(np.float64),
                reward=float(episode.reward[t]),
                terminated=bool(episode.done[t] and not episode.truncated[t]),
                truncated=bool(episode.truncated[t]),
                success=bool(episode.success[t]),
            )
            for t in range(len(episode))
        ],
    )
