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
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp.spec import CONTROLLER_HZ, STATE_DIM, STATE_SLICES
from egovcp_train.lowlevel import events, rewards, sensing
from egovcp_train.lowlevel.loop import Loop
from egovcp_train.lowlevel.physics import Physics, Snapshot
from egovcp_train.lowlevel.task import LowLevelTask

Array = NDArray[np.float64]
_DT: Final = 1.0 / CONTROLLER_HZ


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
        self.loop = Loop(robots, task, walk, sensors, self.rng)
        self.episode_length_buf = torch.zeros(robots, dtype=torch.long)
        self._delay = np.zeros(robots, dtype=np.intp)
        self._next_push = np.zeros(robots, dtype=np.intp)
        self._start(np.arange(robots))
        self._observe(self.physics.snapshot())

    # --- VecEnv ----------------------------------------------------------------------
    def get_observations(self) -> TensorDict:
        """Groups ``policy`` (N, 95) and ``privileged`` (N, 16)."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One tick of 20 ms."""
        self.physics.step(self.loop.targets(actions.detach().numpy()), self._delay)
        self.episode_length_buf += 1
        self._push()
        x = self.physics.snapshot()
        terms = self.loop.judge(x)
        fallen = self.loop.fallen
        reward = self._weighted(rewards.earned(terms, fallen, x.broken))
        late = self.episode_length_buf.numpy() >= self.max_episode_length
        done = fallen | late
        log = self._record(terms, done, fallen)
        self.loop.commands.advance()
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

    def spread_ends(self) -> None:
        """Let the running episodes end at different times, as if they had begun at random ones."""
        age = self.rng.integers(0, self.max_episode_length, self.num_envs)
        self.episode_length_buf[:] = torch.from_numpy(age)
        self._schedule_push(np.arange(self.num_envs))

    def reseed(self, number: int) -> None:
        """Go on with other random numbers than at the start: those of ``number``."""
        self.rng.bit_generator.state = np.random.default_rng(
            [self.seed, number]
        ).bit_generator.state

    def close(self) -> None:
        """End the threads."""
        self.physics.close()

    # --- inside ----------------------------------------------------------------------
    def _start(self, rows: NDArray[np.intp]) -> None:
        """New episodes."""
        n = len(rows)
        qpos = events.standing(n, self.rng)
        self.physics.place(rows, qpos, qpos[:, 7:])
        self.loop.restart(rows)
        self.episode_length_buf[torch.from_numpy(rows)] = 0
        self._delay[rows] = events.delays(n, self.task.disturbances, self.rng)
        self._schedule_push(rows)

    def _schedule_push(self, rows: NDArray[np.intp]) -> None:
        seconds = self.rng.uniform(*self.task.disturbances.push_interval, len(rows))
        now = self.episode_length_buf.numpy()[rows]
        self._next_push[rows] = now + (seconds * CONTROLLER_HZ).astype(np.intp)

    def _push(self) -> None:
        """A horizontal impulse, of at most the speed that the difficulty allows."""
        rows = np.flatnonzero(self.episode_length_buf.numpy() >= self._next_push)
        if len(rows) == 0:
            return
        self.physics.qvel[rows, :2] += events.pushes(
            len(rows), self.task.disturbances, self.loop.difficulty, self.rng
        )
        self.loop.pushed(rows)
        self._schedule_push(rows)

    def _weighted(self, earned: dict[str, Array]) -> Array:
        """(N,) reward of the tick."""
        weights = asdict(self.task.rewards)
        parts = [weights[name] * _DT * value for name, value in earned.items()]
        return np.asarray(sum(parts))

    def _observe(self, x: Snapshot) -> None:
        policy, privileged = self.loop.observe(x, self.physics.floor_friction)
        self._observations = TensorDict(
            {"policy": torch.from_numpy(policy), "privileged": torch.from_numpy(privileged)},
            batch_size=[self.num_envs],
        )

    def _record(
        self, terms: dict[str, Array], done: NDArray[np.bool_], fallen: NDArray[np.bool_]
    ) -> dict[str, float]:
        """Means over this tick, and the share of the ended episodes that fell."""
        log = {f"/reward/{name}": float(np.nanmean(value)) for name, value in terms.items()}
        if done.any():
            log["/episode/fell"] = float(fallen[done].mean())
        log["/episode/difficulty"] = self.loop.difficulty
        return log


# --- left and right ------------------------------------------------------------------
_JOINTS = STATE_SLICES["joint_position"]
_ACTION_SOURCE: Final = np.array(STATE_SOURCE[_JOINTS][:ACTIONS] - _JOINTS.start)
_ACTION_SIGN: Final = STATE_SIGN[_JOINTS][:ACTIONS]
#: Half a stride later the other foot swings: sin and cos change sign.
_POLICY_SOURCE: Final = np.concatenate(
    [STATE_SOURCE, STATE_DIM + np.arange(6), STATE_DIM + 6 + _ACTION_SOURCE]
)
_POLICY_SIGN: Final = np.concatenate(
    [STATE_SIGN, [-1.0, -1.0, 1.0], [1.0, -1.0, -1.0], _ACTION_SIGN]
)
_PRIVILEGED_SOURCE: Final = np.array([0, 1, 2, 3, 4, 5, 6, 8, 7, 10, 9, 13, 14, 11, 12, 15])
_PRIVILEGED_SIGN: Final = np.array([1, -1, 1, -1, -1, 1, 1, 1, 1, 1, 1, 1, -1, 1, -1, 1.0])


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
    return x[..., torch.from_numpy(source)] * torch.from_numpy(sign).to(x)


assert len(_POLICY_SOURCE) == OBSERVATION_DIM
assert len(_PRIVILEGED_SOURCE) == sensing.PRIVILEGED_DIM
