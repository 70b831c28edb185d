"""Plays a recorded run back through a policy.

Observations and sent actions are the recorded ones, whatever the policy plans. So its recurrence
repeats the recorded run's bit for bit, if no tick was dropped and the planner lost no observation,
and the run can be inspected again or shown to another model.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import DataError, UsageError
from egovcp.log.async_sink import warn_on_stderr
from egovcp.log.mcap_reader import ROW_TOPICS, read_recording
from egovcp.log.messages import Topic
from egovcp.log.tick import CONTROLLER
from egovcp_deploy.pilot.states import State
from egovcp_deploy.robots.base import ActionResult, RobotObservation

RECORDING_ENDS: Final = "recording ends"
#: Topics that are played back; plans and predictions take much more memory.
_TOPICS: Final = ROW_TOPICS | {Topic.BASE, Topic.SCENE}


class ReplayRobot:
    """Replays recording i of ``files`` as rollout i, in lockstep; a missing end is allowed. A live
    recording starts at its first RUN tick, where the policy's recurrence started.

    Raises:
        DataError: the first file is damaged or has no ticks.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = files
        self._number = -1
        self.controller_id = ""
        self.start(0)

    def start(self, episode: int) -> None:
        """Go to the beginning of recording ``episode``; warns of missing ticks. Raises `DataError`
        if it is damaged or of another low-level controller."""
        if episode != self._number:
            path = self.files[episode]
            recording = read_recording(path, damaged_ok=False, topics=_TOPICS)
            if not recording.ticks:
                raise DataError(f"{path} has no ticks; there is nothing to play back")
            info = recording.info
            found = info.hashes.get(CONTROLLER, "")
            if self._number >= 0 and found != self.controller_id:
                raise DataError(
                    f"{path} was recorded with the low-level controller {found!r}, expected "
                    f"{self.controller_id!r} as in the recordings before it; replay it separately"
                )
            first = next((i for i, t in enumerate(recording.ticks) if t.mode == State.RUN), 0)
            ticks = recording.ticks[first:]
            if missing := ticks[-1].index - ticks[0].index + 1 - len(ticks):
                warn_on_stderr(
                    f"warning: {path}: {missing} ticks are missing, and the policy's recurrence "
                    "differs from the recorded one after them; egovcp-mcap info lists the gaps"
                )
            self.info, self.spec, self.camera = info, info.robot, info.camera
            self.controller_id = found
            self._ticks, self._number = ticks, episode
        self._tick = 0

    def observe(self) -> RobotObservation:
        """Return the recorded observation."""
        tick = self._ticks[self._tick]
        state = np.asarray(tick.state, np.float32)
        return RobotObservation(tick.depth, state, tick.base, tick.scene)

    def act(self, action: NDArray[np.float64]) -> ActionResult:
        """Return the recorded result, ignoring ``action``, and advance one tick. The recorded log
        lines are marked: they are not those of this rollout."""
        tick = self._ticks[self._tick]
        truncated, events = tick.truncated, [f"recorded: {line}" for line in tick.events]
        if self._tick + 1 < len(self._ticks):
            self._tick += 1
        elif not (tick.terminated or truncated):
            truncated = True
            events.append(RECORDING_ENDS)
        return ActionResult(
            sent=np.asarray(tick.action_sent, np.float64),
            reward=tick.reward,
            reward_terms=tick.reward_terms,
            terminated=tick.terminated,
            truncated=truncated,
            success=tick.success,
            events=tuple(events),
        )

    def damp(self) -> None:
        """Do nothing."""


def open_recordings(path: Path) -> ReplayRobot:
    """Open a recording, or a folder of them as egovcp-deploy writes it. Raises `UsageError` if the
    path is neither, `DataError` if the recording is damaged."""
    if path.is_file():
        return ReplayRobot([path])
    if (path / "meta" / "info.json").is_file():
        raise UsageError(
            f"{path} is a dataset; make a recording of an episode first: egovcp-dataset viz "
            f"{path} --output=OUT.mcap --episode=N"
        )
    found = sorted(path.glob("*.mcap"), key=_number)
    if not found:
        raise UsageError(f"{path} is no recording, or folder of recordings (*.mcap)")
    return ReplayRobot(found)


def _number(path: Path) -> tuple[list[str | int], str]:
    """Sort key that puts rollout-10 after rollout-9, and both of run1 before those of run2."""
    parts = re.split(r"(\d+)", path.stem)  # every second one is a number
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name
