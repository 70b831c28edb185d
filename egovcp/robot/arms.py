"""Both arms: kinematics in the torso frame, inverse kinematics, and tracking of hand targets.

Shapes carry the side (left, right) and the arm's joint: (B, 2, 7).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np

from egovcp.bounds import bounded
from egovcp.robot.g1 import ARMS, DAMPING, STIFFNESS
from egovcp.robot.geometry import Array, rotate
from egovcp.robot.kinematics import (
    COS_ROTATION,
    JOINT_AXIS,
    JOINT_LOWER,
    JOINT_OFFSET,
    JOINT_UPPER,
    LINK_COM,
    LINK_MASS,
    PALM_OFFSET,
    REST_ROTATION,
    SIN_ROTATION,
)
from egovcp.spec import CONTROLLER_HZ

_SHAPE: Final = (2, 7)
_FIRST_LINK: Final = ARMS.start + 1
_OFFSET: Final = JOINT_OFFSET[ARMS].reshape(*_SHAPE, 3)
MASS: Final = LINK_MASS[_FIRST_LINK:].reshape(_SHAPE)
_COM: Final = LINK_COM[_FIRST_LINK:].reshape(*_SHAPE, 3)
_AXIS: Final = np.argmax(np.abs(JOINT_AXIS[ARMS]), axis=-1)  # (14,) 0, 1 or 2
LOWER: Final = JOINT_LOWER[ARMS].reshape(_SHAPE)
UPPER: Final = JOINT_UPPER[ARMS].reshape(_SHAPE)
SHOULDER: Final = _OFFSET[:, 0]  # (2, 3) m, torso frame
_TAIL_MASS: Final = np.cumsum(MASS[:, ::-1], axis=1)[:, ::-1]  # (2, 7) joint's link and beyond


def _homogeneous(rotation: Array, offset: Array) -> Array:
    """(2, 7, 4, 4) from rotations (14, 3, 3) and offsets (2, 7, 3); the last row stays zero."""
    out = np.zeros((*_SHAPE, 4, 4))
    out[..., :3, :3] = rotation.reshape(*_SHAPE, 3, 3)
    out[..., :3, 3] = offset
    return out


_H0: Final = _homogeneous(REST_ROTATION[ARMS], _OFFSET)
_H0[..., 3, 3] = 1.0
_H1: Final = _homogeneous(SIN_ROTATION[ARMS], np.zeros(3))
_H2: Final = _homogeneous(COS_ROTATION[ARMS], np.zeros(3))
#: Entries of the flattened chain (2, 7, 4, 4) that hold each joint's axis.
_AXIS_ENTRIES: Final = (16 * np.arange(14)[:, None] + 4 * np.arange(3) + _AXIS[:, None]).reshape(
    *_SHAPE, 3
)

REST: Final = np.array([[0.25, 0.2, 0.0, 0.75, 0, 0, 0], [0.25, -0.2, 0.0, 0.75, 0, 0, 0]])
#: Weight of each joint in reaching; the motors of the wrist are weak.
_SHARE: Final = np.array([1.0, 1.0, 0.8, 1.0, 0.2, 0.25, 0.25])
_LIMIT_MARGIN: Final = 0.03  # rad kept free at each joint limit
_LIMIT_LOW: Final = LOWER + _LIMIT_MARGIN
_LIMIT_HIGH: Final = UPPER - _LIMIT_MARGIN
_DAMPING: Final = 0.05  # m: damped least squares, lambda
_MAX_STEP: Final = 0.3  # rad per joint and iteration
_MAX_ERROR: Final = 0.08  # m per iteration: the step is linear
#: Share of the way to REST per iteration, in the null space; makes the posture independent of the
#: path to the target.
_REST_PULL: Final = 0.25
REACH: Final = 0.45  # m, shoulder to palm; a straight arm is 0.465
_TRUNK_RADII: Final = (0.16, 0.15)  # m, keep-out ellipse around the trunk: forward, sideways
#: Part of the controller's identity: what can be tuned. The kinematics and the bounds of targets
#: are not in it; ``tests/egovcp/robot/test_kinematics.py`` says when they need a new identity.
IDENTITY: Final = (
    REST.tolist(),
    _SHARE.tolist(),
    (_LIMIT_MARGIN, _DAMPING, _MAX_STEP, _MAX_ERROR, _REST_PULL, REACH, *_TRUNK_RADII),
)
_CROSS: Final = (np.array([1, 2, 0]), np.array([2, 0, 1]))


def cross(a: Array, b: Array) -> Array:
    """a x b over the last axis."""
    i, j = _CROSS
    out: Array = a.take(i, -1) * b.take(j, -1) - a.take(j, -1) * b.take(i, -1)
    return out


@dataclass(frozen=True)
class ArmPose:
    """Where the joints of both arms are, in the torso frame."""

    origin: Array  # (B, 2, 7, 3) joint origins, m
    axis: Array  # (B, 2, 7, 3) joint axes
    rotation: Array  # (B, 2, 7, 3, 3) link frames
    palm: Array  # (B, 2, 3) m


def forward(joint_position: Array) -> ArmPose:
    """Arm joints (B, 2, 7) rad -> poses.

    Chains homogeneous transforms T_i = T_{i-1} (H0 + sin q H1 + (1 - cos q) H2), 4 x 4.
    """
    batch = len(joint_position)
    s, c = np.sin(joint_position), 1.0 - np.cos(joint_position)
    chain = _H0 + s[..., None, None] * _H1 + c[..., None, None] * _H2
    for i in range(1, 7):
        chain[:, :, i] = chain[:, :, i - 1] @ chain[:, :, i]
    axis = np.take(chain.reshape(batch, _H0.size), _AXIS_ENTRIES, axis=1)
    palm = chain[:, :, 6, :3, 3] + rotate(chain[:, :, 6, :3, :3], PALM_OFFSET)
    return ArmPose(chain[..., :3, 3], axis, chain[..., :3, :3], palm)


def reachable(target: Array) -> Array:
    """Nearest palm targets (B, 2, 3), torso frame, that are outside the trunk and within reach."""
    out = target.copy()
    y = out[..., 1] / _TRUNK_RADII[1]
    out[..., 0] = np.maximum(out[..., 0], _TRUNK_RADII[0] * np.sqrt(np.maximum(1 - y * y, 0.0)))
    arm = out - SHOULDER
    length = np.sqrt(np.sum(arm * arm, axis=-1, keepdims=True))
    return np.asarray(SHOULDER + arm * np.minimum(1.0, REACH / np.maximum(length, 1e-6)))


def ik_step(joint_position: Array, target: Array) -> Array:
    """One step of damped least squares towards palm targets.

    dq = W J^T (J W J^T + lambda^2)^-1 (e - J n) + n, where n pulls towards REST and the
    error e is shortened; clipped per joint and to the joint limits.

    Args:
        joint_position: (B, 2, 7) rad.
        target: (B, 2, 3) m, torso frame.
    """
    pose = forward(joint_position)
    jac = cross(pose.axis, pose.palm[:, :, None] - pose.origin)  # (B, 2, 7, 3)
    pull = _REST_PULL * (REST - joint_position)
    error = _shortened(target - pose.palm) - np.sum(jac * pull[..., None], axis=2)
    weighted = jac * _SHARE[:, None]
    normal = np.swapaxes(weighted, -1, -2) @ jac + _DAMPING**2 * np.eye(3)
    solved = _solve_symmetric(normal, error)
    step = np.sum(weighted * solved[:, :, None], axis=-1) + pull
    step = np.minimum(np.maximum(step, -_MAX_STEP), _MAX_STEP)
    return np.asarray(np.minimum(np.maximum(joint_position + step, _LIMIT_LOW), _LIMIT_HIGH))


def _shortened(vector: Array) -> Array:
    """Vectors (..., 3) cut to a length of at most ``_MAX_ERROR``."""
    length = np.sqrt(np.sum(vector * vector, axis=-1, keepdims=True))
    return np.asarray(vector * np.minimum(1.0, _MAX_ERROR / np.maximum(length, 1e-9)))


def _solve_symmetric(matrix: Array, vector: Array) -> Array:
    """Solve (..., 3, 3) positive definite systems by Cramer's rule."""
    r0, r1, r2 = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    c0, c1, c2 = cross(r1, r2), cross(r2, r0), cross(r0, r1)
    det = np.sum(r0 * c0, axis=-1, keepdims=True)
    combined: Array = (c0 * vector[..., 0:1] + c1 * vector[..., 1:2] + c2 * vector[..., 2:3]) / det
    return combined


