"""The records of a log, a planner tick and the description of its run; and what writes them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import bounded, check_bounds
from egovcp.decode import decode
from egovcp.errors import EnvironmentFailure
from egovcp.files import check_depth
from egovcp.robot.geometry import focal_length
from egovcp.robot_spec import G1, ROBOT_KEY, RobotSpec
from egovcp.spec import (
    CAMERA_PITCH_RANGE,
    CAMERA_POSITION,
    CAMERA_VERTICAL_FOV,
    DEPTH_COLS,
    DEPTH_ROWS,
    PLANNER_HZ,
    SPEC_VERSION,
    Solid,
)

Array = NDArray[np.floating]

#: States of the runner of a robot.
MODES: Final = ("init", "stand", "armed", "run", "hold", "damp")
#: Key of `RunInfo.hashes` that names the low-level controller.
CONTROLLER: Final = "low_level_controller"
type Hand = Literal["left", "right"]


@dataclass(frozen=True)
class MotorReadings:
    """Motor measurements besides position and velocity, in the order of ``spec.JOINT_NAMES``.

    Fields that the robot or its bridge does not report are None.
    """

    torque: Array
    """(29,) N m, estimated by the motors."""
    temperature: Array | None = None
    """(29, 1) or (29, 2) deg C: one value, or casing and winding; NaN where a motor reports
    none."""
    faults: NDArray[np.integer] | None = None
    """(29,) status bits of each motor, 0 without a fault."""
    enabled: NDArray[np.bool_] | None = None
    """(29,) whether each motor follows commands."""


@dataclass(frozen=True)
class Candidates:
    """Some candidates of the planner, as paths of both hands."""

    hands_b: Array
    """(n, N, 2, 3) targets of the left and right hand, m, pelvis heading frame."""
    values: Array
    """(n,) objective of each candidate, return units."""


@dataclass(frozen=True)
class ValueMap:
    """Value of the planned action with the target of one hand moved over a grid (paper, figure 7a).

    The grid lies in the hand's x-z plane of the pelvis heading frame.
    """

    hand: Hand
    x_b: NDArray[np.float32]
    """(m,) hand target, m forward, ascending."""
    y_b: float
    """y of the grid: the planned hand target, m to the left."""
    z_b: NDArray[np.float32]
    """(n,) hand target, m up, ascending."""
    values: NDArray[np.float32]
    """(n, m) Q minus the cost of holding the pose, at (z, x), return units."""


@dataclass(frozen=True)
class Tick:
    """Observation, plan, action and outcome of one planner tick.

    ``depth`` and ``state`` are o_t, the actions are a_t, reward and flags follow from a_t: a tick
    is a row of a dataset without a shift.
    """

    index: int
    """Planner ticks since the start of the run."""
    time_ns: int
    """Time of o_t, nanoseconds; simulated time in lock-step."""
    depth: NDArray[np.uint16]
    """(48, 64) planar depth, mm; 0 invalid."""
    state: Array
    """(74,) proprioception, `spec.STATE_SLICES`."""
    action_planned: Array
    """(7,) action of the planner, in [-1, 1]."""
    action_sent: Array
    """(7,) action after the safety filter, as sent to the robot, in [-1, 1]."""
    depth_reconstructed: Array | None = None
    """(48, 64) decoded from the posterior, m."""
    depth_imagined: Array | None = None
    """(K, 48, 64) decoded 1..K ticks ahead along the chosen plan, m."""
    plan: Array | None = None
    """(N, 7) chosen actions, in [-1, 1]."""
    candidates: Candidates | None = None
    value: float | None = None
    """Objective of the chosen plan, return units."""
    termination: float | None = None
    """Probability that the present state is a failure, in [0, 1]."""
    value_maps: tuple[ValueMap, ...] = ()
    """At most one per hand."""
    reward: float = 0.0
    reward_terms: Mapping[str, float] = field(default_factory=dict)
    terminated: bool = False
    truncated: bool = False
    success: bool = False
    timing_ms: Mapping[str, float] = field(default_factory=dict)
    """Duration of each part of the tick, ms."""
    base: NDArray[np.float64] | None = None
    """(7,) position (m) and quaternion (wxyz) of the pelvis in the world, from the simulator; not
    an input of the policy."""
    scene: tuple[Solid, ...] = ()
    """Objects in the scene, in simulation only."""
    events: tuple[str, ...] = ()
    """Human-readable lines: start of the task, contacts, faults."""
    mode: str = ""
    """State of the runner, one of `MODES`; empty without a runner."""
    motors: MotorReadings | None = None
    """None in lock-step simulation, or before the first reading."""
    link: Mapping[str, float] = field(default_factory=dict)
    """Rate, jitter, loss and age of the robot's messages, and its mode machine; names end in their
    units."""


@dataclass(frozen=True)
class CameraView:
    """A pinhole depth camera fixed to a link, looking along that link's x axis; by default the
    simulated camera of the G1.

    Raises:
        UsageError: a number is not finite or out of bounds.
    """

    link: str = "torso_link"
    position: tuple[float, float, float] = CAMERA_POSITION
    """Optical centre in the link frame, m."""
    pitch: float = sum(CAMERA_PITCH_RANGE) / 2
    """Downward tilt of the optical axis, rad."""
    vertical_fov: float = bounded(CAMERA_VERTICAL_FOV, above=0, below=math.pi)
    """Angle between the top and the bottom edge of the image, rad."""

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def focal_px(self) -> float:
        return focal_length(self.vertical_fov)

    @property
    def centre_px(self) -> tuple[float, float]:
        """Principal point (column, row), the image centre."""
        return DEPTH_COLS / 2, DEPTH_ROWS / 2

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) optical axes (x right, y down, z forward) as columns in the link frame."""
        c, s = math.cos(self.pitch), math.sin(self.pitch)
        return np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]])


