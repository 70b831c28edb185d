"""Stands, squats and reaches on two planted feet from proprioception alone.

Legs and waist follow a gain-scheduled LQR with a Kalman filter (`balance`, numbers from
`stance_gains`), arms follow inverse kinematics with gravity feed-forward (`reach`). The
law cannot step: the velocity part of the command is ignored.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot import arms, balance, reach
from egovcp.robot.balance import Balance, BalanceConfig
from egovcp.robot.g1 import ARMS, DAMPING, STIFFNESS
from egovcp.robot.kinematics import (
    Array,
    foot_positions,
    heading_rotation,
    rotate,
    torso_rotation,
)
from egovcp.robot.memory import replace_rows
from egovcp.robot.reach import TORSO_ORIGIN, Reach, ReachConfig
from egovcp.robot.stance_table import stance_table
from egovcp.robot.targets import TARGET_HIGH, TARGET_LOW
from egovcp.spec import STATE_DIM, STATE_SLICES

_SOLE_HEIGHT: Final = 0.035  # m, ankle-roll frame above the sole


@dataclass(frozen=True)
class StanceConfig:
    """All that can be tuned without designing new gains."""

    balance: BalanceConfig = field(default_factory=BalanceConfig)
    reach: ReachConfig = field(default_factory=ReachConfig)


class StanceController:
    """`LowLevelController` for two planted feet; see the module's docstring."""

    def __init__(self, config: StanceConfig | None = None) -> None:
        self.config = config or StanceConfig()
        self._table = stance_table()
        self._balance, self._reach = self._start(np.zeros((0, STATE_DIM)))

    @property
    def id(self) -> str:
        """Changes with every number of the law, its limits and its servo gains."""
        digest = hashlib.sha256(repr((self.config, arms.IDENTITY)).encode())
        digest.update(self._table.fingerprint().encode())
        digest.update(np.concatenate([STIFFNESS, DAMPING]).tobytes())
        return f"g1-stance-lqr-{digest.hexdigest()[:8]}"

    @property
    def walks(self) -> bool:
        """No: both feet stay where they are."""
        return False

    @property
    def stepping(self) -> NDArray[np.bool_]:
        """(B,) none."""
        return np.zeros(len(self._balance.height), dtype=np.bool_)

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
        if rows is None or len(self._balance.height) != len(s):
            self._balance, self._reach = self._start(s)
            return
        fresh = self._start(s[rows])
        replace_rows(self._balance, fresh[0], rows)
        replace_rows(self._reach, fresh[1], rows)

    def _start(self, state: Array) -> tuple[Balance, Reach]:
        q = state[:, STATE_SLICES["joint_position"]]
        height = pelvis_height(q, state[:, STATE_SLICES["projected_gravity"]])
        arm_memory = reach.start(q[:, ARMS])
        return balance.start(self._table.clamp(height), arm_memory, self._table), arm_memory

    def step(self, state: NDArray[np.floating]) -> Array:
        """(B, S) observations -> (B, J) joint position targets, rad."""
        s = np.asarray(state, dtype=np.float64)
        if len(self._balance.height) != len(s):
            self.reset(s)
        memory = self._balance
        height = s[:, STATE_SLICES["command_height"]][:, 0]
        balance.follow_height(memory, self._table.clamp(height), self.config.balance)
        heading = heading_rotation(balance.gravity_estimate(memory))
        torso = torso_rotation(heading, memory.prediction[:, 6:9])
        hands = s[:, STATE_SLICES["command_hands"]].reshape(-1, 2, 3)
        relative = hands - rotate(heading, TORSO_ORIGIN)[:, None]
        arm_target = reach.follow(self._reach, relative, torso, self.config.reach)
        row = self._table.at(memory.height)
        body_target = balance.balance(memory, s, row, self._reach, self.config.balance)
        target = np.concatenate([body_target, arm_target], axis=1)
        return np.asarray(np.minimum(np.maximum(target, TARGET_LOW), TARGET_HIGH))


def pelvis_height(joint_position: Array, gravity: Array) -> Array:
    """(B,) pelvis above the lower foot's sole, m."""
    ankles = foot_positions(np.asarray(joint_position, dtype=np.float64))
    feet = rotate(heading_rotation(gravity)[:, None], ankles)
    return np.asarray(_SOLE_HEIGHT - np.min(feet[..., 2], axis=1))
