"""The vectorised environment in which PPO trains the low-level policy (rsl-rl's `VecEnv`).

One tick is 20 ms. The policy sees what a real robot measures (`Walk.observe`), the critic also
what only the simulator knows.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from egovcp.data.mirror import STATE_SIGN, STATE_SOURCE
from egovcp.robot.mjcf import FootModel
from egovcp.robot.stance_table import NU, standing_pose
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, Walk, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp.sim.sensors import noise_std
from egovcp.spec import (
    ACTION_BOX,
    CONTROLLER_HZ,
    PHYSICS_DT,
    STATE_DIM,
    STATE_SLICES,
)
from egovcp_train.lowlevel import rewards
from egovcp_train.lowlevel.commands import Commands, between
from egovcp_train.lowlevel.geometry import heading, in_heading, rotation
from egovcp_train.lowlevel.physics import Physics, Snapshot
from egovcp_train.lowlevel.sensing import measure
from egovcp_train.lowlevel.task import LowLevelTask

Array = NDArray[np.float64]
_DT: Final = 1.0 / CONTROLLER_HZ
_FALLEN_TILT: Final = 0.8  # rad off the natural pitch
_FALLEN_HEIGHT: Final = 0.2  # m below the height's reference
PRIVILEGED_DIM: Final = 3 + 1 + 2 + 2 + 4 + 1  # see `_privileged`


class LowLevelEnv(VecEnv):  # type: ignore[misc]
    """N robots following commands on flat ground under pushes."""

    def __init__(
        self,
        robots: int,
        task: LowLevelTask,
        walk: WalkConfig,
        sensors: SensorConfig,
        feet: FootModel = "points",
        threads: int = 1,
        seed: int = 0,
    ) -> None:
        self.num_envs, self.num_actions = robots, ACTIONS
        self.max_episode_length = round(task.episode * CONTROLLER_HZ)
        self.device = "cpu"
        self.cfg = asdict(task)
        self.task = task
        self.physics = Physics(robots, feet, task.disturbances, threads, seed)
        self.seed, self.rng = seed, np.random.default_rng(seed)
        self.commands = Commands(robots, task.commands, self.rng)
        self.walk = Walk(walk)
        self.episode_length_buf = torch.zeros(robots, dtype=torch.long)
        self._noise = noise_std(sensors)
        self._delay = np.zeros(robots, dtype=np.intp)
        self._next_push = np.zeros(robots, dtype=np.intp)
        self._action = np.zeros((robots, ACTIONS))
        self._sums: dict[str, Array] = {}
        self._start(np.arange(robots))
        self._observe(self.physics.snapshot())

    # --- difficulty ------------------------------------------------------------------
    @property
    def difficulty(self) -> float:
        """0 .. 1; raised by the trainer as the policy succeeds."""
        return self.commands.difficulty

    @difficulty.setter
    def difficulty(self, value: float) -> None:
        self.commands.difficulty = float(np.clip(value, 0.0, 1.0))

    # --- VecEnv ----------------------------------------------------------------------
    def get_observations(self) -> TensorDict:
        """Groups ``policy`` (N, 92) and ``privileged`` (N, 13)."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One tick of 20 ms."""
        action = actions.detach().numpy().astype(np.float64)
        self.physics.step(self.walk.targets(action), self._delay)
        self.episode_length_buf += 1
        self._push()
        x = self.physics.snapshot()
        terms = rewards.terms(
            x,
            self.commands.vector,
            self.walk.height,
            self.walk.pitch,
            self.walk.gait.phase,
            self.walk.gait.amount,
            action,
            self._action,
        )
        fallen = self.fallen(x)
        weights = asdict(self.task.rewards)
        total = sum(weights[name] * _DT * np.nan_to_num(value) for name, value in terms.items())
        reward = np.where(x.broken, 0.0, total) + weights["fall"] * _DT * fallen
        self._action = action
        late = self.episode_length_buf.numpy() >= self.max_episode_length
        done = fallen | late
        log = self._record(terms, done, fallen)
        self.commands.advance()
        if done.any():
            self._start(np.flatnonzero(done))
            x = self.physics.snapshot()
        self._observe(x)
        extras = {"time_outs": torch.from_numpy(late & ~fallen), "log": log}
        return (
            self._observations,
            torch.from_numpy(reward.astype(np.float32)),
            torch.from_numpy(done.astype(np.float32)),
            extras,
        )

    def reseed(self, number: int) -> None:
        """Go on with other random numbers than at the start: those of ``number``."""
        self.rng.bit_generator.state = np.random.default_rng(
            [self.seed, number]
        ).bit_generator.state

    def close(self) -> None:
        """End the threads."""
        self.physics.close()

    # --- inside ----------------------------------------------------------------------
    def fallen(self, x: Snapshot) -> NDArray[np.bool_]:
        """(N,) tilted or sunk far off the reference, or the simulation diverged."""
        up = rotation(x.quaternion)[:, 2]
        pitch = self.walk.pitch
        cosine = up[:, 2] * np.cos(pitch) - up[:, 0] * np.sin(pitch)
        low = x.position[:, 2] < self.walk.height - _FALLEN_HEIGHT
        out: NDArray[np.bool_] = (cosine < np.cos(_FALLEN_TILT)) | low | x.broken
        return out

    def _start(self, rows: NDArray[np.intp]) -> None:
        """New episodes: standing at the neutral height, turned any way."""
        pose = standing_pose(ACTION_BOX.neutral[-1])
        n = len(rows)
        qpos = np.tile(np.concatenate([pose.position, pose.quaternion, pose.joints]), (n, 1))
        yaw = self.rng.uniform(-np.pi, np.pi, n) / 2  # half the angle, as in a quaternion
        pitch = np.arctan2(pose.quaternion[2], pose.quaternion[0])  # half of it, too
        qpos[:, 3:7] = np.stack(
            [
                np.cos(yaw) * np.cos(pitch),
                -np.sin(yaw) * np.sin(pitch),
                np.cos(yaw) * np.sin(pitch),
                np.sin(yaw) * np.cos(pitch),
            ],
            axis=1,
        )
        qpos[:, 7 + NU :] += self.rng.uniform(-0.1, 0.1, (n, qpos.shape[1] - 7 - NU))
        self.physics.place(rows, qpos, qpos[:, 7:])
        self.commands.reset(rows)
        self.episode_length_buf[torch.from_numpy(rows)] = 0
        low, high = (round(d / PHYSICS_DT) for d in self.task.disturbances.delay)
        self._delay[rows] = self.rng.integers(low, high + 1, n)
        self._schedule_push(rows)
        self._action[rows] = 0.0
        state = self._measure(self.physics.snapshot())
        self.walk.reset(state, None if n == self.num_envs else rows)

    def _schedule_push(self, rows: NDArray[np.intp]) -> None:
        seconds = self.rng.uniform(*self.task.disturbances.push_interval, len(rows))
        now = self.episode_length_buf.numpy()[rows]
        self._next_push[rows] = now + (seconds * CONTROLLER_HZ).astype(np.intp)

    def _push(self) -> None:
        """A horizontal impulse, of at most the speed that the difficulty allows."""
        rows = np.flatnonzero(self.episode_length_buf.numpy() >= self._next_push)
        if len(rows) == 0:
            return
        low, high = self.task.disturbances.push
        most = between((low, low), (high, high), self.difficulty)[0]
        angle = self.rng.uniform(-np.pi, np.pi, len(rows))
        speed = self.rng.uniform(0.0, most, len(rows))
        self.physics.qvel[rows, 0] += speed * np.cos(angle)
        self.physics.qvel[rows, 1] += speed * np.sin(angle)
        self._schedule_push(rows)

    def _measure(self, x: Snapshot) -> Array:
        return measure(x, self.commands.vector, self._noise, self.rng)

    def _observe(self, x: Snapshot) -> None:
        self.state = self._measure(x)
        policy = self.walk.observe(self.state)
        privileged = self._privileged(x)
        self._observations = TensorDict(
            {"policy": torch.from_numpy(policy), "privileged": torch.from_numpy(privileged)},
            batch_size=[self.num_envs],
        )

    def _privileged(self, x: Snapshot) -> NDArray[np.float32]:
        """True velocity 3, height error 1, feet on the floor 2, their heights 2, their places
        across and along 4, friction 1."""
        turn = rotation(x.quaternion)
        forward = heading(turn)
        velocity = in_heading(x.velocity, forward)
        feet = in_heading(x.feet - x.position[:, None], forward)
        columns = [
            velocity,
            x.velocity[:, 2:],
            (x.position[:, 2] - self.walk.height)[:, None],
            rewards.standing_feet(x),
            x.feet[..., 2],
            feet.reshape(-1, 4),
            self.physics.floor_friction[:, None],
        ]
        out = np.concatenate(columns, axis=1)
        return np.asarray(np.nan_to_num(np.clip(out, -10, 10)), dtype=np.float32)

    def _record(
        self, terms: dict[str, Array], done: NDArray[np.bool_], fallen: NDArray[np.bool_]
    ) -> dict[str, float]:
        """Means over this tick, and the share of the ended episodes that fell."""
        log = {f"/reward/{name}": float(np.nanmean(value)) for name, value in terms.items()}
        if done.any():
            log["/episode/fell"] = float(fallen[done].mean())
        log["/episode/difficulty"] = self.difficulty
        return log