@dataclass(frozen=True)
class RunInfo:
    """Description of a run, the first record of every log; ticks can be read without it."""

    task: str
    seed: int = 0
    episode: int = 0
    fps: int = PLANNER_HZ
    camera: CameraView = CameraView()
    config: Mapping[str, object] = field(default_factory=dict)
    """Resolved configuration of the run; JSON values."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """Hashes or ids of artifact files, low-level controller and dataset."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Distribution name -> version."""
    backend: str = ""
    """Planner backend, such as int8 or float32; empty: none, or unknown."""
    robot: RobotSpec = G1
    """The robot; `Tick` describes shapes of the G1."""

    def to_metadata(self) -> dict[str, str]:
        """Strings for an MCAP metadata record; structured values are JSON."""
        record = asdict(self) | {"features": self.robot.features, "spec_version": SPEC_VERSION}
        record.pop("robot")
        if not self.robot.is_g1:
            record[ROBOT_KEY] = self.robot.to_json()
        return {
            key: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for key, value in record.items()
        }

    @staticmethod
    def from_metadata(record: Mapping[str, str]) -> RunInfo:
        """The inverse of `to_metadata`.

        Raises:
            KeyError: an entry is missing.
            ValueError: an entry has another type or is out of bounds.
        """

        def value[T](key: str, kind: type[T]) -> T:
            check_depth(record[key])
            return decode(kind, json.loads(record[key]), key)

        info = RunInfo(
            task=record["task"],
            seed=value("seed", int),
            episode=value("episode", int),
            fps=value("fps", int),
            camera=value("camera", CameraView),
            config=value("config", dict[str, Any]),
            hashes=value("hashes", dict[str, str]),
            versions=value("versions", dict[str, str]),
            backend=record.get("backend", ""),  # absent in older recordings
        )
        if info.fps <= 0:
            raise ValueError("expected fps > 0")
        if ROBOT_KEY not in record:
            return info
        return replace(info, robot=RobotSpec.from_json(value(ROBOT_KEY, dict[str, Any])))


class Sink(Protocol):
    """Writes the ticks of one run: ``open`` once, ``write`` in time order, ``close`` once."""

    def open(self, info: RunInfo) -> None:
        """Start the log of a run."""

    def write(self, tick: Tick) -> None:
        """Write one tick."""

    def close(self) -> None:
        """Complete the log on disk; further calls do nothing."""


def existing_file_error(path: Path) -> EnvironmentFailure:
    """What `Sink.open` raises if its file exists."""
    return EnvironmentFailure(
        f"{path} exists already; recordings are never overwritten: name another output, or remove "
        "the file"
    )


class Fanout[S: Sink]:
    """A sink that writes every tick to several sinks."""

    def __init__(self, sinks: Sequence[S]) -> None:
        self.sinks = tuple(sinks)

    def open(self, info: RunInfo) -> None:
        for sink in self.sinks:
            sink.open(info)

    def write(self, tick: Tick) -> None:
        for sink in self.sinks:
            sink.write(tick)

    def close(self) -> None:
        """Close every sink, even if one fails; its error is raised."""
        with ExitStack() as stack:
            for sink in reversed(self.sinks):
                stack.callback(sink.close)
