"""The gait: a clock, footholds by the capture point, and leg motion.

The phase phi runs from 0 to 2 pi in one stride: the left foot swings while sin phi > 0, the
right one while sin phi < 0. ``blend`` is the share of the gait that is blended into standing.
The robot steps if a velocity is commanded, or if it is about to fall.

The swinging foot aims where a linear inverted pendulum of the pelvis's height is captured: at
touchdown its extrapolated centre of mass xi = x + v / omega lies beside the foothold by
a constant offset that keeps the commanded speed and the stance width (Hof, "The 'extrapolated
center of mass' concept suggests a simple control of balance in walking", Human Movement
Science 27, 2008). The stance leg carries the weight (its share of the static torques is fed
forward, as the servos are soft), keeps its angle, and turns the pelvis upright. A policy trained by
PPO (`walking`) adds corrections.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.arms import DT
from egovcp.robot.g1 import STIFFNESS
from egovcp.robot.geometry import Array, heading_rotation, rotate
from egovcp.robot.kinematics import ANKLE_HEIGHT, HALF_STANCE_WIDTH, foot_positions
from egovcp.robot.stance_table import NU, StanceRow
from egovcp.spec import STATE_SLICES

_GRAVITY: Final = 9.81
_THIGH: Final = 0.30  # m, and the shank; as long as the pose of a height needs them to be
_SIDE: Final = np.array([1.0, -1.0])  # left, right
_HIP_PITCH, _HIP_ROLL, _HIP_YAW, _KNEE, _ANKLE_PITCH, _ANKLE_ROLL = range(6)
_LEGS: Final = 12
_OVERDRIVEN: Final = np.array([1.0, 1.0, 1.0, 0.5, 0.0, 0.0])
_KP: Final = STIFFNESS[:NU]


@dataclass(frozen=True)
class GaitConfig:
    """Timing, footholds and gains of the steps; part of the controller's identity.

    The numbers were found by CMA-ES.
    """

    step_time: float = 0.31
    """s per step; a stride is two."""
    lift: float = 0.0565
    """m, shortening of the swinging leg."""
    width: float = 0.234
    """m across between the feet that the footholds aim at."""
    capture: tuple[float, float] = (0.826, 1.41)
    """Share of the expected velocity that a foothold captures: along, across."""
    ahead: float = 0.0363
    """m by which footholds lie ahead of that."""
    reach: tuple[float, float, float] = (0.35, 0.06, 0.30)
    """m, bounds of footholds from the pelvis: along either way; across, nearest and farthest."""
    shift: float = 0.168
    """s for which the leg that will swing first pushes the weight to the other one."""
    soften: float = 0.285
    """sin phi over which the weight passes from leg to leg."""
    swing_gain: float = 1.19
    """Extra stiffness of the swinging hip and knee, as a share of the servos' own."""
    carry: float = 1.26
    """Share of the other leg's static torque that a standing leg takes over."""
    hip_moment: float = 15.0
    """N m about the standing hip that hold up the other side of the pelvis."""
    hip_pitch: tuple[float, float] = (1.73, 0.114)
    """Gains of the stance hip's pitch: rad per rad of pelvis pitch, rad per rad/s of its rate."""
    hip_roll: tuple[float, float] = (1.5, 0.194)
    """Gains of the stance hip's roll: rad per rad of pelvis roll, rad per rad/s of its rate."""
    hip_yaw: tuple[float, float] = (0.403, 0.299)
    """Gains of the stance hip's yaw: rad per rad of heading error, rad per rad/s of its rate."""
    ankle_pitch: tuple[float, float, float, float] = (2.09, 0.251, 3.25, 0.349)
    """Gains of the stance ankle's pitch: rad per rad of pelvis pitch, per rad/s of its rate, per m
    of the pelvis ahead of the foot, per m/s of error of the forward velocity."""
    ankle_roll: tuple[float, float, float] = (1.17, 0.141, -0.466)
    """Gains of the stance ankle's roll: rad per rad of pelvis roll, per rad/s of its rate, per m/s
    of error of the sideways velocity."""
    knee: float = 5.8
    """Gain of the stance knee: rad of bend per m of the pelvis above its commanded height."""
    velocity_filter: float = 0.321
    """Weight of each tick's leg odometry in the estimated velocity."""
    least_speed: float = 0.05
    """It steps above this commanded speed plus a third of the commanded yaw rate (rad/s), m/s."""
    tipping: tuple[float, float] = (0.35, 0.6)
    """rad of tilt off the reference, plus 0.15 s times the tilting rate, that makes a standing
    robot step, and a stepping one step on."""
    support: tuple[float, float] = (0.105, 0.15)
    """m along and across, half axes of an ellipse about the middle of the feet; a robot that
    stands steps once its extrapolated centre of mass leaves it."""
    rise: float = 0.1
    """s in which the gait comes in."""
    fade: float = 0.2
    """s in which it goes out."""
    linger: float = 0.8
    """s for which it steps on, so that the feet come together."""


