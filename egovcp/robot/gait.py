"""The clock of walking and the leg motion that goes with it, on which a policy improves.

The phase phi runs from 0 to 2 pi in one stride: the left foot swings while sin phi > 0, the
right one while sin phi < 0. ``amount`` says how much of the gait is blended into standing.
The robot steps when a velocity is commanded, and when it is about to fall over.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.kinematics import Array
from egovcp.robot.reach import DT
from egovcp.spec import STATE_SLICES

_THIGH: Final = 0.30  # m, and the shank; as long as the pose of a height needs them to be
_HIP_PITCH, _HIP_ROLL, _KNEE, _ANKLE_PITCH, _ANKLE_ROLL = 0, 1, 3, 4, 5
_LEG_JOINTS: Final = 6


@dataclass(frozen=True)
class GaitConfig:
    """Shape and timing of the steps; part of the controller's identity."""

    period: float = 0.8
    """s per stride, that is two steps."""
    lift: float = 0.07
    """m by which the swinging leg is shortened."""
    sway: float = 0.04
    """rad of hip roll that takes the pelvis over the standing foot."""
    least_speed: float = 0.05
    """m/s (a third of it per rad/s of turning) of commanded velocity that makes it step."""
    tipping: float = 0.2
    """rad of tilt off the reference, plus 0.15 s times the tilting rate, that makes it step."""
    rise: float = 0.1
    """s in which the gait comes in."""
    fade: float = 0.2
    """s in which it goes out."""
    linger: float = 0.8
    """s for which it steps on, so that the feet come together."""


@dataclass
class Gait:
    """Memory of the clock; leading axis B."""

    phase: Array  # (B,) rad
    amount: Array  # (B,) 0 standing .. 1 walking
    left: Array  # (B,) s until it may stand


def start(batch: int) -> Gait:
    """Standing."""
    return Gait(np.zeros(batch), np.zeros(batch), np.zeros(batch))


def advance(m: Gait, state: Array, tilt: Array, config: GaitConfig) -> NDArray[np.bool_]:
    """One tick of the clock, in place.

    Args:
        state: (B, 74) observations.
        tilt: (B, 2) rad, roll and pitch off the reference.

    Returns:
        (B,) which robots have just come to stand again.
    """
    velocity = state[:, STATE_SLICES["command_velocity"]]
    rate = state[:, STATE_SLICES["angular_velocity"]][:, :2]
    speed = np.sqrt(np.sum(velocity[:, :2] ** 2, axis=1)) + np.abs(velocity[:, 2]) / 3
    leaning = np.sqrt(np.sum((tilt + 0.15 * rate) ** 2, axis=1))
    wanted = (speed > config.least_speed) | (leaning > config.tipping)
    standing = m.amount <= 0
    leftwards = velocity[:, 1] + 0.3 * velocity[:, 2] - 0.3 * rate[:, 0] >= 0
    begins = np.where(leftwards, 0.0, np.pi)
    m.phase = np.where(standing, begins, (m.phase + 2 * np.pi * DT / config.period) % (2 * np.pi))
    m.left = np.where(wanted, config.linger, np.maximum(m.left - DT, 0.0))
    change = np.where(m.left > 0, DT / config.rise, -DT / config.fade)
    m.amount = np.clip(m.amount + change, 0.0, 1.0)
    stands: NDArray[np.bool_] = ~standing & (m.amount <= 0)
    return stands


def leg_motion(m: Gait, joints: Array, velocity: Array, config: GaitConfig) -> Array:
    """(B, 15) rad to add to a standing pose, feet kept level.

    Args:
        m: the clock.
        joints: (B, 15) standing pose of legs and waist.
        velocity: (B, 3) commanded velocity.
    """
    out = np.zeros_like(joints)
    sway = config.sway * np.sin(m.phase)
    for first, swing in ((0, np.sin(m.phase)), (_LEG_JOINTS, -np.sin(m.phase))):
        forward = velocity[:, 0] * config.period / 4 * -np.cos(m.phase)
        forward = forward if first == 0 else -forward
        knee = joints[:, first + _KNEE]
        length = 2 * _THIGH * np.cos(knee / 2)
        shorter = length - config.lift * np.maximum(swing, 0.0)
        bend = 2 * np.arccos(np.clip(shorter / (2 * _THIGH), 0.0, 1.0)) - knee
        out[:, first + _HIP_PITCH] = -bend / 2 - forward / length
        out[:, first + _KNEE] = bend
        out[:, first + _ANKLE_PITCH] = -bend / 2 + forward / length
        out[:, first + _HIP_ROLL] = sway
        out[:, first + _ANKLE_ROLL] = -sway
    return np.asarray(m.amount[:, None] * out)
