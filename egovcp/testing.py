"""Toy worlds and counting fakes that prove time, resets and actions line up.

For tests of egovcp and of anything built on it. Each fake makes one thing visible that a
real network hides: which action led where, how many ticks have passed since a reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from egovcp import spec
from egovcp.model import PRESETS, Batch, Carry, WorldModel
from egovcp.model.nets import ValueHead


# --- planning ----------------------------------------------------------------------
class Point(NamedTuple):
    """State of `PointWorld`."""

    position: Tensor  # (..., 7)
    goal: Tensor  # (..., 7)


class PointWorld:
    """A point that jumps to each action; Q is minus the squared distance of action and goal.

    Its best plan is known: walk straight to the goal. Beyond ``cliff`` in the first
    coordinate the point has fallen.
    """

    def __init__(self, cliff: float = np.inf, floor: float = -100.0) -> None:
        self.cliff = cliff
        self.return_floor = torch.tensor(floor)

    @staticmethod
    def start(executed: Tensor, goal: Tensor) -> Point:
        """Robots at their last executed actions (E, 7), each with a goal (E, 7)."""
        return Point(executed, goal.expand_as(executed))

    def spread(self, carry: Point) -> Point:
        return Point(carry.position[:, None], carry.goal[:, None])

    def imagine(self, carry: Point, action: Tensor) -> Point:
        return Point(action, carry.goal)

    def value(self, carry: Point, action: Tensor) -> Tensor:
        return -(action - carry.goal).square().sum(-1)

    def termination(self, carry: Point) -> Tensor:
        return (carry.position[..., 0] > self.cliff).to(carry.position.dtype)


class ScriptedWorld:
    """Q and D read from a script, whatever the actions: tick k has ``values[k]``, ``deaths[k]``.

    The carry is the tick, so a value or a termination asked for at the wrong time shows.
    """

    def __init__(
        self, values: Sequence[float], deaths: Sequence[float], floor: float = 0.0
    ) -> None:
        self.values, self.deaths = torch.tensor(values), torch.tensor(deaths)
        self.return_floor = torch.tensor(floor)

    def start(self, robots: int = 1) -> Tensor:
        """Tick 0 for every robot, (E,)."""
        return torch.zeros(robots, dtype=torch.long)

    def spread(self, carry: Tensor) -> Tensor:
        return carry[:, None]

    def imagine(self, carry: Tensor, action: Tensor) -> Tensor:
        return (carry + 1).expand(action.shape[:-1])

    def value(self, carry: Tensor, action: Tensor) -> Tensor:
        return self.values[carry].expand(action.shape[:-1])

    def termination(self, carry: Tensor) -> Tensor:
        return self.deaths[carry]


# --- world models --------------------------------------------------------------------
def toy_model(preset: str = "debug", seed: int = 0) -> WorldModel:
    """An untrained world model whose heads answer differently to different questions.

    A new `WorldModel` predicts constants for value and termination, which hides mistakes.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = WorldModel(PRESETS[preset])
        for head in (model.value_head, model.passing_value_head, model.termination_head):
            if head is None:
                continue
            last = (head.mlp if isinstance(head, ValueHead) else head).rest[-1]
            assert isinstance(last, nn.Linear)
            nn.init.normal_(last.weight, std=0.3)
    return model.eval()


class CountingModel(WorldModel):
    """Counts instead of thinking: h[:, 0] is the number of observations since the reset,
    z[:, :7] the action that led to the state, h[:, 1] the imagined ticks.

    Q is highest for an action that repeats the last one, shifted by ``drift``.
    """

    COUNT, IMAGINED = 0, 1

    def __init__(self, drift: float = 0.0) -> None:
        super().__init__(PRESETS["debug"])
        self.drift = drift

    def observe(
        self, carry: Carry, action: Tensor, depth: Tensor, state: Tensor, is_first: Tensor
    ) -> Carry:
        first = is_first[:, None]
        h, z = carry.h.masked_fill(first, 0.0), torch.zeros_like(carry.z)
        h[:, self.COUNT] += 1.0
        z[:, : spec.ACTION_DIM] = action.masked_fill(first, 0.0)
        return Carry(h, z)

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        shape = action.shape[:-1]
        h = carry.h.expand(*shape, -1).clone()
        z = carry.z.expand(*shape, -1).clone()
        h[..., self.IMAGINED] += 1.0
        z[..., : spec.ACTION_DIM] = action
        return Carry(h, z)

    def value(self, carry: Carry, action: Tensor) -> Tensor:
        last = carry.z[..., : spec.ACTION_DIM]
        return -(action - last - self.drift).square().sum(-1)

    def termination(self, carry: Carry) -> Tensor:
        return torch.zeros_like(carry.h[..., 0])


