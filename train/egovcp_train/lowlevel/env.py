"""The low-level training environment: the task's logic, and rsl-rl's `VecEnv` on MuJoCo.

`TaskLogic` is independent of the simulator: the CPU environment `LowLevelEnv` and the mjlab task
(`mjlab_terms`) hold one each and add physics and resets. One tick is 20 ms.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from egovcp.robot.arms import DT
from egovcp.robot.mjcf import FootModel
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, Walk, WalkConfig
from egovcp.robot_spec import G1
from egovcp.sim.config import SensorConfig
from egovcp.sim.robot import noise_std
from egovcp.spec import CONTROLLER_HZ, STATE_DIM, STATE_SLICES
from egovcp_train.lowlevel import physics, rewards, sensing
from egovcp_train.lowlevel.commands import Commands, random_push
from egovcp_train.lowlevel.config import LowLevelTask
from egovcp_train.lowlevel.physics import BatchPhysics, Snapshot
from egovcp_train.lowlevel.walls import Walls

Array = NDArray[np.float64]
_RECOVERY_TICKS: Final = 2 * CONTROLLER_HZ  # after a push, in which steps cost nothing


class TaskLogic:
    """Commands, controller (`Walk`), observations and rewards of N robots.

    Each tick: `targets`, physics, `reward_terms`, new commands, `restart` of some, `observe`.
    """

    def __init__(
        self,
        robots: int,
        task: LowLevelTask,
        walk: WalkConfig,
        sensors: SensorConfig,
        rng: np.random.Generator,
    ) -> None:
        self.task, self.rng = task, rng
        self.commands = Commands(robots, task.commands, rng)
        self.walk = Walk(walk)
        self.fallen: NDArray[np.bool_] = np.zeros(robots, dtype=np.bool_)
        self._velocity = rewards.AverageVelocity(robots)
        self._torso = sensing.TorsoMotion(robots)
        self._since_push = np.full(robots, _RECOVERY_TICKS)  # ticks, at most that
        self._noise = noise_std(sensors)
        self._action: Array = np.zeros((robots, ACTIONS))
        self._last_action: Array = np.zeros((robots, ACTIONS))
        self._fresh = np.ones(robots, dtype=np.bool_)

    @property
    def difficulty(self) -> float:
        """0 to 1; raised by the trainer as the policy succeeds."""
        return self.commands.difficulty

    @difficulty.setter
    def difficulty(self, value: float) -> None:
        self.commands.difficulty = float(np.clip(value, 0.0, 1.0))

    def targets(self, action: NDArray[np.floating]) -> Array:
        """The policy's actions (N, 15) -> joint targets (N, 29), rad."""
        self._last_action, self._action = self._action, np.array(action, dtype=np.float64)
        return self.walk.targets(self._action)

    def reward_terms(self, x: Snapshot) -> dict[str, Array]:
        """Reward terms of the tick except the fall, (N,) per second; sets ``fallen``.

        They are not finite where the state is not; see `rewards.finite_terms`.
        """
        self._velocity.add(x)
        self._torso.add(x)
        self._since_push = np.minimum(self._since_push + 1, _RECOVERY_TICKS)
        walk = self.walk
        self.fallen = rewards.fallen(x, walk.height, walk.pitch)
        return rewards.terms(
            x,
            self._velocity.value,
            self.commands.vector,
            walk,
            self._action,
            self._last_action,
            self._torso,
            self._since_push < _RECOVERY_TICKS,
        )

    def pushed(self, rows: NDArray[np.intp]) -> None:
        """``rows`` have just been pushed: steps cost nothing for a while."""
        self._since_push[rows] = 0

    def restart(self, rows: NDArray[np.intp]) -> None:
        """``rows`` begin new episodes in the posture that `observe` measures next."""
        self.commands.reset(rows)
        self._velocity.reset(rows)
        self._torso.reset(rows)
        self._since_push[rows] = _RECOVERY_TICKS
        self._action[rows] = 0.0
        self._fresh[rows] = True

    def observe(
        self, x: Snapshot, friction: Array, wall: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Input of the policy (N, 95), and additional input of the critic (N, 17).

        Args:
            x: the true state.
            friction: (N,) of the feet.
            wall: (N,) m to the wall (`Walls.distance`).
        """
        if self._fresh.any():  # as on the robot, the first measurement resets the controller
            rows = None if self._fresh.all() else np.flatnonzero(self._fresh)
            self.walk.reset(self._measure(x), rows)
            self._fresh[:] = False
        seen = self.walk.observe(self._measure(x))
        return seen, sensing.privileged(x, self._velocity.value, self.walk.height, friction, wall)

    def _measure(self, x: Snapshot) -> Array:
        return sensing.measure(x, self.commands.vector, self._noise, self.rng)


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
        self._weights = asdict(task.rewards)
        self.physics = BatchPhysics(robots, feet, task.disturbances, threads, seed)
        self.seed, self.rng = seed, np.random.default_rng(seed)
        self.logic = TaskLogic(robots, task, walk, sensors, self.rng)
        self.walls = Walls(robots, task.disturbances, self.logic.commands, self.rng)
        self.episode_length_buf = torch.zeros(robots, dtype=torch.long)
        self._delay = np.zeros(robots, dtype=np.intp)
        self._next_push = np.zeros(robots, dtype=np.intp)
        self._start(np.arange(robots))
        self._observe(self.physics.snapshot())

    def get_observations(self) -> TensorDict:
        """Groups ``policy`` (N, 95) and ``privileged`` (N, 17)."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One tick of 20 ms."""
        self.physics.set_walls(self.walls.position, self.walls.yaw)
        self.physics.step(self.logic.targets(actions.detach().numpy()), self._delay)
        self.episode_length_buf += 1
        self._push()
        x = self.physics.snapshot()
        self.walls.advance(x)
        terms = self.logic.reward_terms(x)
        fallen = self.logic.fallen
        reward = self._weighted(rewards.finite_terms(terms, fallen, x.broken))
        late = self.episode_length_buf.numpy() >= self.max_episode_length
        done = fallen | late
        log = self._record(terms, done, fallen)
        self.logic.commands.advance()
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
        """Give the running episodes random ages, so that they end at different times."""
        age = self.rng.integers(0, self.max_episode_length, self.num_envs)
        self.episode_length_buf[:] = torch.from_numpy(age)
        self._schedule_push(np.arange(self.num_envs))

    def reseed(self, number: int) -> None:
        """Continue with the random stream ``number`` of the seed."""
        self.rng.bit_generator.state = np.random.default_rng(
            [self.seed, number]
        ).bit_generator.state

    def close(self) -> None:
        """End the threads."""
        self.physics.close()

    def _start(self, rows: NDArray[np.intp]) -> None:
        """New episodes."""
        n = len(rows)
        qpos = physics.random_qpos(n, self.rng)
        self.physics.place(rows, qpos, qpos[:, 7:])
        self.walls.remove(rows)
        self.logic.restart(rows)
        self.episode_length_buf[torch.from_numpy(rows)] = 0
        self._delay[rows] = physics.random_delays(n, self.task.disturbances, self.rng)
        self._schedule_push(rows)

    def _schedule_push(self, rows: NDArray[np.intp]) -> None:
        seconds = self.rng.uniform(*self.task.disturbances.push_interval, len(rows))
        now = self.episode_length_buf.numpy()[rows]
        self._next_push[rows] = now + (seconds * CONTROLLER_HZ).astype(np.intp)

    def _push(self) -> None:
        """Pushes the robots that are due."""
        rows = np.flatnonzero(self.episode_length_buf.numpy() >= self._next_push)
        if len(rows) == 0:
            return
        config, difficulty = self.task.disturbances, self.logic.difficulty
        at_wall, kick = self.walls.push(rows, self.physics.snapshot(), difficulty)
        anywhere = random_push(len(rows), config, difficulty, self.rng)
        self.physics.qvel[rows, :2] += np.where(at_wall[:, None], kick, anywhere)
        self.logic.pushed(rows)
        self._schedule_push(rows)

    def _weighted(self, terms: dict[str, Array]) -> Array:
        """(N,) reward of the tick."""
        parts = [self._weights[name] * DT * value for name, value in terms.items()]
        return np.asarray(sum(parts))

    def _observe(self, x: Snapshot) -> None:
        policy, privileged = self.logic.observe(
            x, self.physics.floor_friction, self.walls.distance(x)
        )
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
        log["/episode/difficulty"] = self.logic.difficulty
        return log


# --- mirror images -------------------------------------------------------------------
assert G1.mirror is not None
_STATE_SOURCE: Final = np.array(G1.mirror.state_source)
_STATE_SIGN: Final = np.array(G1.mirror.state_sign)
_JOINTS = STATE_SLICES["joint_position"]
_ACTION_SOURCE: Final = np.array(_STATE_SOURCE[_JOINTS][:ACTIONS] - _JOINTS.start)
_ACTION_SIGN: Final = _STATE_SIGN[_JOINTS][:ACTIONS]
#: Half a stride later the other foot swings: sin and cos change sign.
_POLICY_SOURCE: Final = np.concatenate(
    [_STATE_SOURCE, STATE_DIM + np.arange(6), STATE_DIM + 6 + _ACTION_SOURCE]
)
_POLICY_SIGN: Final = np.concatenate(
    [_STATE_SIGN, [-1.0, -1.0, 1.0], [1.0, -1.0, -1.0], _ACTION_SIGN]
)
_PRIVILEGED_SOURCE: Final = np.array([0, 1, 2, 3, 4, 5, 6, 8, 7, 10, 9, 13, 14, 11, 12, 15, 16])
_PRIVILEGED_SIGN: Final = np.array([1, -1, 1, -1, -1, 1, 1, 1, 1, 1, 1, 1, -1, 1, -1, 1, 1.0])


def mirrored(
    env: VecEnv, obs: TensorDict | None, actions: torch.Tensor | None
) -> tuple[TensorDict | None, torch.Tensor | None]:
    """Append the mirror image of each sample to a batch (`data_augmentation_func` of rsl-rl)."""
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
