"""Rejects readings that a G1 cannot produce: bounds per quantity, and consistency over time.

Bounds hold for every single reading. Consistency compares readings over a window of 50 ms: the
change of each joint's position against the integral of its reported speed, and the rotation of
the pelvis against the integral of the gyroscope,

    |x - x_0 - int v dt|  <=  offset + drift t + curvature h^2 + sum |dv| (h/2 + lag) + jitter |v|

with t the time since the window began (at most 100 ms), h the longest interval between two readings
in it and |v| the greatest speed. The terms allow for sensor noise, for the error of a speed's
scale, for what a speed may do between two readings (trapezoidal rule), for a speed that is
filtered, and for time stamps that are those of arrival. A speed may also not jump: it differs from
that of the last accepted reading by at most a constant plus an acceleration times h. One that jumps
all the same is accepted once positions have followed it for 30 ms.

The constants pass ten minutes of simulated walking, bracing and pushes at 200 Hz without a
rejected reading (`benchmarks/false_alarms.py`). They are not verified on hardware.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.g1 import EFFORT_LIMIT, VELOCITY_LIMIT
from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.body import BodyState

Array = NDArray[np.float64]

#: rad/s. The full scale of the MEMS gyroscopes that humanoids carry, 2000 deg/s; Unitree publishes
#: no range for the G1's.
GYROSCOPE_RANGE: Final = 2000.0 * np.pi / 180.0
#: Twice the rated torque covers all variants: with the 22.5 hip pitch gear the joint has 139 N m
#: where the table in `egovcp.robot.g1` has 88.
TORQUE_BOUND: Final = 2.0 * EFFORT_LIMIT  # N m
VELOCITY_BOUND: Final = 1.5 * VELOCITY_LIMIT  # rad/s; a simulated arm reaches 1.04 of the limit
_POSITION_MARGIN: Final = 0.3  # rad; joints yield by 0.1 at their stops in simulation
POSITION_LOWER: Final = JOINT_LOWER - _POSITION_MARGIN
POSITION_UPPER: Final = JOINT_UPPER + _POSITION_MARGIN

WINDOW_S: Final = 0.05
#: Readings that were rejected as inconsistent, but agree with each other for so long, are believed
#: again: the robot has really moved. Longer than the limit after which it is damped.
RESYNC_S: Final = 0.5
#: Likewise for readings whose speed has jumped, with positions that contradict nothing.
JUMP_RESYNC_S: Final = 0.03
#: So many plausible readings in a row it takes after a run of rejected ones, if that was as long.
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
_BEND: Final = {"shoulder_pitch": 1500.0, "shoulder_yaw": 1500.0} | dict.fromkeys(
    ("ankle_pitch", "shoulder_roll", "elbow", "wrist"), 500.0
)
_CURVATURE: Final = np.array(
    [next((_BEND[kind] for kind in _BEND if kind in name), 150.0) for name in JOINT_NAMES]
    + [300.0] * 3
)
_LAG: Final = 0.003  # s
_JITTER: Final = 0.005  # s
_MOST_SLACK: Final = 0.15  # rad
#: Share of the velocity limit that a joint's speed may jump by. Measured within 5 ms: 11 rad/s of a
#: knee, 25 of an ankle's pitch, 31 of a shoulder, 6 of the pelvis.
_BRISK: Final = ("ankle_pitch", "shoulder", "elbow", "wrist")
_SHARE: Final = np.array([1.0 if any(b in n for b in _BRISK) else 0.5 for n in JOINT_NAMES])
_JUMP: Final = np.concatenate([_SHARE * VELOCITY_LIMIT, np.full(3, 6.0)])  # rad/s
_JUMP_RATE: Final = _columns(1500.0, 700.0)  # rad/s^2


class Contradiction(NamedTuple):
    """Between a reading and those before it."""

    words: str
    """Which quantity, with the values."""
    jump: bool
    """Whether only the speed jumped: no position or orientation contradicts it."""


class Track(NamedTuple):
    """The readings since the window began, as far as the next one is compared with them."""

    start_ns: int
    position: Array
    """(29,) rad, where the joints were then."""
    quaternion: Array
    """(4,) and the pelvis."""
    accepted_speed: Array
    """(32,) rad/s of the newest reading that was not contradicted: joints and gyroscope."""
    time_ns: int
    """Time of the newest reading."""
    speed: Array
    """(32,) rad/s of the newest reading."""
    travel: Array
    """(32,) rad, integral of the speed."""
    slack: Array
    """(32,) rad that the integral may be wrong by."""
    fastest: Array
    """(32,) rad/s, greatest absolute speed."""
    interval_s: float
    """Longest time between two readings."""


def out_of_bounds(body: BodyState, torque: Array) -> str:
    """What in one reading no G1 can measure, in words with its value; empty: nothing.

    Args:
        body: the reading.
        torque: (29,) N m, as estimated by the motors.
    """
    values = np.concatenate(
        [body.joint_position, body.joint_velocity, torque, body.angular_velocity]
    )
    wrong = ~(np.abs(values - _CENTRE) <= _HALF_RANGE)  # true for NaN too
    if not wrong.any():
        return ""
    i = int(wrong.argmax())
    low, high = _CENTRE[i] - _HALF_RANGE[i], _CENTRE[i] + _HALF_RANGE[i]
    return f"{_QUANTITIES[i]} is {values[i]:.2f}, expected {low:.2f} to {high:.2f}"


def follow(track: Track | None, body: BodyState) -> tuple[Track, Contradiction | None]:
    """Compare a reading with those before it.

    Args:
        track: of the readings before; None: this is the first.
        body: the reading, within bounds.

    Returns:
        the track with this reading, and what contradicts it. A reading that is contradicted never
        begins a new window.
    """
    speed = np.concatenate([body.joint_velocity, body.angular_velocity])
    if track is None:
        return _begin(body, speed), None
    interval = max(0.0, (body.time_ns - track.time_ns) * 1e-9)
    elapsed = (body.time_ns - track.start_ns) * 1e-9
    travel = track.travel + (0.5 * interval) * (speed + track.speed)
    slack = track.slack + (0.5 * interval + _LAG) * np.abs(speed - track.speed)
    fastest = np.maximum(track.fastest, np.abs(speed))
    longest = max(track.interval_s, interval)
    change = np.concatenate(
        [body.joint_position - track.position, _rotation(track.quaternion, body.quaternion_w)]
    )
    drift = _DRIFT * min(elapsed, 2.0 * WINDOW_S)
    tolerance = _OFFSET + drift + _CURVATURE * (longest * longest)
    tolerance += np.minimum(slack, _MOST_SLACK) + _JITTER * fastest
    drifted = ~(np.abs(change - travel) <= tolerance)
    jumped = np.abs(speed - track.accepted_speed) > _JUMP + _JUMP_RATE * longest
    found = track._replace(
        time_ns=body.time_ns,
        speed=speed,
        travel=travel,
        slack=slack,
        fastest=fastest,
        interval_s=longest,
    )
    if drifted.any():
        words = _drift(int(drifted.argmax()), change, travel, speed, elapsed)
        return found, Contradiction(words, jump=False)
    if jumped.any():
        words = _jump(int(jumped.argmax()), track.accepted_speed, speed)
        return found, Contradiction(words, jump=True)
    if elapsed >= WINDOW_S:
        return _begin(body, speed), None
    return found._replace(accepted_speed=speed), None


def _begin(body: BodyState, speed: Array) -> Track:
    none = np.zeros(NUM_JOINTS + 3)
    start = (body.time_ns, body.joint_position, body.quaternion_w)
    return Track(*start, speed, body.time_ns, speed, none, none, np.abs(speed), 0.0)


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


def _jump(i: int, before: Array, now: Array) -> str:
    return f"{_NAMES[i]} jumped from {before[i]:+.1f} to {now[i]:+.1f} rad/s"


def _drift(i: int, change: Array, travel: Array, speed: Array, elapsed: float) -> str:
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
    """Judges the readings of one robot in the order of their arrival.

    Args:
        consistency: whether readings are also compared with those before them.
    """

    def __init__(self, consistency: bool = True) -> None:
        self._consistency = consistency
        self._track: Track | None = None
        self._candidate: Track | None = None  # of the rejected readings
        self._candidate_ns = 0
        self._only_jumped = True
        self._distrust = 0
        self._problem_before = ""

    def judge(self, body: BodyState, torque: Array) -> str:
        """Why the reading must not be used, in words; empty: it is plausible.

        Args:
            body: the reading.
            torque: (29,) N m, as estimated by the motors.
        """
        if problem := self._problem(body, torque):
            self._problem_before = problem
            self._distrust = min(self._distrust + 1, _PROBATION)
            return problem
        if self._distrust > 1:  # among random readings some are plausible by chance
            self._distrust -= 1
            return self._problem_before
        self._distrust = 0
        return ""

    def _problem(self, body: BodyState, torque: Array) -> str:
        problem = out_of_bounds(body, torque)
        if problem or not self._consistency:
            return problem
        self._track, found = follow(self._track, body)
        if found is None:
            self._candidate = None
            return ""
        return "" if self._resynchronised(body, found) else found.words

    def _resynchronised(self, body: BodyState, found: Contradiction) -> bool:
        """Whether the rejected readings have agreed with each other for long enough."""
        first = self._candidate is None
        self._only_jumped = found.jump and (first or self._only_jumped)
        if self._candidate is not None:
            self._candidate, disagreement = follow(self._candidate, body)
            if disagreement is not None:
                self._candidate = None
        if self._candidate is None:
            self._candidate, _ = follow(None, body)
            self._candidate_ns = body.time_ns
        needed = JUMP_RESYNC_S if self._only_jumped else RESYNC_S
        if body.time_ns - self._candidate_ns < needed * 1e9:
            return False
        self._track, self._candidate = self._candidate, None
        self._distrust = 0  # they agreed with each other
        return True
