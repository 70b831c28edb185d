"""One planner tick, as every log sees it, and what describes the run it belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

#: What a robot that is driven by a runner can be doing.
MODES: Final = ("init", "stand", "armed", "run", "hold", "damp")
type Hand = Literal["left", "right"]


@dataclass(frozen=True)
class SceneObject:
    """A thing in the simulated scene; known in simulation only."""

    name: str
    """Unique within the scene, such as ``wall``."""
    shape: Literal["sphere", "box"]
    position_w: tuple[float, float, float]
    """Centre, m, world frame."""
    quaternion_w: tuple[float, float, float, float]
    """Rotation to the world frame, (w, x, y, z)."""
    size: tuple[float, float, float]
    """Half extents along its own axes, m; a sphere repeats its radius."""


@dataclass(frozen=True)
class BasePose:
    """Pelvis pose in the world: simulator truth, never an input of the policy."""

    position_w: Array
    """(3,) m."""
    quaternion_w: Array
    """(4,) (w, x, y, z)."""


@dataclass(frozen=True)
class MotorReadings:
    """What the motors report besides position and velocity, (29,) in ``spec.JOINT_NAMES`` order.

    Only the torque is always there: what a robot or its bridge does not report is None.
    """

    torque: Array
    """(29,) N m, as the motors estimate it."""
    temperature: Array | None = None
    """(29, 1) or (29, 2) deg C: one value, or casing and winding; not-a-number where a motor
    reports none."""
    faults: NDArray[np.integer] | None = None
    """(29,) status bits of each motor, 0 without a fault."""
    lost: NDArray[np.integer] | None = None
    """(29,) packets to or from each motor that were lost since it was switched on."""
    enabled: NDArray[np.bool_] | None = None
    """(29,) whether each motor is in the mode that obeys commands."""


@dataclass(frozen=True)
class Candidates:
    """Some of the plans that the planner weighed, drawn as paths of both hands."""

    hands_b: Array
    """(n, N, 2, 3) targets of the left and right hand, m, pelvis heading frame."""
    values: Array
    """(n,) objective of each candidate, return units."""


@dataclass(frozen=True)
class ValueMap:
    """What the policy thinks of putting one hand elsewhere, all else as planned (paper fig. 7a).

    A grid in the hand's x-z plane of the pelvis heading frame.
    """

    hand: Hand
    x_b: NDArray[np.float32]
    """(m,) hand target, m forward, ascending."""
    y_b: float
    """Planned hand target, m to the left: where the plane lies."""
    z_b: NDArray[np.float32]
    """(n,) hand target, m up, ascending."""
    values: NDArray[np.float32]
    """(n, m) Q at (z, x), return units."""


@dataclass(frozen=True)
class Tick:
    """Everything that one planner tick saw, thought and did.

    ``depth`` and ``state`` are o_t, the actions a_t, and the reward and flags follow from a_t,
    so a recording converts to dataset rows without shifting anything.
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
    """(7,) what the planner asked for, box units."""
    action_sent: Array
    """(7,) what the robot was sent after the safety filter, box units."""
    depth_reconstructed: Array | None = None
    """(48, 64) decoded from the posterior, m."""
    depth_imagined: Array | None = None
    """(K, 48, 64) decoded 1..K ticks ahead along the chosen plan, m."""
    plan: Array | None = None
    """(N, 7) chosen actions, box units."""
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
    base: BasePose | None = None
    scene: tuple[SceneObject, ...] = ()
    events: tuple[str, ...] = ()
    """Human-readable lines: start of the task, contacts, faults."""
    mode: str = ""
    """State of the runner's state machine, one of `MODES`; empty: there is none."""
    motors: MotorReadings | None = None
    """None: the robot is simulated in lock-step, or nothing was read yet."""
    link: Mapping[str, float] = field(default_factory=dict)
    """Rate, jitter, loss and age of the robot's messages, and its mode machine; the names carry
    their units."""
