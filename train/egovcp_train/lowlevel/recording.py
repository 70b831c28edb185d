"""Video and Rerun recording of the first robot of a skill."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.log.picture import PictureSink
from egovcp.log.rerun import RerunSink
from egovcp.log.tick import BasePose, RunInfo, Tick
from egovcp.robot_spec import G1
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_SLICE,
    CONTROLLER_TICKS_PER_PLAN,
    PLANNER_HZ,
    STATE_DIM,
    STATE_SLICES,
)
from egovcp_train.lowlevel.physics import Snapshot

SUFFIXES: Final = (".gif", ".rrd")


class SkillRecorder:
    """Collects every second tick of a robot, and writes ``NAME.gif`` and ``NAME.rrd``.

    There is no camera, so the depth images are empty.
    """

    def __init__(self, name: str, folder: Path) -> None:
        """Choose the files.

        Raises:
            UsageError: one of them exists.
        """
        self._name, self._stem = name, folder / name
        self._seen = 0
        self._ticks: list[Tick] = []
        for suffix in SUFFIXES:
            if (path := self._stem.with_suffix(suffix)).exists():
                raise UsageError(f"--videos: {path} exists; choose another --output_dir")

    def add(self, x: Snapshot, command: NDArray[np.float64]) -> None:
        """Add a tick of the controller: the state of all robots and their commands (N, 10)."""
        self._seen += 1
        if self._seen % CONTROLLER_TICKS_PER_PLAN != 1:
            return
        index = len(self._ticks)
        state = np.zeros(STATE_DIM)
        state[COMMAND_SLICE] = command[0]
        state[STATE_SLICES["joint_position"]] = x.joints[0]
        action = ACTION_BOX.to_normalised(command[0, 3:])
        self._ticks.append(
            Tick(
                index,
                index * 10**9 // PLANNER_HZ,
                np.zeros(G1.depth, np.uint16),
                state,
                action_planned=action,
                action_sent=action,
                base=BasePose(x.position[0].copy(), x.quaternion[0].copy()),
            )
        )

    def write(self) -> None:
        """Write the files."""
        for sink in (
            PictureSink(self._stem.with_suffix(".gif")),
            RerunSink(self._stem.with_suffix(".rrd")),
        ):
            sink.open(RunInfo(self._name))
            for tick in self._ticks:
                sink.write(tick)
            sink.close()
