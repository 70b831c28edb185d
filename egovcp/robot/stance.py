"""The stance controller: stands, squats and reaches on two planted feet from proprioception.

Legs and waist follow references of the pelvis height, corrected by a gain-scheduled LQR with a
Kalman filter (numbers from `stance_design`); arms follow inverse kinematics with gravity
feed-forward (`arms`). The velocity part of the command is ignored.

Deviations are relative to the reference that the robot should have reached: targets act one tick
after they are sent, so that is the reference sent two ticks ago.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.arms import DT, TORSO_ORIGIN, ArmReference, ReachConfig, cross, track_hands
from egovcp.robot.arms import IDENTITY as ARM_IDENTITY
from egovcp.robot.g1 import ARMS, DAMPING, EFFORT_LIMIT, STIFFNESS
from egovcp.robot.geometry import Array, heading_rotation, rotate
from egovcp.robot.kinematics import (
    ANKLE_HEIGHT,
    TARGET_HIGH,
    TARGET_LOW,
    foot_positions,
    torso_rotation,
)
from egovcp.robot.stance_table import NF, NR, NU, NX, NZ, StanceRow, stance_table
from egovcp.spec import STATE_DIM, STATE_SLICES

LOWER_BODY: Final = slice(0, NU)
_KP: Final = STIFFNESS[LOWER_BODY]
_KD: Final = DAMPING[LOWER_BODY]
_LIMIT: Final = EFFORT_LIMIT[LOWER_BODY] / _KP

# Columns of a reference row: what the sensors should read, and the expected recoil.
_JOINTS: Final = slice(0, 15)  # then pelvis x, y, height, pitch
_JOINT_RATES: Final = slice(19, 34)
_PELVIS_RATES: Final = slice(34, 38)
_RECOIL: Final = slice(38, 47)
_POSITIONS: Final = slice(0, 19)
_WIDTH: Final = 47


@dataclass(frozen=True)
class BalanceConfig:
    """Limits and speeds of the stance; part of the controller's identity."""

    height_frequency: float = 8.0
    """rad/s: the height follows its command like a critically damped spring."""
    height_speed: float = 0.25
    """m/s."""
    correction_limit: float = 0.8
    """Bound of each balance correction, as a share of effort limit / stiffness."""
    force_limit: float = 20.0
    """Bound of each estimated constant force, N; in N m for moments, half of it."""
    fade_from: float = 0.35
    """rad of tilt away from the reference at which corrections begin to fade."""
    fade_to: float = 0.8
    """rad of tilt at which they are gone."""


@dataclass
class BalanceState:
    """Filter, correction and references of the stance law; leading axis B."""

    prediction: Array  # (B, 29) filter state predicted for the next tick, relative to the reference
    correction: Array  # (B, 15) rad, sent last and acting now
    height: Array  # (B,) reference, m
    height_rate: Array  # (B,) m/s
    sent: Array  # (B, 47) reference of the last tick
    reached: Array  # (B, 47) reference of the tick before

    @property
    def pitch(self) -> Array:
        """(B,) pelvis pitch of the reference reached, rad."""
        return np.asarray(self.reached[:, 18])

    @property
    def gravity(self) -> Array:
        """(B, 3) estimated unit gravity, pelvis frame: the reference turned by the estimate."""
        reference = _gravity(self.pitch)
        return np.asarray(reference + cross(reference, self.prediction[:, 3:6]))

    @classmethod
    def standing(cls, height: Array, arms: ArmReference) -> BalanceState:
        """Robots at rest at pelvis heights (B,), m, with these arms."""
        batch, row = len(height), stance_table().at(height)
        moment = _turn(arms.moment, row.pelvis[:, 2])[:, :2]
        reference = np.zeros((batch, _WIDTH))
        reference[:, _POSITIONS] = _positions(row, height, moment)
        return cls(
            prediction=np.zeros((batch, NF)),
            correction=np.zeros((batch, NU)),
            height=height.copy(),
            height_rate=np.zeros(batch),
            sent=reference,
            reached=reference.copy(),
        )


def start_standing(state: Array) -> tuple[BalanceState, ArmReference]:
    """Robots at rest in the measured postures, (B, 74) observations."""
    q = state[:, STATE_SLICES["joint_position"]]
    height = pelvis_height(q, state[:, STATE_SLICES["projected_gravity"]])
    arms = ArmReference.at_rest(q[:, ARMS])
    return BalanceState.standing(stance_table().clamp(height), arms), arms


