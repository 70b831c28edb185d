"""Rejects readings that a G1 cannot produce: bounds per quantity, and consistency over time.

Bounds hold for every single reading. Consistency compares readings over a window of 50 ms: the
change of each joint's position with the integral of its reported speed, and the rotation of the
pelvis with the integral of the gyroscope,

    |x - x_0 - int v dt|  <=  offset + drift t + curvature h^2 + sum |dv| (h/2 + lag) + jitter |v|

with t the time since the window began (at most 100 ms), h the longest interval between two readings
in it and |v| the greatest speed. The terms allow for sensor noise, scale errors of the speed,
changes of speed between two readings (trapezoidal rule), filtered speeds, and the difference
between times of arrival and of measurement. A speed must also not jump: it may differ from that of
the last accepted reading by at most a constant plus an acceleration times h. A speed that jumps is
accepted once positions have followed it for 30 ms.

The constants pass ten minutes of simulated walking, bracing and pushes at 200 Hz without a
rejected reading (`benchmarks/false_alarms.py`). They are not verified on hardware.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from egovcp.robot.g1 import EFFORT_LIMIT, VELOCITY_LIMIT
from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.base import Array, LowState

#: rad/s: 2000 deg/s, the full scale of common MEMS gyroscopes; Unitree publishes none for the G1.
GYROSCOPE_RANGE: Final = 2000.0 * np.pi / 180.0
#: Twice the rated torque covers all variants: with the 22.5 hip pitch gear the joint has 139 N m
#: where the table in `egovcp.robot.g1` has 88.
TORQUE_BOUND: Final = 2.0 * EFFORT_LIMIT  # N m
VELOCITY_BOUND: Final = 1.5 * VELOCITY_LIMIT  # rad/s; a simulated arm reaches 1.04 of the limit
_POSITION_MARGIN: Final = 0.3  # rad; joints yield by 0.1 at their stops in simulation
POSITION_LOWER: Final = JOINT_LOWER - _POSITION_MARGIN
POSITION_UPPER: Final = JOINT_UPPER + _POSITION_MARGIN

WINDOW_S: Final = 0.05
#: Inconsistent readings that agree with each other for this long are accepted again: the robot has
#: really moved. Longer than the default of `Limits.state_damp_s`, so that a standing robot is
#: damped before; with a longer limit, the robot goes on without DAMP.
RESYNC_S: Final = 0.5
#: The same for readings whose speed has jumped, with positions that contradict nothing.
JUMP_RESYNC_S: Final = 0.03
#: Plausible readings required in a row after as many rejected ones.
_PROBATION: Final = 4

_NAMES: Final = (*JOINT_NAMES, "gyroscope x", "gyroscope y", "gyroscope z")
_QUANTITIES: Final = (
    *(f"{name} position (rad)" for name in JOINT_NAMES),
    *(f"{name} speed (rad/s)" for name in JOINT_NAMES),
    *(f"{name} torque (N m)" for name in JOINT_NAMES),
    *(f"{name} (rad/s)" for name in _NAMES[NUM_JOINTS:]),
)
_HALF_RANGE: Final = np.concatenate(
    [
        (POSITION_UPPER - POSITION_LOWER) / 2,
        VELOCITY_BOUND,
        TORQUE_BOUND,
        np.full(3, GYROSCOPE_RANGE),
    ]
)
_CENTRE: Final = np.zeros(3 * NUM_JOINTS + 3)
_CENTRE[:NUM_JOINTS] = (POSITION_UPPER + POSITION_LOWER) / 2


def _columns(joints: float, rotation: float) -> Array:
    return np.array([joints] * NUM_JOINTS + [rotation] * 3)


_OFFSET: Final = _columns(0.05, 0.05)  # rad: 7 times the std of the noise of a difference
_DRIFT: Final = _columns(1.0, 0.5)  # rad/s
#: rad/s^2. Measured between readings 10 to 20 ms apart: 1015 of a shoulder, 220 of an ankle's
#: pitch, 107 of elbow and wrist, 69 of a shoulder's roll, 18 of all others, 150 of the pelvis.
_ACCELERATION: Final = {"shoulder_pitch": 1500.0, "shoulder_yaw": 1500.0} | dict.fromkeys(
    ("ankle_pitch", "shoulder_roll", "elbow", "wrist"), 500.0
)
_CURVATURE: Final = np.array(
    [
        next((_ACCELERATION[kind] for kind in _ACCELERATION if kind in name), 150.0)
        for name in JOINT_NAMES
    ]
    + [300.0] * 3
)
_LAG: Final = 0.003  # s
_JITTER: Final = 0.005  # s
_MAX_SPEED_TERM: Final = 0.15  # rad
_FAST: Final = ("ankle_pitch", "shoulder", "elbow", "wrist")
#: Share of the velocity limit that a joint's speed may jump by. Measured within 5 ms: 11 rad/s of a
#: knee, 25 of an ankle's pitch, 31 of a shoulder, 6 of the pelvis.
_SHARE: Final = np.array([1.0 if any(f in n for f in _FAST) else 0.5 for n in JOINT_NAMES])
_JUMP: Final = np.concatenate([_SHARE * VELOCITY_LIMIT, np.full(3, 6.0)])  # rad/s
_JUMP_RATE: Final = _columns(1500.0, 700.0)  # rad/s^2


class Contradiction(NamedTuple):
    """A reading that contradicts those before it."""

    text: str  # which quantity, with the values
    jump: bool  # whether only the speed jumped: no position or orientation contradicts it


class ReadingWindow(NamedTuple):
    """What the next reading is compared with: the window's first reading, and sums since then."""

    start_ns: int
    position: Array  # (29,) rad, joints at the start
    quaternion: Array  # (4,) pelvis at the start
    accepted_speed: Array  # (32,) rad/s of the newest accepted reading: joints and gyroscope
    time_ns: int  # time of the newest reading
    speed: Array  # (32,) rad/s of the newest reading
    travel: Array  # (32,) rad, integral of the speed
    speed_term: Array  # (32,) rad, sum |dv| (h/2 + lag)
    fastest: Array  # (32,) rad/s, greatest absolute speed
    interval_s: float  # longest time between two readings

    @classmethod
    def begin(cls, state: LowState) -> ReadingWindow:
        """A window whose only reading is ``state``."""
        zero, speed = np.zeros(NUM_JOINTS + 3), _speed(state)
        start = (state.time_ns, state.joint_position, state.quaternion_w)
        return cls(*start, speed, state.time_ns, speed, zero, zero, np.abs(speed), 0.0)

    def extend(self, state: LowState) -> tuple[ReadingWindow, Contradiction | None]:
        """Compare a reading within bounds with this window; returns the window with the reading,
        and what contradicts it. A contradicted reading never begins a new window."""
        speed = _speed(state)
        interval = max(0.0, (state.time_ns - self.time_ns) * 1e-9)
        elapsed = (state.time_ns - self.start_ns) * 1e-9
        travel = self.travel + (0.5 * interval) * (speed + self.speed)
        speed_term = self.speed_term + (0.5 * interval + _LAG) * np.abs(speed - self.speed)
        fastest = np.maximum(self.fastest, np.abs(speed))
        longest = max(self.interval_s, interval)
        rotation = _rotation(self.quaternion, state.quaternion_w)
        change = np.concatenate([state.joint_position - self.position, rotation])
        drift = _DRIFT * min(elapsed, 2.0 * WINDOW_S)
        tolerance = _OFFSET + drift + _CURVATURE * (longest * longest)
        tolerance += np.minimum(speed_term, _MAX_SPEED_TERM) + _JITTER * fastest
        drifted = ~(np.abs(change - travel) <= tolerance)
        jumped = np.abs(speed - self.accepted_speed) > _JUMP + _JUMP_RATE * longest
        extended = self._replace(
            time_ns=state.time_ns,
            speed=speed,
            travel=travel,
            speed_term=speed_term,
            fastest=fastest,
            interval_s=longest,
        )
        if drifted.any():
            text = _drift_text(int(drifted.argmax()), change, travel, speed, elapsed)
            return extended, Contradiction(text, jump=False)
        if jumped.any():
            i, before = int(jumped.argmax()), self.accepted_speed
            text = f"{_NAMES[i]} jumped from {before[i]:+.1f} to {speed[i]:+.1f} rad/s"
            return extended, Contradiction(text, jump=True)
        if elapsed >= WINDOW_S:
            return ReadingWindow.begin(state), None
        return extended._replace(accepted_speed=speed), None


