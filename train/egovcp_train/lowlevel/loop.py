"""What goes on around N robots in training, whatever simulates them.

Commands, the policy's surroundings (`Walk`), what policy and critic see, and the rewards. The CPU
environment (`env`) and the mjlab task (`mjlab_terms`) hold one each and bring physics and resets.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.walking import ACTIONS, Walk, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp.sim.robot import noise_std
from egovcp.spec import CONTROLLER_HZ
from egovcp_train.lowlevel import rewards, sensing
from egovcp_train.lowlevel.camera import TorsoMotion
from egovcp_train.lowlevel.commands import Commands
from egovcp_train.lowlevel.physics import Snapshot
from egovcp_train.lowlevel.task import LowLevelTask

Array = NDArray[np.float64]
_RECOVERY_TICKS: Final = 2 * CONTROLLER_HZ  # after a push, in which steps cost nothing


class Loop:
    """Each tick: `targets`, physics, `judge`, new commands, `restart` of some, `observe`."""

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
        self._motion = rewards.Motion(robots)
        self._torso = TorsoMotion(robots)
        self._unpushed = np.full(robots, _RECOVERY_TICKS)  # ticks since the last push, up to that
        self._noise = noise_std(sensors)
        self._action: Array = np.zeros((robots, ACTIONS))
        self._last_action: Array = np.zeros((robots, ACTIONS))
        self._fresh = np.ones(robots, dtype=np.bool_)

    @property
    def difficulty(self) -> float:
        """0 .. 1; raised by the trainer as the policy succeeds."""
        return self.commands.difficulty

    @difficulty.setter
    def difficulty(self, value: float) -> None:
        self.commands.difficulty = float(np.clip(value, 0.0, 1.0))

    def targets(self, action: NDArray[np.floating]) -> Array:
        """The policy's actions (N, 15) -> joint targets (N, 29), rad."""
        self._last_action, self._action = self._action, np.array(action, dtype=np.float64)
        return self.walk.targets(self._action)

    def judge(self, x: Snapshot) -> dict[str, Array]:
        """Reward terms of the tick but the fall, (N,) per second; sets ``fallen``.

        They are as wild as the state is; `rewards.earned` says what counts.
        """
        self._motion.add(x)
        self._torso.add(x)
        self._unpushed = np.minimum(self._unpushed + 1, _RECOVERY_TICKS)
        walk, gait = self.walk, self.walk.gait
        self.fallen = rewards.fallen(x, walk.height, walk.pitch)
        return rewards.terms(
            x,
            self._motion.average,
            self.commands.vector,
            walk.height,
            walk.pitch,
            gait.phase,
            gait.amount,
            self._action,
            self._last_action,
            self._torso,
            self._unpushed < _RECOVERY_TICKS,
        )

    def pushed(self, rows: NDArray[np.intp]) -> None:
        """``rows`` have just been pushed: steps cost nothing for a while."""
        self._unpushed[rows] = 0

    def restart(self, rows: NDArray[np.intp]) -> None:
        """``rows`` begin new episodes, in the posture that `observe` will find."""
        self.commands.reset(rows)
        self._motion.reset(rows)
        self._torso.reset(rows)
        self._unpushed[rows] = _RECOVERY_TICKS
        self._action[rows] = 0.0
        self._fresh[rows] = True

    def observe(
        self, x: Snapshot, friction: Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What the policy sees (N, 95), and what only the critic sees (N, 16).

        Args:
            x: the true state.
            friction: (N,) of the feet.
        """
        if self._fresh.any():  # as on the robot, one measurement to start from, the next to act on
            rows = None if self._fresh.all() else np.flatnonzero(self._fresh)
            self.walk.reset(self._measure(x), rows)
            self._fresh[:] = False
        seen = self.walk.observe(self._measure(x))
        return seen, sensing.privileged(x, self._motion.average, self.walk.height, friction)

    def _measure(self, x: Snapshot) -> Array:
        return sensing.measure(x, self.commands.vector, self._noise, self.rng)