def reach(
    arms: ArmReference, state: Array, gravity: Array, waist: Array, config: ReachConfig
) -> Array:
    """Advance the arms by one tick and return their targets (B, 14), rad.

    Args:
        arms: advanced in place.
        state: (B, 74) observations.
        gravity: (B, 3) unit vector, pelvis frame.
        waist: (B, 3) yaw, roll and pitch of the waist, rad.
        config: speeds.
    """
    heading = heading_rotation(gravity)
    hands = state[:, STATE_SLICES["command_hands"]].reshape(-1, 2, 3)
    relative = hands - rotate(heading, TORSO_ORIGIN)[:, None]
    return track_hands(arms, relative, torso_rotation(heading, waist), config)


def follow_height(m: BalanceState, command: Array, config: BalanceConfig) -> None:
    """Critically damped second-order reference with bounded speed, in place."""
    w = config.height_frequency
    rate = m.height_rate + DT * (w * w * (command - m.height) - 2 * w * m.height_rate)
    m.height_rate = np.minimum(np.maximum(rate, -config.height_speed), config.height_speed)
    m.height = m.height + DT * m.height_rate


def balance(
    m: BalanceState, state: Array, row: StanceRow, arms: ArmReference, config: BalanceConfig
) -> Array:
    """Advance the law by one tick and return leg and waist targets (B, 15), rad."""
    pitch = row.pelvis[:, 2]
    moment = _turn(arms.moment, pitch)[:, :2]
    reference = _reference(m, row, moment, _momentum(arms, pitch))
    vector = np.concatenate([m.prediction, _deviation(m, state), m.correction], axis=1)
    out = _apply(row.compensator, vector)
    recoil = m.reached[:, _RECOIL] - m.sent[:, _RECOIL]
    m.prediction = out[:, NU:]
    m.prediction[:, NZ:NX] += recoil
    m.prediction[:, :NZ] += 0.5 * DT * recoil
    _bound_forces(m.prediction, config)
    torque = row.torque + _apply(row.torque_per_moment, moment)
    feed_forward = (torque + _KD * reference[:, _JOINT_RATES]) / _KP
    base = reference[:, _JOINTS] + feed_forward
    m.correction = _bounded(out[:, :NU], m.prediction, config)
    m.reached, m.sent = m.sent, reference
    return np.asarray(base + m.correction)


def _positions(row: StanceRow, height: Array, moment: Array) -> Array:
    """(B, 19) joints, pelvis x, y, height, pitch."""
    joints = row.joints + _apply(row.joints_per_moment, moment)
    place = row.pelvis[:, :2] + _apply(row.pelvis_per_moment, moment)
    return np.concatenate([joints, place, height[:, None], row.pelvis[:, 2:]], axis=1)


def _reference(m: BalanceState, row: StanceRow, moment: Array, momentum: Array) -> Array:
    """(B, 47) this tick's reference row; rates by differences.

    The arms' momentum p pushes pelvis and waist back by M_r^-1 p. What of that the
    reference does not already contain is the recoil that the filter must expect.
    """
    positions = _positions(row, m.height, moment)
    rates = (positions - m.sent[:, _POSITIONS]) / DT
    recoil = _apply(row.mobility, momentum)
    recoil[:, [0, 1, 2, 4]] += rates[:, 15:]
    return np.concatenate([positions, rates, recoil], axis=1)


def _momentum(arms: ArmReference, pitch: Array) -> Array:
    """(B, 9) the arms' momentum along pelvis xyz, pelvis rotation (body) and waist joints."""
    about_pelvis = arms.angular + cross(TORSO_ORIGIN, arms.linear)
    waist = arms.angular[:, [2, 0, 1]]
    return np.concatenate([_turn(arms.linear, pitch), about_pelvis, waist], axis=1)


def _deviation(m: BalanceState, state: Array) -> Array:
    """(B, 36) measurements minus the reference that should be reached by now."""
    expected_rate = np.zeros((len(state), 3))
    expected_rate[:, 1] = m.reached[:, _PELVIS_RATES][:, 3]
    q = state[:, STATE_SLICES["joint_position"]][:, LOWER_BODY]
    qd = state[:, STATE_SLICES["joint_velocity"]][:, LOWER_BODY]
    return np.concatenate(
        [
            state[:, STATE_SLICES["projected_gravity"]] - _gravity(m.pitch),
            state[:, STATE_SLICES["angular_velocity"]] - expected_rate,
            q - m.reached[:, _JOINTS],
            qd - m.reached[:, _JOINT_RATES],
        ],
        axis=1,
    )


