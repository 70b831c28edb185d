"""A robot that has already lived: plays a recorded run back through a policy.

Observations are the recorded ones, and what was sent is what was sent then, whatever the policy
plans now. So its recurrence takes the same steps as when the run was recorded, bit for bit, and
one can look into it again, or let another model watch the same run.
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
from egovcp_deploy.robots.base import Outcome, Sensed

if TYPE_CHECKING:
    from egovcp.data import DatasetReader

ENDS: Final = "recording ends"


@dataclass(frozen=True)
class Recorded:
    """One run, row t = (o_t, what followed from a_t)."""

    name: str
    """Where it comes from."""
    controller_id: str
    """Low-level controller that the robot ran."""
    camera: CameraView
    sensed: Sequence[Sensed]
    outcomes: Sequence[Outcome]

    def __post_init__(self) -> None:
        if not self.sensed:
            raise DataError(f"{self.name} holds no ticks; there is nothing to play back")

    def __len__(self) -> int:
        return len(self.sensed)


class ReplayRobot:
    """`Robot` whose rollout i is the i-th recording.

    Args:
        count: how many recordings there are.
        load: reads the i-th.

    Raises:
        UsageError: there are none.
        DataError: the first is damaged.
    """

    def __init__(self, count: int, load: Callable[[int], Recorded]) -> None:
        if count < 1:
            raise UsageError("no recordings to play back")
        self.count = count
        self._load = load
        self._number = -1
        self.start(0)

    @property
    def controller_id(self) -> str:
        """Of the robot that was recorded."""
        return self._run.controller_id

    @property
    def camera(self) -> CameraView:
        """As it was mounted; of an episode of a dataset as far as that is known."""
        return self._run.camera

    def start(self, episode: int) -> None:
        """Go to the beginning of recording ``episode``.

        Raises:
            UsageError: there are not so many.
            DataError: it is damaged.
        """
        if not 0 <= episode < self.count:
            raise UsageError(
                f"rollout {episode} was asked for, but there are {self.count} recordings"
            )
        if episode != self._number:
            self._run, self._number = self._load(episode), episode
        self._tick = 0

    def observe(self) -> Sensed:
        """What the robot sensed then."""
        return self._run.sensed[self._tick]

    def act(self, action: NDArray[np.float64]) -> Outcome:
        """What was sent then, instead of ``action``, and what followed; the time moves on."""
        outcome = self._run.outcomes[self._tick]
        if self._tick + 1 < len(self._run):
            self._tick += 1
        elif not outcome.terminated:
            cut = () if outcome.truncated else (ENDS,)
            return replace(outcome, truncated=True, events=(*outcome.events, *cut))
        return outcome

    def damp(self) -> None:
        """The past cannot be changed."""

    def close(self) -> None:
        """Nothing is held."""


def open_recordings(path: Path) -> ReplayRobot:
    """A recording, a folder of them as egovcp-deploy leaves it, or a LeRobot dataset on disk.

    Raises:
        UsageError: nothing of that kind is there.
        DataError: it is damaged.
        EnvironmentFailure: datasets cannot be read here.
    """
    if path.is_file():
        return ReplayRobot(1, lambda _: recorded_run(path))
    if (path / "meta" / "info.json").is_file():
        reader = _reader(path)
        return ReplayRobot(len(reader), lambda i: recorded_episode(reader, i))
    found = sorted(path.glob("*.mcap"), key=_number)
    if not found:
        raise UsageError(
            f"{path} is no recording, folder of recordings (*.mcap) or LeRobot dataset "
            "(meta/info.json)"
        )
    return ReplayRobot(len(found), lambda i: recorded_run(found[i]))


def _number(path: Path) -> tuple[int, str]:
    """rollout-10 comes after rollout-9."""
    digits = "".join(c for c in path.stem if c.isdigit())
    return int(digits or 0), path.name


def recorded_run(path: Path) -> Recorded:
    """The run in an MCAP file of ours, also if its end is missing.

    One on the wall clock begins where the planner took over: its recurrence started there.

    Raises:
        DataError: it is none, is damaged, or holds no ticks.
    """
    recording = read_recording(path, damaged_ok=False)
    ticks = recording.ticks[_take_over(recording.ticks) :]
    return Recorded(
        name=str(path),
        controller_id=recording.info.hashes.get("low_level_controller", ""),
        camera=recording.info.camera,
        sensed=[
            Sensed(tick.depth, np.asarray(tick.state, np.float32), tick.base, tick.scene)
            for tick in ticks
        ],
        outcomes=[_outcome(tick) for tick in ticks],
    )


def _take_over(ticks: Sequence[Tick]) -> int:
    """The tick at which the robot was handed to the planner; 0 if nothing tells of it."""
    return next((i for i, tick in enumerate(ticks) if tick.mode == State.RUN), 0)


def _outcome(tick: Tick) -> Outcome:
    return Outcome(
        sent=np.asarray(tick.action_sent, np.float64),
        reward=tick.reward,
        reward_terms=tick.reward_terms,
        terminated=tick.terminated,
        truncated=tick.truncated,
        success=tick.success,
        events=tick.events,
    )


def _reader(root: Path) -> DatasetReader:
    require_packages("egovcp-deploy", "reading a dataset", *DATA_MODULES)
    from egovcp.data import DatasetConfig, DatasetReader

    return DatasetReader.open(DatasetConfig(root=str(root)))


def recorded_episode(reader: DatasetReader, index: int) -> Recorded:
    """One episode of a dataset.

    Raises:
        DataError: it is damaged.
    """
    episode = reader.read(index)
    mount = CameraConfig()
    pitch = float(reader.metadata(index).get("camera_pitch", CameraView.pitch))
    return Recorded(
        name=f"{reader.root}, episode {index}",
        controller_id=reader.controller_id,
        camera=CameraView("torso_link", mount.position, pitch, mount.vertical_fov),
        sensed=[Sensed(d, s.copy()) for d, s in zip(episode.depth, episode.state, strict=True)],
        outcomes=[
            Outcome(
                sent=episode.action[t].astype(np.float64),
                reward=float(episode.reward[t]),
                terminated=bool(episode.done[t] and not episode.truncated[t]),
                truncated=bool(episode.truncated[t]),
                success=bool(episode.success[t]),
            )
            for t in range(len(episode))
        ],
    )
