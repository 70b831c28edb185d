"""Describes the observations and actions of a robot: names, shapes, rate, action box, symmetry.

A dataset and a policy artifact hold the description of their robot, and the world model and the
planner take their sizes from it. One without a description is that of the Unitree `G1`, whose
values are the constants of `egovcp.spec`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.decode import DecodeError, decode
from egovcp.errors import UsageError

PATCH: Final = 16
"""Rows and columns of a depth image are multiples of this, the stride of the encoder."""
MAX_PIXELS: Final = 30_000
MAX_STATE: Final = 1024
MAX_ACTIONS: Final = 128
MAX_HZ: Final = 1000
MAX_DEPTH_M: Final = 65.0
"""Depth is stored in 16 bits, mm."""
ROBOT_KEY: Final = "robot"
"""Entry of ``meta/info.json`` with the description of another robot than the G1."""


@dataclass(frozen=True)
class Mirror:
    """Left-right reflection of a robot: value i of a reflected vector is sign[i] x[source[i]]."""

    state_source: tuple[int, ...]
    state_sign: tuple[float, ...]
    action_source: tuple[int, ...]
    action_sign: tuple[float, ...]


@dataclass(frozen=True)
class RobotSpec:
    """Observations and actions of a kind of robot.

    An action is normalised to [-1, 1] and changes by at most `spec.ACTION_RATE_LIMIT` per planner
    tick; 0 is the neutral pose. Positions of objects are in the robot's base frame: x forward, y
    left, z up.

    Raises:
        UsageError: the values contradict each other.
    """

    robot_type: str
    """Name of the kind of robot, such as ``planar_arm``."""
    depth: tuple[int, int]
    """Rows and columns of the depth image, multiples of 16."""
    depth_max_m: float
    """Range of the depth camera, m; farther pixels are 0 (invalid)."""
    planner_hz: int
    """Observations and actions per second."""
    state_names: tuple[str, ...]
    """Name of each value of the proprioception; ``group.name`` puts it into a group of figures."""
    action_names: tuple[str, ...]
    """Name of each value of the action."""
    action_box: spec.ActionBox
    """Physical values of the actions -1, 0 and 1."""
    mirror: Mirror | None = None
    """Reflection for data augmentation; None: the robot is not symmetric."""

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise UsageError(f"robot {self.robot_type!r}: {problem}")

    def _problems(self) -> Iterator[str]:
        rows, cols = self.depth
        if not self.robot_type:
            yield "it has no robot_type; give its name"
        if rows < PATCH or cols < PATCH or rows % PATCH or cols % PATCH or rows * cols > MAX_PIXELS:
            yield (
                f"its depth image is {rows} x {cols}, expected multiples of {PATCH} and at most "
                f"{MAX_PIXELS} pixels"
            )
        if not 0 < self.depth_max_m <= MAX_DEPTH_M:
            yield f"depth_max_m is {self.depth_max_m}, expected 0 to {MAX_DEPTH_M} m"
        if not 1 <= self.planner_hz <= MAX_HZ:
            yield f"planner_hz is {self.planner_hz}, expected 1 to {MAX_HZ}"
        for what, names, most in (
            ("state_names", self.state_names, MAX_STATE),
            ("action_names", self.action_names, MAX_ACTIONS),
        ):
            if not 1 < len(names) <= most:
                yield f"{what} are {len(names)} names, expected 2 to {most}"
            if "" in names:
                yield f"{what}[{names.index('')}] is empty"
            for name in names:
                if names.count(name) > 1:
                    yield f"{what} has {name!r} twice"
        size = self.action_dim
        if not _is_ascending(self.action_box, size):
            yield (
                f"its action_box is not low < neutral < high for each of {size} actions (found "
                f"low {self.action_box.low}, neutral {self.action_box.neutral}, high "
                f"{self.action_box.high})"
            )
        if self.mirror is None:
            return
        for what, source, sign, size in (
            ("state", self.mirror.state_source, self.mirror.state_sign, self.state_dim),
            ("action", self.mirror.action_source, self.mirror.action_sign, self.action_dim),
        ):
            if not _is_reflection(source, sign, size):
                yield (
                    f"the mirror of the {what} is no reflection: applied twice to {size} "
                    "values it must give them back"
                )

    @property
    def state_dim(self) -> int:
        """Number of values of the proprioception."""
        return len(self.state_names)

    @property
    def action_dim(self) -> int:
        """Number of values of the action."""
        return len(self.action_names)

    @property
    def is_g1(self) -> bool:
        """Whether this is the Unitree G1."""
        return self == G1

    @cached_property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's description of the columns of an episode; see `spec.FEATURES`."""
        own: dict[str, dict[str, Any]] = {
            spec.DEPTH_KEY: {"shape": (*self.depth, 1)},
            spec.STATE_KEY: {"shape": (self.state_dim,), "names": list(self.state_names)},
            spec.ACTION_KEY: {"shape": (self.action_dim,), "names": list(self.action_names)},
        }
        return {key: {**value, **own.get(key, {})} for key, value in spec.FEATURES.items()}

    @cached_property
    def state_slices(self) -> Mapping[str, slice]:
        """Groups of neighbouring values of the proprioception, for figures: name -> slice."""
        if self.is_g1:
            return spec.STATE_SLICES
        groups: dict[str, slice] = {}
        for i, name in enumerate(self.state_names):
            group = name.partition(".")[0]
            start = groups[group].start if group in groups and groups[group].stop == i else i
            groups[group] = slice(start, i + 1)
        return groups

    def mirrored_state[F: np.floating](self, state: NDArray[F]) -> NDArray[F]:
        """Reflected proprioception (..., S); requires `mirror`."""
        assert self.mirror is not None, "the robot is not symmetric"
        return _reflect(state, self.mirror.state_source, self.mirror.state_sign)

    def mirrored_action[F: np.floating](self, action: NDArray[F]) -> NDArray[F]:
        """Reflected normalised action (..., A); requires `mirror`."""
        assert self.mirror is not None, "the robot is not symmetric"
        return _reflect(action, self.mirror.action_source, self.mirror.action_sign)

    def to_json(self) -> dict[str, Any]:
        """JSON-compatible content; that of the G1 has the keys of earlier versions only."""
        content = {
            "spec_version": spec.SPEC_VERSION,
            "planner_hz": self.planner_hz,
            "depth": list(self.depth),
            "state_names": list(self.state_names),
            "action_names": list(self.action_names),
            "action_box": {k: list(v) for k, v in dataclasses.asdict(self.action_box).items()},
        }
        if self.is_g1:
            return content
        mirror = self.mirror and {k: list(v) for k, v in dataclasses.asdict(self.mirror).items()}
        return content | {
            "robot_type": self.robot_type,
            "depth_max_m": self.depth_max_m,
            "mirror": mirror,
        }

    @staticmethod
    def from_json(content: object) -> RobotSpec:
        """The inverse of `to_json`.

        Raises:
            DecodeError: the content is none of this version, or makes no sense.
        """
        if content == G1.to_json():
            return G1
        options = decode(dict[str, Any], content, ROBOT_KEY)
        if options.pop("spec_version", None) != spec.SPEC_VERSION:
            raise DecodeError("the description of the robot is of another spec_version")
        return decode(RobotSpec, options, ROBOT_KEY)