def _bounded(correction: Array, estimate: Array, config: BalanceConfig) -> Array:
    """Saturate, and fade with tilt."""
    limit = config.correction_limit * _LIMIT
    tilt = np.sqrt(np.sum(estimate[:, 3:5] ** 2, axis=1, keepdims=True))
    keep = (config.fade_to - tilt) / (config.fade_to - config.fade_from)
    keep = np.minimum(np.maximum(keep, 0.0), 1.0)
    return np.asarray(keep * np.minimum(np.maximum(correction, -limit), limit))


def _bound_forces(prediction: Array, config: BalanceConfig) -> None:
    """Limit the estimated constant forces, in place (anti-windup)."""
    limit = config.force_limit * np.repeat([1.0, 0.5], [3, 6])
    forces = prediction[:, NX + NR :]
    np.minimum(np.maximum(forces, -limit, out=forces), limit, out=forces)


def _gravity(pitch: Array) -> Array:
    """(B, 3) gravity in a pelvis frame pitched by (B,) rad."""
    return np.stack([np.sin(pitch), np.zeros_like(pitch), -np.cos(pitch)], axis=1)


def _turn(vector: Array, pitch: Array) -> Array:
    """(B, 3) from the pelvis frame to the heading frame, for a pelvis pitched by (B,)."""
    c, s = np.cos(pitch), np.sin(pitch)
    x, y, z = vector.T
    return np.stack([c * x + s * z, y, c * z - s * x], axis=1)


def _apply(matrix: Array, vector: Array) -> Array:
    """(B, n, m) times (B, m), one product per row, so that a row's bits ignore the batch."""
    return np.asarray((matrix @ vector[:, :, None])[:, :, 0])


def replace_rows(memory: Any, fresh: Any, rows: NDArray[np.intp]) -> None:
    """Overwrite ``rows`` of ``memory``, in place, with all rows of ``fresh``.

    Both are dataclasses of arrays with one row per robot, nested or not.
    """
    for entry in fields(memory):
        old, new = getattr(memory, entry.name), getattr(fresh, entry.name)
        if isinstance(old, np.ndarray):
            old[rows] = new
        else:
            replace_rows(old, new, rows)


@dataclass(frozen=True)
class StanceConfig:
    """Parameters that do not change the gains."""

    balance: BalanceConfig = field(default_factory=BalanceConfig)
    reach: ReachConfig = field(default_factory=ReachConfig)


def identity(name: str, parameters: object) -> str:
    """``name`` and a hash of the parameters, the arms, the stance table and the gains."""
    digest = hashlib.sha256(repr((parameters, ARM_IDENTITY)).encode())
    digest.update(stance_table().fingerprint().encode())
    digest.update(np.concatenate([STIFFNESS, DAMPING]).tobytes())
    return f"{name}-{digest.hexdigest()[:8]}"


class StanceController:
    """`LowLevelController` for two planted feet."""

    walks = False

    def __init__(self, config: StanceConfig | None = None) -> None:
        self.config = config or StanceConfig()
        self._table = stance_table()
        self._balance, self._arms = start_standing(np.zeros((0, STATE_DIM)))

    @property
    def id(self) -> str:
        return identity("g1-stance-lqr", self.config)

    @property
    def stepping(self) -> NDArray[np.bool_]:
        return np.zeros(len(self._balance.height), dtype=np.bool_)

    def reset(self, state: NDArray[np.floating], rows: NDArray[np.intp] | None = None) -> None:
        """See `LowLevelController`."""
        s = np.asarray(state, dtype=np.float64)
        if rows is None or len(self._balance.height) != len(s):
            self._balance, self._arms = start_standing(s)
            return
        standing, arms = start_standing(s[rows])
        replace_rows(self._balance, standing, rows)
        replace_rows(self._arms, arms, rows)

    def step(self, state: NDArray[np.floating]) -> Array:
        s = np.asarray(state, dtype=np.float64)
        if len(self._balance.height) != len(s):
            self.reset(s)
        m = self._balance
        height = s[:, STATE_SLICES["command_height"]][:, 0]
        follow_height(m, self._table.clamp(height), self.config.balance)
        arm_target = reach(self._arms, s, m.gravity, m.prediction[:, 6:9], self.config.reach)
        row = self._table.at(m.height)
        body_target = balance(m, s, row, self._arms, self.config.balance)
        target = np.concatenate([body_target, arm_target], axis=1)
        return np.asarray(np.minimum(np.maximum(target, TARGET_LOW), TARGET_HIGH))


def pelvis_height(joint_position: Array, gravity: Array) -> Array:
    """(B,) pelvis above the lower foot's sole, m."""
    ankles = foot_positions(np.asarray(joint_position, dtype=np.float64))
    feet = rotate(heading_rotation(gravity)[:, None], ankles)
    return np.asarray(ANKLE_HEIGHT - np.min(feet[..., 2], axis=1))
