"""Legs and waist keep the robot up: references by height, and the LQR's correction.

All deviations are taken from the reference that the robot should have reached by now:
targets act one tick after they are sent, so that is the reference sent two ticks ago.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from egovcp.robot.arms import cross
from egovcp.robot.g1 import DAMPING, EFFORT_LIMIT, STIFFNESS
from egovcp.robot.kinematics import Array
from egovcp.robot.reach import DT, TORSO_ORIGIN, Reach
from egovcp.robot.stance_table import NF, NR, NU, NX, NZ, StanceRow, StanceTable
from egovcp.spec import STATE_SLICES

LOWER_BODY: Final = slice(0, NU)
_KP: Final = STIFFNESS[LOWER_BODY]
_KD: Final = DAMPING[LOWER_BODY]
_LIMIT: Final = EFFORT_LIMIT[LOWER_BODY] / _KP

# Columns of a reference row: what the sensors should read, and the expected recoil.
_JOINTS: Final = slice(0, 15)
_PELVIS: Final = slice(15, 19)  # x, y, height, pitch
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
class Balance:
    """Memory of the stance; leading axis B."""

    prediction: Array  # (B, 29) filter's state expected at the next tick, off the reference
    correction: Array  # (B, 15) rad, sent last and acting now
    height: Array  # (B,) reference, m
    height_rate: Array  # (B,) m/s
    sent: Array  # (B, 47) reference of the last tick
    reached: Array  # (B, 47) reference of the tick before

    @property
    def pitch(self) -> Array:
        """(B,) pelvis pitch of the reference reached, rad."""
        return np.asarray(self.reached[:, 18])


def start(height: Array, reach: Reach, table: StanceTable) -> Balance:
    """Memory of a robot standing still at pelvis heights (B,) with its arms as in ``reach``."""
    batch, row = len(height), table.at(height)
    moment = _turn(reach.moment, row.pelvis[:, 2])[:, :2]
    reference = np.zeros((batch, _WIDTH))
    reference[:, _POSITIONS] = _positions(row, height, moment)
    return Balance(
        prediction=np.zeros((batch, NF)),
        correction=np.zeros((batch, NU)),
        height=height.copy(),
        height_rate=np.zeros(batch),
        sent=reference,
        reached=reference.copy(),
    )


def follow_height(m: Balance, command: Array, config: BalanceConfig) -> None:
    """Critically damped second-order reference with bounded speed, in place."""
    w = config.height_frequency
    rate = m.height_rate + DT * (w * w * (command - m.height) - 2 * w * m.height_rate)
    m.height_rate = np.minimum(np.maximum(rate, -config.height_speed), config.height_speed)
    m.height = m.height + DT * m.height_rate


def gravity_estimate(m: Balance) -> Array:
    """(B, 3) unit gravity in the pelvis frame: the reference turned by the estimate."""
    reference = _gravity(m.pitch)
    return np.asarray(reference + cross(reference, m.prediction[:, 3:6]))


def balance(m: Balance, state: Array, row: StanceRow, reach: Reach, config: BalanceConfig) -> Array:
    """Advance the law by one tick and return leg and waist targets (B, 15), rad."""
    pitch = row.pelvis[:, 2]
    moment = _turn(reach.moment, pitch)[:, :2]
    reference = _reference(m, row, moment, _momentum(reach, pitch))
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


def _reference(m: Balance, row: StanceRow, moment: Array, momentum: Array) -> Array:
    """(B, 47) this tick's reference row; rates by differences.

    The arms' momentum p pushes pelvis and waist back by M_r^-1 p. What of that the
    reference does not already contain is the recoil that the filter must expect.
    """
    positions = _positions(row, m.height, moment)
    rates = (positions - m.sent[:, _POSITIONS]) / DT
    recoil = _apply(row.mobility, momentum)
    recoil[:, [0, 1, 2, 4]] += rates[:, 15:]
    return np.concatenate([positions, rates, recoil], axis=1)


def _momentum(reach: Reach, pitch: Array) -> Array:
    """(B, 9) the arms' momentum along pelvis xyz, pelvis rotation (body) and waist joints."""
    about_pelvis = reach.angular + cross(TORSO_ORIGIN, reach.linear)
    waist = reach.angular[:, [2, 0, 1]]
    return np.concatenate([_turn(reach.linear, pitch), about_pelvis, waist], axis=1)


def _deviation(m: Balance, state: Array) -> Array:
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
    """Saturate, and fade with tilt: outside its basin the law must not kick."""
    limit = config.correction_limit * _LIMIT
    tilt = np.sqrt(np.sum(estimate[:, 3:5] ** 2, axis=1, keepdims=True))
    keep = (config.fade_to - tilt) / (config.fade_to - config.fade_from)
    keep = np.minimum(np.maximum(keep, 0.0), 1.0)
    return np.asarray(keep * np.minimum(np.maximum(correction, -limit), limit))


def _bound_forces(prediction: Array, config: BalanceConfig) -> None:
    """Limit the estimated constant forces, in place: a robot on its toes must not wind up."""
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
