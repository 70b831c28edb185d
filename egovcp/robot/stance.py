"""Stands, squats and reaches on two planted feet from proprioception alone.

Legs and waist follow a gain-scheduled LQR with a Kalman filter (numbers from
``stance_gains``), arms follow inverse kinematics with gravity feed-forward. The law
cannot step: the velocity part of the command is ignored.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot import arms
from egovcp.robot.g1 import ARMS, DAMPING, EFFORT_LIMIT, STIFFNESS, WAIST
from egovcp.robot.kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    LINK_NAMES,
    LINK_OFFSET,
    Array,
    heading_rotation,
    joint_rotations,
    link_transforms,
    rotate,
)
from egovcp.robot.stance_table import NU, NX, StanceRow, stance_table
from egovcp.spec import CONTROLLER_HZ, NUM_JOINTS, STATE_SLICES

_DT: Final = 1.0 / CONTROLLER_HZ
_SOLE_HEIGHT: Final = 0.035  # m, ankle-roll frame above the sole
_FEET: Final = tuple(LINK_NAMES.index(f"{side}_ankle_roll_link") for side in ("left", "right"))
_LOWER_BODY: Final = slice(0, NU)
_KP, _KD = STIFFNESS[_LOWER_BODY], DAMPING[_LOWER_BODY]
_ARM_KP: Final = STIFFNESS[ARMS].reshape(2, 7)
_ARM_KD: Final = DAMPING[ARMS].reshape(2, 7)
_REST_MOMENT: Final = arms.first_moment(arms.forward(arms.REST[None]))[0, :, 0].sum(0)  # (3,)


@dataclass(frozen=True)
class StanceConfig:
    """Limits and speeds of the law; part of its identity."""

    height_frequency: float = 8.0
    """rad/s: the height follows its command like a critically damped spring."""
    height_speed: float = 0.45
    """m/s."""
    arm_speed: float = 8.0
    """rad/s, of each arm joint's reference."""
    arm_smoothing: float = 0.5
    """Share of the remaining way that the arm reference goes per tick."""
    arm_lead: float = 0.8
    """Share of the servo's velocity lag (kd/kp) that is fed forward."""
    correction_limit: float = 0.8
    """Bound of each balance correction, as a share of effort limit / stiffness."""
    fade_from: float = 0.35
    """rad of tilt away from the reference at which corrections begin to fade."""
    fade_to: float = 0.8
    """rad of tilt at which they are gone."""


@dataclass
class _Memory:
    """What the law remembers between ticks; leading axis B."""

    prediction: Array  # (B, 18)
    correction: Array  # (B, 15) last sent, acting now
    height: Array  # (B,) reference, m
    height_rate: Array  # (B,)
    arm_goal: Array  # (B, 2, 7) IK solution, rad
    arm: Array  # (B, 2, 7) smoothed reference, rad
    joints: Array  # (B, 15) leg and waist reference of the last tick, rad
    joint_rate: Array  # (B, 15)
    pitch: Array  # (B,) reference pelvis pitch of the last tick, rad