def out_of_bounds(state: LowState) -> str:
    """Describe a value that no G1 can measure; empty: none. ``state`` has `LowState.motors`."""
    assert state.motors is not None, "every rt/lowstate has torques"
    values = np.concatenate(
        [state.joint_position, state.joint_velocity, state.motors.torque, state.angular_velocity]
    )
    wrong = ~(np.abs(values - _CENTRE) <= _HALF_RANGE)  # true for NaN too
    if not wrong.any():
        return ""
    i = int(wrong.argmax())
    low, high = _CENTRE[i] - _HALF_RANGE[i], _CENTRE[i] + _HALF_RANGE[i]
    return f"{_QUANTITIES[i]} is {values[i]:.2f}, expected {low:.2f} to {high:.2f}"


def _speed(state: LowState) -> Array:
    """(32,) rad/s of joints and gyroscope."""
    return np.concatenate([state.joint_velocity, state.angular_velocity])


def _rotation(start: Array, end: Array) -> Array:
    """(3,) rotation vector from one unit quaternion wxyz to another, in the frame of the first;
    to third order."""
    a, b, c, d = start.tolist()
    w, x, y, z = end.tolist()
    twice = 2.0 if a * w + b * x + c * y + d * z >= 0.0 else -2.0
    return np.array(
        [
            twice * (a * x - b * w - c * z + d * y),
            twice * (a * y - c * w - d * x + b * z),
            twice * (a * z - d * w - b * y + c * x),
        ]
    )