# --- left and right ------------------------------------------------------------------
_JOINTS = STATE_SLICES["joint_position"]
_ACTION_SOURCE: Final = np.array(STATE_SOURCE[_JOINTS][:ACTIONS] - _JOINTS.start)
_ACTION_SIGN: Final = STATE_SIGN[_JOINTS][:ACTIONS]
#: Half a stride later the other foot swings: sin and cos change sign.
_POLICY_SOURCE: Final = np.concatenate(
    [STATE_SOURCE, STATE_DIM + np.arange(3), STATE_DIM + 3 + _ACTION_SOURCE]
)
_POLICY_SIGN: Final = np.concatenate([STATE_SIGN, [-1.0, -1.0, 1.0], _ACTION_SIGN])
_PRIVILEGED_SOURCE: Final = np.array([0, 1, 2, 3, 5, 4, 7, 6, 10, 11, 8, 9, 12])
_PRIVILEGED_SIGN: Final = np.array([1, -1, 1, 1, 1, 1, 1, 1, 1, -1, 1, -1, 1.0])


def mirrored(
    env: VecEnv, obs: TensorDict | None, actions: torch.Tensor | None
) -> tuple[TensorDict | None, torch.Tensor | None]:
    """Append to each batch what the robot would have seen and done in a mirror (rsl-rl)."""
    both: TensorDict | None = None
    doubled: torch.Tensor | None = None
    if obs is not None:
        groups = {
            "policy": _reflect(obs["policy"], _POLICY_SOURCE, _POLICY_SIGN),
            "privileged": _reflect(obs["privileged"], _PRIVILEGED_SOURCE, _PRIVILEGED_SIGN),
        }
        reflection = TensorDict(groups, batch_size=obs.batch_size)
        both = TensorDict.cat([obs, reflection], 0)
    if actions is not None:
        reflected = _reflect(actions, _ACTION_SOURCE, _ACTION_SIGN)
        doubled = torch.cat([actions, reflected], 0)
    return both, doubled


def _reflect(x: torch.Tensor, source: NDArray[Any], sign: NDArray[Any]) -> torch.Tensor:
    return x[..., torch.from_numpy(source)] * torch.from_numpy(sign).to(x.dtype)


assert len(_POLICY_SOURCE) == OBSERVATION_DIM
assert len(_PRIVILEGED_SOURCE) == PRIVILEGED_DIM
