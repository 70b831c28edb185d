"""Stands, squats, reaches and walks: the stance law, a gait and a trained residual.

The targets of legs and waist are

    q* = q_ref(h) + (1 - g) u_lqr + g q_gait(phi, v) + s a

with the standing targets of the height h, the stance law's correction u_lqr, the gait's leg
motion (`gait`), the share of the gait g, and the action a of a policy trained by PPO
(``egovcp-train-lowlevel``) times a scale s. The arms follow inverse kinematics as in standing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot import gait
from egovcp.robot.arms import ArmReference, ReachConfig
from egovcp.robot.g1 import WAIST
from egovcp.robot.gait import Gait, GaitConfig
from egovcp.robot.geometry import Array
from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.robot.stance import (
    BalanceConfig,
    BalanceState,
    balance,
    follow_height,
    identity,
    reach,
    replace_rows,
    start_standing,
)
from egovcp.robot.stance_table import NU, stance_table
from egovcp.spec import NUM_JOINTS, STATE_DIM, STATE_SLICES

if TYPE_CHECKING:
    from egovcp.robot.walk_policy import WalkPolicy

ACTIONS: Final = NU  # legs and waist
OBSERVATION_DIM: Final = STATE_DIM + 3 + 3 + ACTIONS
"""State; g sin phi, g cos phi, g; velocity by odometry x, y and heading off; last action."""


@dataclass(frozen=True)
class WalkConfig:
    """Parameters of the walking law, with which the policy was trained."""

    balance: BalanceConfig = field(default_factory=BalanceConfig)
    reach: ReachConfig = field(
        default_factory=lambda: ReachConfig(speed=14.0, acceleration=1000.0, bandwidth=34.0)
    )
    """Faster arms than the stance law alone can balance."""
    gait: GaitConfig = field(default_factory=GaitConfig)
    action_scale: float = 0.3
    """rad per unit of the policy's action."""
    action_limit: float = 4.0
    """Bound of the policy's action."""


@dataclass
class _Memory:
    balance: BalanceState
    arms: ArmReference
    gait: Gait
    action: Array  # (B, 15) last action