def _is_ascending(box: spec.ActionBox, size: int) -> bool:
    """Whether low < neutral < high are ``size`` finite numbers each."""
    try:
        values = np.array([box.low, box.neutral, box.high], np.float64)
    except (TypeError, ValueError):
        return False
    finite = values.shape == (3, size) and np.isfinite(values).all()
    return bool(finite and (np.diff(values, axis=0) > 0).all())


def _is_reflection(source: Sequence[int], sign: Sequence[float], size: int) -> bool:
    if not len(source) == len(sign) == size or not set(sign) <= {1, -1}:
        return False
    if not all(isinstance(i, int) and 0 <= i < size for i in source):
        return False
    return all(source[source[i]] == i and sign[source[i]] == sign[i] for i in range(size))


def _reflect[F: np.floating](
    values: NDArray[F], source: Sequence[int], sign: Sequence[float]
) -> NDArray[F]:
    return np.asarray(values[..., list(source)] * np.array(sign, values.dtype))


# --- the G1's reflection ------------------------------------------------------------------
# It maps y to -y. Vectors change the sign of y; axial vectors (angular velocity) that of x and z;
# left and right limbs are exchanged; a joint angle keeps its sign if the axis is y (pitch, knee,
# elbow) and changes it if the axis is x or z (roll, yaw).
_POLAR: Final = (1.0, -1.0, 1.0)  # position, velocity, gravity
_AXIAL: Final = (-1.0, 1.0, -1.0)  # angular velocity
_PLANAR: Final = (1.0, -1.0, -1.0)  # vx, vy, yaw rate
_OTHER_HAND: Final = (3, 4, 5, 0, 1, 2)


def _other_side(joint: str) -> str:
    side, _, rest = joint.partition("_")
    return {"left": f"right_{rest}", "right": f"left_{rest}"}.get(side, joint)


def _joint_sign(joint: str) -> float:
    return -1.0 if joint.endswith(("_roll_joint", "_yaw_joint")) else 1.0


def _g1_mirror() -> Mirror:
    source, sign = np.arange(spec.STATE_DIM), np.ones(spec.STATE_DIM)
    joints = [spec.JOINT_NAMES.index(_other_side(joint)) for joint in spec.JOINT_NAMES]
    at = spec.STATE_SLICES
    sign[at["angular_velocity"]] = _AXIAL
    sign[at["projected_gravity"]] = _POLAR
    sign[at["command_velocity"]] = _PLANAR
    sign[at["command_hands"]] = _POLAR + _POLAR
    source[at["command_hands"]] = source[at["command_hands"]][list(_OTHER_HAND)]
    for part in ("joint_position", "joint_velocity"):
        sign[at[part]] = [_joint_sign(joint) for joint in spec.JOINT_NAMES]
        source[at[part]] = source[at[part]][joints]
    return Mirror(
        tuple(source.tolist()), tuple(sign.tolist()), (*_OTHER_HAND, 6), (*_POLAR, *_POLAR, 1.0)
    )


#: The Unitree G1 of `egovcp.spec`.
G1: Final = RobotSpec(
    robot_type="unitree_g1",
    depth=(spec.DEPTH_ROWS, spec.DEPTH_COLS),
    depth_max_m=spec.DEPTH_MAX_M,
    planner_hz=spec.PLANNER_HZ,
    state_names=spec.STATE_NAMES,
    action_names=spec.ACTION_NAMES,
    action_box=spec.ACTION_BOX,
    mirror=_g1_mirror(),
)