class StanceController:
    """`LowLevelController` for two planted feet; see the module's docstring."""

    def __init__(self, config: StanceConfig | None = None) -> None:
        self.config = config or StanceConfig()
        self._table = stance_table()
        self._memory: _Memory | None = None

    @property
    def id(self) -> str:
        """Changes with every number of the law, its limits and its servo gains."""
        digest = hashlib.sha256(repr(self.config).encode())
        digest.update(self._table.fingerprint().encode())
        digest.update(np.concatenate([STIFFNESS, DAMPING]).tobytes())
        return f"g1-stance-lqr-{digest.hexdigest()[:8]}"

    @property
    def stiffness(self) -> Array:
        """(J,) N m/rad."""
        return STIFFNESS

    @property
    def damping(self) -> Array:
        """(J,) N m s/rad."""
        return DAMPING

    def reset(self, state: NDArray[np.floating], rows: NDArray[np.intp] | None = None) -> None:
        """Forget the memory of ``rows`` (None: all) and start at the measured posture."""
        s = np.asarray(state, dtype=np.float64)
        fresh = self._start(s if rows is None else s[rows])
        if rows is None or self._memory is None:
            self._memory = fresh if rows is None else self._start(s)
            return
        for field in fields(_Memory):
            getattr(self._memory, field.name)[rows] = getattr(fresh, field.name)

    def _start(self, state: Array) -> _Memory:
        batch = len(state)
        q = state[:, STATE_SLICES["joint_position"]]
        gravity = state[:, STATE_SLICES["projected_gravity"]]
        height = np.clip(
            _pelvis_height(q, gravity), self._table.heights[0], self._table.heights[-1]
        )
        row = self._table.at(height)
        arm = np.clip(q[:, ARMS].reshape(batch, 2, 7), arms.LOWER, arms.UPPER)
        return _Memory(
            prediction=np.zeros((batch, NX)),
            correction=np.zeros((batch, NU)),
            height=height,
            height_rate=np.zeros(batch),
            arm_goal=arm.copy(),
            arm=arm.copy(),
            joints=row.joints,
            joint_rate=np.zeros((batch, NU)),
            pitch=row.pelvis[:, 2].copy(),
        )

    def step(self, state: NDArray[np.floating]) -> Array:
        """(B, S) observations -> (B, J) joint position targets, rad."""
        s = np.asarray(state, dtype=np.float64)
        if self._memory is None or len(self._memory.height) != len(s):
            self.reset(s)
        memory = self._memory
        assert memory is not None
        self._follow_height(memory, s[:, STATE_SLICES["command_height"]][:, 0])
        row = self._table.at(memory.height)
        tilt = _estimated_gravity(memory)
        arm_target, moment = self._arms(memory, s[:, STATE_SLICES["command_hands"]], tilt, row)
        body_target = self._body(memory, s, row, moment)
        target = np.concatenate([body_target, arm_target], axis=1)
        return np.minimum(np.maximum(target, _TARGET_LOW), _TARGET_HIGH)

    def _follow_height(self, m: _Memory, command: Array) -> None:
        """Critically damped second-order reference with bounded speed."""
        low, high = self._table.heights[[0, -1]]
        goal = np.minimum(np.maximum(np.nan_to_num(command, nan=high), low), high)
        w = self.config.height_frequency
        rate = m.height_rate + _DT * (w * w * (goal - m.height) - 2 * w * m.height_rate)
        limit = self.config.height_speed
        m.height_rate = np.minimum(np.maximum(rate, -limit), limit)
        m.height = m.height + _DT * m.height_rate

    def _arms(
        self, m: _Memory, command: Array, gravity: Array, row: StanceRow
    ) -> tuple[Array, Array]:
        """Arm targets (B, 14) and the arms' first moment off its rest place (B, 2), kg m."""
        cfg, batch = self.config, len(command)
        to_heading = heading_rotation(gravity)
        waist = joint_rotations(m.prediction[:, 6:9], WAIST)
        roll_offset = rotate(waist[:, 0], LINK_OFFSET[13])
        torso = to_heading @ waist[:, 0] @ waist[:, 1] @ waist[:, 2]
        origin = rotate(to_heading, roll_offset)
        relative = np.nan_to_num(command).reshape(batch, 2, 3) - origin[:, None]
        goal = arms.reachable(rotate(np.swapaxes(torso, 1, 2)[:, None], relative))
        for _ in range(2):
            m.arm_goal, _ = arms.improve(m.arm_goal, goal, cfg.arm_speed * _DT)
        way = cfg.arm_smoothing * (m.arm_goal - m.arm)
        limit = cfg.arm_speed * _DT
        way = np.minimum(np.maximum(way, -limit), limit)
        m.arm = m.arm + way
        pose = arms.forward(m.arm)
        first = arms.first_moment(pose)
        down = rotate(np.swapaxes(torso, 1, 2), np.array([0.0, 0.0, -9.81]))
        torque = arms.holding_torque(pose, first, down)
        lead = cfg.arm_lead * _ARM_KD / _ARM_KP * way / _DT
        target = m.arm + torque / _ARM_KP + lead
        moment = np.sum(first[:, :, 0], axis=1) - _REST_MOMENT
        pitch = row.pelvis[:, 2]
        ahead = np.cos(pitch) * moment[:, 0] + np.sin(pitch) * moment[:, 2]
        return target.reshape(batch, -1), np.stack([ahead, moment[:, 1]], axis=1)

    def _body(self, m: _Memory, s: Array, row: StanceRow, moment: Array) -> Array:
        """Leg and waist targets (B, 15)."""
        joints = row.joints + _apply(row.joints_per_moment, moment)
        torque = row.torque + _apply(row.torque_per_moment, moment)
        rate = (joints - m.joints) / _DT
        pitch = row.pelvis[:, 2]
        deviation = _deviation(m, s, (pitch - m.pitch) / _DT)
        stacked = np.concatenate([m.prediction, deviation, m.correction], axis=1)
        out = _apply(row.compensator, stacked)
        m.prediction = out[:, NU:]
        m.correction = self._bounded(out[:, :NU], m.prediction)
        m.joints, m.joint_rate, m.pitch = joints, rate, pitch.copy()
        return joints + (torque + _KD * rate) / _KP + m.correction

    def _bounded(self, correction: Array, estimate: Array) -> Array:
        """Saturate, and fade with tilt: outside its basin the law must not kick."""
        cfg = self.config
        limit = cfg.correction_limit * EFFORT_LIMIT[_LOWER_BODY] / _KP
        tilt = np.sqrt(np.sum(estimate[:, 3:5] ** 2, axis=1, keepdims=True))
        keep = (cfg.fade_to - tilt) / (cfg.fade_to - cfg.fade_from)
        keep = np.minimum(np.maximum(keep, 0.0), 1.0)
        return keep * np.minimum(np.maximum(correction, -limit), limit)