@dataclass
class Gait:
    """State of the clock and of the legs' odometry; leading axis B."""

    phase: Array  # (B,) rad
    blend: Array  # (B,) 0 standing .. 1 walking
    stepping_time_left: Array  # (B,) s until it may stand
    shifting: Array  # (B,) s until the first foot may leave the floor
    feet: Array  # (B, 2, 3) m, from the pelvis in the heading frame, at the last tick
    velocity: Array  # (B, 2) m/s, estimated, in the heading frame
    heading_error: Array  # (B,) rad off the commanded turn since it began to step, bounded


def start(joint_position: Array, gravity: Array) -> Gait:
    """Standing robots as measured: joints (B, 29) rad, gravity (B, 3) in the pelvis frame."""
    n = len(joint_position)
    return Gait(
        phase=np.zeros(n),
        blend=np.zeros(n),
        stepping_time_left=np.zeros(n),
        shifting=np.zeros(n),
        feet=_feet(joint_position, gravity),
        velocity=np.zeros((n, 2)),
        heading_error=np.zeros(n),
    )


def _feet(joint_position: Array, gravity: Array) -> Array:
    return rotate(heading_rotation(gravity)[:, None], foot_positions(joint_position))


def sense(gait: Gait, state: Array, config: GaitConfig) -> None:
    """Odometry: velocity by the feet that carry, each as much as it does; in place."""
    feet = _feet(
        state[:, STATE_SLICES["joint_position"]], state[:, STATE_SLICES["projected_gravity"]]
    )
    load = _load(gait, config)
    moved = (gait.feet - feet)[..., :2] / DT
    velocity = moved[:, 0] * load[:, :1] + moved[:, 1] * load[:, 1:]
    gait.velocity = gait.velocity + config.velocity_filter * (velocity - gait.velocity)
    gait.feet = feet