def link_coms(pose: ArmPose) -> Array:
    """Centres of mass of the arms' links, torso frame: (B, 2, 7, 3) m."""
    return np.asarray(pose.origin + rotate(pose.rotation, _COM))


def first_moment(com: Array) -> Array:
    """Sum of mass times position over each joint's link and all beyond, (B, 2, 7, 3) kg m."""
    moment = com * MASS[..., None]
    return np.asarray(np.cumsum(moment[:, :, ::-1], axis=2)[:, :, ::-1])


def holding_torque(pose: ArmPose, moment: Array, gravity: Array) -> Array:
    """Joint torques (B, 2, 7) that carry the arms' weight.

    Args:
        pose: of the arms.
        moment: its ``first_moment``.
        gravity: (B, 3) gravitational acceleration in the torso frame, m/s^2.
    """
    lever = moment - _TAIL_MASS[..., None] * pose.origin
    return np.asarray(-np.sum(pose.axis * cross(lever, gravity[:, None, None]), axis=-1))


DT: Final = 1.0 / CONTROLLER_HZ
_SERVO_KP: Final = STIFFNESS[ARMS].reshape(2, 7)
_SERVO_KD: Final = DAMPING[ARMS].reshape(2, 7)
_GRAVITY: Final = np.array([0.0, 0.0, -9.81])
TORSO_ORIGIN: Final = JOINT_OFFSET[13]  # (3,) m, pelvis frame: roll and pitch axes of the waist
_REST_COM: Final = link_coms(forward(REST[None]))
_REST_MOMENT: Final = first_moment(_REST_COM)[0, :, 0].sum(axis=0)  # (3,) kg m