class Walk:
    """The law around the policy, the same in training and on the robot; batched over B robots.

    Each tick, ``observe`` gives the policy's observation, ``targets`` converts its action.
    """

    def __init__(self, config: WalkConfig | None = None) -> None:
        self.config = config or WalkConfig()
        self._table = stance_table()
        self._memory = self._start(np.zeros((0, STATE_DIM)))
        self._nominal: Array = np.zeros((0, NUM_JOINTS))

    @property
    def height(self) -> Array:
        """(B,) m, the pelvis height that should be reached by now."""
        return self._memory.balance.height

    @property
    def pitch(self) -> Array:
        """(B,) rad, the natural pitch at that height."""
        return self._memory.balance.pitch

    @property
    def gait(self) -> Gait:
        return self._memory.gait

    def reset(self, state: NDArray[np.floating], rows: NDArray[np.intp] | None = None) -> None:
        """Reset ``rows`` (None: all) to standing in the measured posture."""
        s = np.asarray(state, dtype=np.float64)
        if rows is None or len(self._memory.action) != len(s):
            self._memory = self._start(s)
        else:
            replace_rows(self._memory, self._start(s[rows]), rows)

    def _start(self, state: Array) -> _Memory:
        joints = state[:, STATE_SLICES["joint_position"]]
        walking = gait.start(joints, state[:, STATE_SLICES["projected_gravity"]])
        return _Memory(*start_standing(state), walking, np.zeros((len(state), ACTIONS)))

    def observe(self, state: NDArray[np.floating]) -> NDArray[np.float32]:
        """(B, 74) measurements -> (B, 95) observations of the policy; the memory advances."""
        s = np.asarray(state, dtype=np.float64)
        m = self._memory
        command = s[:, STATE_SLICES["command_height"]][:, 0]
        follow_height(m.balance, self._table.clamp(command), self.config.balance)
        tilt = self._tilt(s)
        gait.sense(m.gait, s, self.config.gait)
        row = self._table.at(m.balance.height)
        stands = gait.advance(m.gait, row, m.balance.height, tilt, s, self.config.gait)
        self._restart_standing(stands)
        blend = m.gait.blend[:, None]
        arm_targets = self._reach(s, blend[:, 0] > 0)
        body = balance(m.balance, s, row, m.arms, self.config.balance)
        motion = gait.leg_motion(m.gait, row, m.balance.height, tilt, s, self.config.gait)
        body += blend * (motion - m.balance.correction)
        self._nominal = np.asarray(np.concatenate([body, arm_targets], axis=1))
        phase, yaw = m.gait.phase[:, None], m.gait.heading_error[:, None]
        clock = [blend * np.sin(phase), blend * np.cos(phase), blend]
        seen = [s, *clock, m.gait.velocity, yaw, m.action]
        return np.concatenate(seen, axis=1, dtype=np.float32)

    def targets(self, action: NDArray[np.floating]) -> Array:
        """The policy's action (B, 15) -> joint position targets (B, 29), rad."""
        limit = self.config.action_limit
        wanted = np.asarray(action, dtype=np.float64)
        self._memory.action = np.minimum(np.maximum(wanted, -limit), limit)
        out = self._nominal.copy()
        out[:, :ACTIONS] += self.config.action_scale * self._memory.action
        return np.asarray(np.minimum(np.maximum(out, TARGET_LOW), TARGET_HIGH))

    def _tilt(self, state: Array) -> Array:
        """(B, 2) roll and pitch of the pelvis off the reference, rad, to first order."""
        gravity = state[:, STATE_SLICES["projected_gravity"]]
        pitch = self._memory.balance.pitch
        forward = gravity[:, 0] * np.cos(pitch) + gravity[:, 2] * np.sin(pitch)
        out = np.empty((len(state), 2))
        out[:, 0], out[:, 1] = -gravity[:, 1], forward
        return out

    def _reach(self, state: Array, walking: NDArray[np.bool_]) -> Array:
        """(B, 14) arm targets; the torso's attitude as estimated, or as measured in walking."""
        m = self._memory
        waist = np.where(
            walking[:, None],
            state[:, STATE_SLICES["joint_position"]][:, WAIST],
            m.balance.prediction[:, 6:9],
        )
        gravity = np.where(
            walking[:, None],
            state[:, STATE_SLICES["projected_gravity"]],
            m.balance.gravity,
        )
        return reach(m.arms, state, gravity, waist, self.config.reach)

    def _restart_standing(self, which: NDArray[np.bool_]) -> None:
        """Restart the stance law's filter, which assumes planted feet, after steps."""
        rows = np.flatnonzero(which)
        if len(rows) == 0:
            return
        m = self._memory.balance
        hands = ArmReference(
            *(getattr(self._memory.arms, n)[rows] for n in ("goal", "joints", "rate"))
        )
        fresh = BalanceState.standing(m.height[rows], hands)
        fresh.height_rate = m.height_rate[rows]
        replace_rows(m, fresh, rows)


class WalkingController:
    """`LowLevelController` that stands, squats, reaches and walks."""

    walks = True

    def __init__(self, policy: WalkPolicy) -> None:
        self._policy = policy
        self._walk = Walk(policy.config)
        self._rows = 0

    @property
    def id(self) -> str:
        return identity("g1-walk-ppo", self._policy.digest)

    @property
    def stepping(self) -> NDArray[np.bool_]:
        """(B,) robots whose targets contain any of the gait."""
        return self._walk.gait.blend > 0

    def reset(self, state: NDArray[np.floating], rows: NDArray[np.intp] | None = None) -> None:
        """See `LowLevelController`."""
        self._walk.reset(state, rows)
        self._rows = len(state)

    def step(self, state: NDArray[np.floating]) -> Array:
        if len(state) != self._rows:
            self.reset(state)
        return self._walk.targets(self._policy(self._walk.observe(state)))
