"""Hands follow their targets: inverse kinematics, smooth joint references, servo targets."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np

from egovcp.bounds import bounded
from egovcp.robot import arms
from egovcp.robot.g1 import ARMS, DAMPING, STIFFNESS
from egovcp.robot.kinematics import LINK_OFFSET, Array, rotate
from egovcp.spec import CONTROLLER_HZ

DT: Final = 1.0 / CONTROLLER_HZ
_KP: Final = STIFFNESS[ARMS].reshape(2, 7)
_KD: Final = DAMPING[ARMS].reshape(2, 7)
_GRAVITY: Final = np.array([0.0, 0.0, -9.81])
TORSO_ORIGIN: Final = LINK_OFFSET[13]  # (3,) m, pelvis frame: roll and pitch axes of the waist
_REST_COM: Final = arms.link_coms(arms.forward(arms.REST[None]))
_REST_MOMENT: Final = arms.first_moment(_REST_COM)[0, :, 0].sum(axis=0)  # (3,) kg m


@dataclass(frozen=True)
class ReachConfig:
    """How briskly the arms move; part of the controller's identity."""

    speed: float = 8.0
    """rad/s, of each arm joint's reference."""
    acceleration: float = 100.0
    """rad/s^2, of each arm joint's reference; 25 N m give about 125 to a hanging arm."""
    bandwidth: float = 8.0
    """1/s: reference speed per rad of remaining way. At 14 the momentum of arms that follow
    the random walk topples a third of the robots within 10 s; at 8 none, and no hand is later."""
    lead: float = 1.0
    """Share of the servo's velocity lag (kd/kp) that is fed forward."""
    frequency: float = bounded(0.0, least=0, most=25)
    """rad/s: each reference follows its goal like a critically damped spring of this natural
    frequency; bandwidth is not used then. 0: the first-order law of bandwidth."""

    def __repr__(self) -> str:
        """All options; frequency only if it is used, so that identities without it hold."""
        shown = [f.name for f in fields(self) if f.name != "frequency" or self.frequency > 0]
        values = ", ".join(f"{name}={getattr(self, name)!r}" for name in shown)
        return f"{type(self).__qualname__}({values})"


@dataclass
class Reach:
    """Memory of the arms; leading axis B."""

    goal: Array  # (B, 2, 7) IK solution, rad
    joints: Array  # (B, 2, 7) smoothed reference, rad
    rate: Array  # (B, 2, 7) rad/s
    com: Array = field(init=False)  # (B, 2, 7, 3) m, link centres of mass, torso frame
    moment: Array = field(init=False)  # (B, 3) kg m, off the rest place, torso frame
    linear: Array = field(init=False)  # (B, 3) kg m/s, torso frame
    angular: Array = field(init=False)  # (B, 3) N m s about the torso's origin

    def __post_init__(self) -> None:
        self.com = arms.link_coms(arms.forward(self.joints))
        self.moment = np.sum(arms.first_moment(self.com)[:, :, 0], axis=1) - _REST_MOMENT
        self.linear, self.angular = np.zeros((2, len(self.joints), 3))


def start(joint_position: Array) -> Reach:
    """Memory at rest at measured arm joints (B, 14)."""
    q = np.clip(joint_position.reshape(-1, 2, 7), arms.LOWER, arms.UPPER)
    return Reach(q.copy(), q.copy(), np.zeros_like(q))


def follow(memory: Reach, hands: Array, torso: Array, config: ReachConfig) -> Array:
    """Advance the references by one tick and return servo targets (B, 14), rad.

    Args:
        memory: advanced in place.
        hands: (B, 2, 3) palm targets relative to the torso's origin, heading frame, m.
        torso: (B, 3, 3) rotation from the torso to the heading frame.
        config: speeds.

    The targets add gravity torque and velocity lag, both divided by the stiffness.
    """
    inverse = np.swapaxes(torso, 1, 2)
    goal = arms.reachable(rotate(inverse[:, None], hands))
    memory.goal = arms.improve(memory.goal, goal)
    _smooth(memory, config)
    pose = arms.forward(memory.joints)
    com = arms.link_coms(pose)
    tail = arms.first_moment(com)
    _track_momentum(memory, com, np.sum(tail[:, :, 0], axis=1))
    torque = arms.holding_torque(pose, tail, rotate(inverse, _GRAVITY))
    target = memory.joints + (torque + config.lead * _KD * memory.rate) / _KP
    return np.asarray(target.reshape(len(target), -1))


def nearest_reachable(hands: Array, heading: Array, torso: Array) -> Array:
    """Where the palms can go for targets that may lie beyond reach or inside the trunk.

    Args:
        hands: (B, 2, 3) targets, pelvis heading frame, m.
        heading: (B, 3, 3) rotation from the pelvis to the heading frame.
        torso: (B, 3, 3) rotation from the torso to the heading frame.

    Returns:
        (B, 2, 3) in the heading frame, m.
    """
    origin = rotate(heading, TORSO_ORIGIN)[:, None]
    inverse = np.swapaxes(torso, 1, 2)
    goal = arms.reachable(rotate(inverse[:, None], hands - origin))
    return np.asarray(rotate(torso[:, None], goal) + origin)


def _smooth(m: Reach, config: ReachConfig) -> None:
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
    m.joints = np.minimum(np.maximum(ahead, arms.LOWER), arms.UPPER)


def _track_momentum(m: Reach, com: Array, first: Array) -> None:
    """First moment, and momenta from the motion of the links' centres of mass."""
    momentum = arms.MASS[..., None] * (com - m.com) / DT
    m.linear = np.sum(momentum, axis=(1, 2))
    m.angular = np.sum(arms.cross(com, momentum), axis=(1, 2))
    m.moment, m.com = first - _REST_MOMENT, com