@dataclass(frozen=True)
class ReachConfig:
    """Speeds of the arms; part of the controller's identity."""

    speed: float = 8.0
    """rad/s, of each arm joint's reference."""
    acceleration: float = 100.0
    """rad/s^2, of each arm joint's reference; 25 N m give about 125 to a hanging arm."""
    bandwidth: float = 8.0
    """1/s: reference speed per rad to the goal. At 14, random walks of the hands topple robots."""
    lead: float = 1.0
    """Share of the servo's velocity lag (kd/kp) that is fed forward."""
    frequency: float = bounded(0.0, least=0, most=25)
    """rad/s: each reference follows its goal like a critically damped spring of this natural
    frequency. 0: first-order, with ``bandwidth``."""

    def __repr__(self) -> str:
        """All options, but frequency only if it is used: controller identities depend on this."""
        shown = [f.name for f in fields(self) if f.name != "frequency" or self.frequency > 0]
        values = ", ".join(f"{name}={getattr(self, name)!r}" for name in shown)
        return f"{type(self).__qualname__}({values})"


@dataclass
class ArmReference:
    """Joint references of the arms and their momentum; leading axis B."""

    goal: Array  # (B, 2, 7) IK solution, rad
    joints: Array  # (B, 2, 7) smoothed reference, rad
    rate: Array  # (B, 2, 7) rad/s
    com: Array = field(init=False)  # (B, 2, 7, 3) m, link centres of mass, torso frame
    moment: Array = field(init=False)  # (B, 3) kg m, relative to REST, torso frame
    linear: Array = field(init=False)  # (B, 3) kg m/s, torso frame
    angular: Array = field(init=False)  # (B, 3) N m s about the torso's origin

    def __post_init__(self) -> None:
        self.com = link_coms(forward(self.joints))
        self.moment = np.sum(first_moment(self.com)[:, :, 0], axis=1) - _REST_MOMENT
        self.linear, self.angular = np.zeros((2, len(self.joints), 3))

    @classmethod
    def at_rest(cls, joint_position: Array) -> ArmReference:
        """At measured arm joints (B, 14), rad."""
        q = np.clip(joint_position.reshape(-1, 2, 7), LOWER, UPPER)
        return cls(q.copy(), q.copy(), np.zeros_like(q))