def _drift_text(i: int, change: Array, travel: Array, speed: Array, elapsed: float) -> str:
    ms = elapsed * 1e3
    if i < NUM_JOINTS:
        return (
            f"{_NAMES[i]} moved by {change[i]:+.2f} rad in {ms:.0f} ms, but its speeds add up to "
            f"{travel[i]:+.2f} rad (now {speed[i]:+.1f} rad/s)"
        )
    return (
        f"{_NAMES[i]} reads {speed[i]:+.1f} rad/s, {travel[i]:+.2f} rad in {ms:.0f} ms, but the "
        f"pelvis turned by {change[i]:+.2f} rad"
    )


class PlausibilityFilter:
    """Checks the readings of one robot in the order of their arrival."""

    def __init__(self) -> None:
        self._window: ReadingWindow | None = None
        self._candidate: ReadingWindow | None = None  # of the rejected readings
        self._candidate_ns = 0
        self._only_jumped = True
        self._distrust = 0
        self._last_problem = ""

    def check(self, state: LowState) -> str:
        """Why a reading, with `LowState.motors`, must not be used; empty: it is plausible."""
        if problem := self._problem(state):
            self._last_problem = problem
            self._distrust = min(self._distrust + 1, _PROBATION)
            return problem
        if self._distrust > 1:  # among random readings some are plausible by chance
            self._distrust -= 1
            return self._last_problem
        self._distrust = 0
        return ""

    def _problem(self, state: LowState) -> str:
        if problem := out_of_bounds(state):
            return problem
        if self._window is None:
            self._window = ReadingWindow.begin(state)
            return ""
        self._window, contradiction = self._window.extend(state)
        if contradiction is None:
            self._candidate = None
            return ""
        return "" if self._resynchronised(state, contradiction) else contradiction.text

    def _resynchronised(self, state: LowState, contradiction: Contradiction) -> bool:
        """Whether the rejected readings have agreed with each other for long enough."""
        first = self._candidate is None
        self._only_jumped = contradiction.jump and (first or self._only_jumped)
        if self._candidate is not None:
            self._candidate, disagreement = self._candidate.extend(state)
            if disagreement is not None:
                self._candidate = None
        if self._candidate is None:
            self._candidate = ReadingWindow.begin(state)
            self._candidate_ns = state.time_ns
        needed = JUMP_RESYNC_S if self._only_jumped else RESYNC_S
        if state.time_ns - self._candidate_ns < needed * 1e9:
            return False
        self._window, self._candidate = self._candidate, None
        self._distrust = 0
        return True