def advance(
    gait: Gait, row: StanceRow, height: Array, tilt: Array, state: Array, config: GaitConfig
) -> NDArray[np.bool_]:
    """One tick of the clock, in place, after `sense`.

    Args:
        gait: state.
        row: standing pose of the height.
        height: (B,) m of the pelvis.
        tilt: (B, 2) rad, roll and pitch off the reference.
        state: (B, 74) observations.
        config: timing.

    Returns:
        (B,) which robots have just come to stand again.
    """
    command = state[:, STATE_SLICES["command_velocity"]]
    rate = state[:, STATE_SLICES["angular_velocity"]]
    speed = np.sqrt((command[:, :2] ** 2).sum(axis=1)) + np.abs(command[:, 2]) / 3
    standing = gait.blend <= 0
    tipping = np.where(standing, *config.tipping)
    leaning = np.sqrt(((tilt + 0.15 * rate[:, :2]) ** 2).sum(axis=1)) > tipping
    leaning |= standing & _leaves_support(gait, row, height, config)
    wanted = (speed > config.least_speed) | leaning
    before = gait.phase
    _tick(gait, standing, leaning, command, rate, config)
    time_left = np.maximum(gait.stepping_time_left - DT, 0.0)
    gait.stepping_time_left = np.where(wanted, config.linger, time_left)
    landed = (before // np.pi) != (gait.phase // np.pi)
    stops = (gait.stepping_time_left <= 0) & ((gait.blend < 1.0) | landed)
    change = np.where(stops, -DT / config.fade, DT / config.rise)
    gait.blend = _bounded(gait.blend + change, 0.0, 1.0)
    gait.blend = np.where(standing & ~wanted, 0.0, gait.blend)
    off = _bounded(gait.heading_error + DT * (rate[:, 2] - command[:, 2]), -0.5, 0.5)
    gait.heading_error = np.where(gait.blend > 0, off, 0.0)
    stands: NDArray[np.bool_] = ~standing & (gait.blend <= 0)
    return stands


def _leaves_support(
    gait: Gait, row: StanceRow, height: Array, config: GaitConfig
) -> NDArray[np.bool_]:
    """(B,) whether x + v / omega is outside the ellipse about the feet that stand."""
    place = -0.5 * (gait.feet[:, 0, :2] + gait.feet[:, 1, :2]) - row.pelvis[:, :2]
    extrapolated = place + gait.velocity / _omega(height)[:, None]
    out: NDArray[np.bool_] = ((extrapolated / config.support) ** 2).sum(axis=1) > 1.0
    return out


def _omega(height: Array) -> Array:
    """(B,) 1/s, of the inverted pendulum."""
    return np.asarray(np.sqrt(_GRAVITY / np.maximum(height - ANKLE_HEIGHT, 0.3)))


def _tick(
    gait: Gait,
    standing: NDArray[np.bool_],
    leaning: NDArray[np.bool_],
    command: Array,
    rate: Array,
    config: GaitConfig,
) -> None:
    """Advance the clock; in a standing robot, set it to the begin of the first step.

    A commanded step first shifts the weight to the other leg; a robot that tips over swings the leg
    of the side to which it falls at once.
    """
    leftwards = command[:, 1] + 0.3 * command[:, 2] - 0.3 * rate[:, 0] >= 0
    first = np.where(leftwards, 0.0, np.pi)
    turn = np.pi * DT / config.step_time
    shift = np.where(leaning, 0.0, config.shift)
    begins = (first - np.pi * shift / config.step_time) % (2 * np.pi)
    gait.phase = np.where(standing, begins, (gait.phase + turn) % (2 * np.pi))
    gait.shifting = np.where(standing, shift, np.maximum(gait.shifting - DT, 0.0))


def _load(gait: Gait, config: GaitConfig) -> Array:
    """(B, 2) share of the weight on the left and on the right foot."""
    swing = _bounded(np.sin(gait.phase) / config.soften, -1.0, 1.0) * (gait.blend > 0)
    out = np.empty((len(swing), 2))
    out[:, 0], out[:, 1] = 0.5 - 0.5 * swing, 0.5 + 0.5 * swing
    return out


def _bounded(x: Array, low: float, high: float) -> Array:
    """As np.clip, but faster for small arrays."""
    return np.asarray(np.minimum(np.maximum(x, low), high))


def foothold(
    gait: Gait, row: StanceRow, height: Array, command: Array, config: GaitConfig
) -> Array:
    """(B, 2) m, where the swinging foot should land, from the pelvis in the heading frame.

    Args:
        gait: the clock, the feet and the velocity.
        row: the standing pose.
        height: (B,) m of the pelvis above the floor.
        command: (B, 3) velocity, m/s and rad/s.
        config: gains.
    """
    side, stance = _swinging(gait)
    foot = gait.feet[np.arange(len(side)), stance, :2]
    offset = row.pelvis[:, 0]  # of the balanced pelvis from the ankles
    omega = _omega(height)
    time = config.step_time
    rest = (1.0 - gait.phase % np.pi / np.pi) * time
    cosh, sinh = np.cosh(omega * rest), np.sinh(omega * rest)
    grown = np.exp(omega * time)
    velocity = gait.velocity * cosh[:, None]
    velocity[:, 0] += (-foot[:, 0] - offset) * omega * sinh
    velocity[:, 1] += -foot[:, 1] * omega * sinh
    caught = velocity / omega[:, None] * config.capture
    behind = command[:, :2] * time / (grown - 1.0)[:, None]
    x = caught[:, 0] - behind[:, 0] - offset + config.ahead
    y = caught[:, 1] - behind[:, 1] + side * config.width / (1.0 + grown)
    along, near, far = config.reach
    out = np.empty((len(x), 2))
    out[:, 0] = _bounded(x, -along, along)
    out[:, 1] = side * _bounded(side * y, near, far)
    return out


def _swinging(gait: Gait) -> tuple[Array, NDArray[np.intp]]:
    """(B,) the side (1 left, -1 right) that swings, and (B,) the index of the foot that stands."""
    left = np.sin(gait.phase) >= 0
    return np.where(left, 1.0, -1.0), np.where(left, 1, 0)


def leg_motion(
    gait: Gait, row: StanceRow, height: Array, tilt: Array, state: Array, config: GaitConfig
) -> Array:
    """(B, 15) rad that full gait adds to the targets of standing at that height.

    Args:
        gait: state, advanced.
        row: standing pose and torques of the height.
        height: (B,) m of the pelvis, as it should be by now.
        tilt: (B, 2) rad, roll and pitch off the reference.
        state: (B, 74) observations.
        config: gains.
    """
    n = len(height)
    command = state[:, STATE_SLICES["command_velocity"]]
    rate = state[:, STATE_SLICES["angular_velocity"]]
    measured = state[:, STATE_SLICES["joint_position"]][:, :_LEGS].reshape(n, 2, 6)
    pose, torque = (x[:, :_LEGS].reshape(n, 2, 6).copy() for x in (row.joints, row.torque))
    side, _ = _swinging(gait)
    swings = (side[:, None] == _SIDE)[..., None]  # (B, 2, 1)
    load = _load(gait, config)
    torque *= (1.0 + (2.0 * load - 1.0) * config.carry)[..., None]
    torque[..., _HIP_ROLL] += _SIDE * config.hip_moment * np.maximum(2.0 * load - 1.0, 0.0)
    swing = pose + _swing(gait, pose, row, height, command, tilt, config)
    swing += config.swing_gain * _OVERDRIVEN * (swing - measured)
    stance = pose + _stance(gait, pose, row, height, command, tilt, rate, load, config)
    out = np.zeros((n, NU))
    out[:, :_LEGS] = np.where(swings, swing, stance).reshape(n, _LEGS) - row.joints[:, :_LEGS]
    out[:, :_LEGS] += (torque.reshape(n, _LEGS) - row.torque[:, :_LEGS]) / _KP[:_LEGS]
    return out


def _leg_length(pose: Array) -> Array:
    """(B, 2) m from hip to ankle in a pose (B, 2, 6)."""
    return np.asarray(2 * _THIGH * np.cos(pose[..., _KNEE] / 2))


def _swing(
    gait: Gait,
    pose: Array,
    row: StanceRow,
    height: Array,
    command: Array,
    tilt: Array,
    config: GaitConfig,
) -> Array:
    """(B, 2, 6) what either leg adds to the pose if it swings: shorter, and to its foothold."""
    length = _leg_length(pose)
    leaves = (gait.shifting <= 0)[:, None]
    progress = gait.phase[:, None] % np.pi / np.pi
    shorter = length - config.lift * np.sin(np.pi * progress) * leaves
    bend = 2 * np.arccos(_bounded(shorter / (2 * _THIGH), 0.0, 1.0)) - pose[..., _KNEE]
    goal = foothold(gait, row, height, command, config)
    done = progress**2 * (3.0 - 2.0 * progress) * leaves
    along = done * (goal[:, :1] + row.pelvis[:, :1]) / length
    across = done * (goal[:, 1:] - _SIDE * HALF_STANCE_WIDTH) / length
    out = np.zeros_like(pose)
    out[..., _HIP_PITCH] = -bend / 2 - along - tilt[:, 1:]
    out[..., _KNEE] = bend
    out[..., _ANKLE_PITCH] = -bend / 2 + along
    out[..., _HIP_ROLL] = across - tilt[:, :1]
    out[..., _ANKLE_ROLL] = -across
    return out


def _stance(
    gait: Gait,
    pose: Array,
    row: StanceRow,
    height: Array,
    command: Array,
    tilt: Array,
    rate: Array,
    load: Array,
    config: GaitConfig,
) -> Array:
    """(B, 2, 6) what either leg adds to the pose if it stands: balance about where it is."""
    length = _leg_length(pose)
    ahead = 2 * DT * gait.velocity  # targets act about two ticks after what was measured
    along = (gait.feet[..., 0] + row.pelvis[:, :1] - ahead[:, :1]) / length
    across = (gait.feet[..., 1] - _SIDE * HALF_STANCE_WIDTH - ahead[:, 1:]) / length
    over = -gait.feet[..., 0] - row.pelvis[:, :1]  # m, the pelvis ahead of either foot
    fast = gait.velocity - command[:, :2]
    roll, pitch = tilt.T
    bend = config.knee * (-gait.feet[..., 2] - (height[:, None] - ANKLE_HEIGHT))
    hip, tip, ankle, edge = (
        config.hip_pitch,
        config.hip_roll,
        config.ankle_pitch,
        config.ankle_roll,
    )
    out = np.zeros_like(pose)
    out[..., _HIP_PITCH] = -along - bend / 2 + (hip[0] * pitch + hip[1] * rate[:, 1])[:, None]
    out[..., _KNEE] = bend
    out[..., _ANKLE_PITCH] = along - bend / 2 + load * (ankle[2] * over + ankle[3] * fast[:, :1])
    out[..., _ANKLE_PITCH] += (ankle[0] * pitch + ankle[1] * rate[:, 1])[:, None]
    out[..., _HIP_ROLL] = across + (tip[0] * roll + tip[1] * rate[:, 0])[:, None]
    out[..., _ANKLE_ROLL] = -across + load * edge[2] * fast[:, 1:]
    out[..., _ANKLE_ROLL] += (edge[0] * roll + edge[1] * rate[:, 0])[:, None]
    yaw, turning = gait.heading_error, rate[:, 2] - command[:, 2]
    out[..., _HIP_YAW] = (config.hip_yaw[0] * yaw + config.hip_yaw[1] * turning)[:, None]
    return out