def track_hands(reference: ArmReference, hands: Array, torso: Array, config: ReachConfig) -> Array:
    """Advance the references by one tick and return servo targets (B, 14), rad.

    Gravity torque and velocity lag, divided by the stiffness, are added to the references.

    Args:
        reference: advanced in place.
        hands: (B, 2, 3) palm targets relative to the torso's origin, heading frame, m.
        torso: (B, 3, 3) rotation from the torso to the heading frame.
        config: speeds.
    """
    inverse = np.swapaxes(torso, 1, 2)
    goal = reachable(rotate(inverse[:, None], hands))
    reference.goal = ik_step(reference.goal, goal)
    _smooth(reference, config)
    pose = forward(reference.joints)
    com = link_coms(pose)
    tail = first_moment(com)
    _track_momentum(reference, com, np.sum(tail[:, :, 0], axis=1))
    torque = holding_torque(pose, tail, rotate(inverse, _GRAVITY))
    target = reference.joints + (torque + config.lead * _SERVO_KD * reference.rate) / _SERVO_KP
    return np.asarray(target.reshape(len(target), -1))


def nearest_reachable(hands: Array, heading: Array, torso: Array) -> Array:
    """`reachable` of targets in the heading frame.

    Args:
        hands: (B, 2, 3) targets, pelvis heading frame, m.
        heading: (B, 3, 3) rotation from the pelvis to the heading frame.
        torso: (B, 3, 3) rotation from the torso to the heading frame.

    Returns:
        (B, 2, 3) in the heading frame, m.
    """
    origin = rotate(heading, TORSO_ORIGIN)[:, None]
    inverse = np.swapaxes(torso, 1, 2)
    goal = reachable(rotate(inverse[:, None], hands - origin))
    return np.asarray(rotate(torso[:, None], goal) + origin)


def _smooth(m: ArmReference, config: ReachConfig) -> None:
    """References of bounded speed and acceleration that do not overshoot, in place."""
    w = config.frequency
    if w > 0:
        wanted = m.rate + DT * (w * w * (m.goal - m.joints) - 2 * w * m.rate)
    else:
        wanted = config.bandwidth * (m.goal - m.joints)
    wanted = np.minimum(np.maximum(wanted, -config.speed), config.speed)
    limit = config.acceleration * DT
    m.rate = m.rate + np.minimum(np.maximum(wanted - m.rate, -limit), limit)
    ahead = m.joints + DT * m.rate
    m.joints = np.minimum(np.maximum(ahead, LOWER), UPPER)


def _track_momentum(m: ArmReference, com: Array, first: Array) -> None:
    """First moment, and momenta from the motion of the links' centres of mass."""
    momentum = MASS[..., None] * (com - m.com) / DT
    m.linear = np.sum(momentum, axis=(1, 2))
    m.angular = np.sum(cross(com, momentum), axis=(1, 2))
    m.moment, m.com = first - _REST_MOMENT, com