# --- batches ---------------------------------------------------------------------------
def random_batch(size: int = 4, length: int = 8, seed: int = 0) -> Batch:
    """Random sequences [B, T]: everything is valid and each window starts an episode."""
    rng = torch.Generator().manual_seed(seed)
    shape = (size, length)
    pixels = torch.randint(
        300, 6000, (*shape, spec.DEPTH_ROWS // 4, spec.DEPTH_COLS // 4), generator=rng
    )
    depth = pixels.repeat_interleave(4, 2).repeat_interleave(4, 3)
    action = torch.rand((*shape, spec.ACTION_DIM), generator=rng) * 2 - 1
    first = torch.zeros(shape, dtype=torch.bool)
    first[:, 0] = True
    return Batch(
        depth=torch.where(depth > 1000 * spec.DEPTH_MAX_M, 0, depth).int(),
        state=torch.randn((*shape, spec.STATE_DIM), generator=rng),
        action=action,
        prev_action=torch.cat([torch.zeros_like(action[:, :1]), action[:, :-1]], 1),
        is_first=first,
        valid=torch.ones(shape, dtype=torch.bool),
        mc_return=torch.randn(shape, generator=rng),
        mc_valid=torch.ones(shape, dtype=torch.bool),
        terminal_next=torch.zeros(shape, dtype=torch.bool),
        passing=torch.rand((*shape, spec.PASSING_DIM), generator=rng).round(),
    )


def memory_batch(size: int = 32, length: int = 6, seed: int = 0) -> Batch:
    """Sequences whose return only memory can tell.

    The first image shows a near block on the left or on the right, later ones nothing.
    The return is +1 or -1 by the block's side, plus the first coordinate of the action.
    """
    rng = torch.Generator().manual_seed(seed)
    batch = random_batch(size, length, seed)
    left = torch.rand(size, generator=rng) < 0.5
    depth = torch.zeros_like(batch.depth)
    half = spec.DEPTH_COLS // 2
    depth[left, 0, :, :half] = 1000
    depth[~left, 0, :, half:] = 1000
    side = torch.where(left, 1.0, -1.0)[:, None]
    return batch._replace(
        depth=depth,
        state=torch.zeros_like(batch.state),
        mc_return=side + batch.action[..., 0],
        passing=torch.zeros_like(batch.passing),
    )


# --- environments ------------------------------------------------------------------------
@dataclass(frozen=True)
class ToyObservation:
    """What `CountingEnv` shows."""

    depth: NDArray[np.uint16]  # (B, 48, 64), mm: 1000 + ticks since the reset
    state: NDArray[np.float32]  # (B, 74): zeros but for the command sent last


@dataclass(frozen=True)
class ToyStep:
    """What a tick of `CountingEnv` brought."""

    observation: ToyObservation
    reward: NDArray[np.float64]
    reward_terms: dict[str, NDArray[np.float64]]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    success: NDArray[np.bool_]
    sent_action: NDArray[np.float64]


class CountingEnv:
    """B robots without a body: the image counts ticks, the state holds the last command.

    A scenario is a whole number, the tick at which the episode is over. The robot falls
    when its commanded height comes within 0.05 of the box's floor.
    """

    def __init__(self, num_envs: int = 2) -> None:
        self.num_envs = num_envs
        self._limit: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        self._tick = np.zeros(num_envs, dtype=np.int64)
        self._fallen = np.zeros(num_envs, dtype=np.bool_)
        self._sent: NDArray[np.float64] = np.zeros((num_envs, spec.ACTION_DIM))

    def reset(self, scenarios: Sequence[int]) -> ToyObservation:
        """Start an episode in every row."""
        self._limit = np.array(scenarios, dtype=np.int64)
        self._tick[:] = 0
        self._fallen[:] = False
        self._sent = np.zeros((self.num_envs, spec.ACTION_DIM))
        return self._observe()

    def step(self, action: NDArray[np.floating]) -> ToyStep:
        """Limit, send, count; rows that are over stay as they are, with zero reward."""
        live = ~self._fallen & (self._tick < self._limit)
        change = np.clip(
            np.asarray(action, dtype=np.float64) - self._sent,
            -spec.ACTION_RATE_LIMIT,
            spec.ACTION_RATE_LIMIT,
        )
        moved = np.clip(self._sent + change, -1.0, 1.0)
        self._sent = np.where(live[:, None], moved, self._sent)
        self._tick += live
        self._fallen |= live & (self._sent[:, -1] < -0.95)
        reward = np.where(live, -np.square(self._sent).mean(1), 0.0)
        return ToyStep(
            observation=self._observe(),
            reward=reward,
            reward_terms={"effort": reward},
            terminated=self._fallen.copy(),
            truncated=~self._fallen & (self._tick >= self._limit),
            success=np.zeros(self.num_envs, dtype=np.bool_),
            sent_action=self._sent.copy(),
        )

    def _observe(self) -> ToyObservation:
        image = (1000 + self._tick).astype(np.uint16)[:, None, None]
        depth = np.broadcast_to(image, (self.num_envs, spec.DEPTH_ROWS, spec.DEPTH_COLS))
        state = np.zeros((self.num_envs, spec.STATE_DIM), dtype=np.float32)
        state[:, spec.STATE_SLICES["projected_gravity"].stop - 1] = -1.0
        hands, height = spec.STATE_SLICES["command_hands"], spec.STATE_SLICES["command_height"]
        state[:, hands.start : height.stop] = spec.ACTION_BOX.to_metric(self._sent)
        return ToyObservation(depth.copy(), state)