_TARGET_SLACK: Final = 0.6  # rad that a target may pass a joint limit by, to make torque there
_TARGET_LOW: Final = JOINT_LOWER - _TARGET_SLACK
_TARGET_HIGH: Final = JOINT_UPPER + _TARGET_SLACK


def _apply(matrix: Array, vector: Array) -> Array:
    """(B, n, m) times (B, m), one product per row, so that a row's bits ignore the batch."""
    out: Array = (matrix @ vector[:, :, None])[:, :, 0]
    return out


def _estimated_gravity(m: _Memory) -> Array:
    """(B, 3) gravity in the pelvis frame: the reference pitch turned by the estimate."""
    turn = m.prediction[:, 3:6]
    zero = np.zeros_like(m.pitch)
    reference = np.stack([np.sin(m.pitch), zero, -np.cos(m.pitch)], axis=1)
    return reference + arms.cross(reference, turn)


def _deviation(m: _Memory, s: Array, pitch_rate: Array) -> Array:
    """(B, 36) measurements minus the reference of the last tick."""
    zero = np.zeros_like(m.pitch)
    gravity = np.stack([np.sin(m.pitch), zero, -np.cos(m.pitch)], axis=1)
    gyro = np.stack([zero, pitch_rate, zero], axis=1)
    q = s[:, STATE_SLICES["joint_position"]][:, _LOWER_BODY]
    qd = s[:, STATE_SLICES["joint_velocity"]][:, _LOWER_BODY]
    return np.concatenate(
        [
            s[:, STATE_SLICES["projected_gravity"]] - gravity,
            s[:, STATE_SLICES["angular_velocity"]] - gyro,
            q - m.joints,
            qd - m.joint_rate,
        ],
        axis=1,
    )


def _pelvis_height(joint_position: Array, gravity: Array) -> Array:
    """(B,) pelvis above the lower foot's sole, m."""
    position, _ = link_transforms(joint_position)
    feet = rotate(heading_rotation(gravity)[:, None], position[:, _FEET])
    return np.asarray(_SOLE_HEIGHT - np.min(feet[..., 2], axis=1))


assert NUM_JOINTS == NU + 14
