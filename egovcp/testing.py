"""An untrained world model and random training data, for tests of plugins and applications."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from egovcp import spec
from egovcp.data.episode import Episode
from egovcp.data.privileged import DIM as PRIVILEGED_DIM
from egovcp.model import PRESETS, Batch, WorldModel, WorldModelConfig
from egovcp.robot_spec import G1, RobotSpec

__all__ = ["random_batch", "random_episode", "toy_model"]


def toy_model(
    preset: str | WorldModelConfig = "debug", seed: int = 0, robot: RobotSpec = G1
) -> WorldModel:
    """An untrained world model whose value, termination and reward heads depend on their inputs.

    The last layers of a new `WorldModel` are zero, so its predictions are constants, which would
    hide errors.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = WorldModel(PRESETS[preset] if isinstance(preset, str) else preset, robot)
        for head in (model.value_head, model.termination_head, model.reward_head):
            if head is not None:
                last = head.rest[-1]
                assert isinstance(last, nn.Linear)
                nn.init.normal_(last.weight, std=0.3)
    return model.eval()


def random_batch(size: int = 4, length: int = 8, seed: int = 0) -> Batch:
    """A training batch [B, T] of noise; all steps are valid and each window starts an episode."""
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
        reward=torch.randn(shape, generator=rng),
        privileged=torch.randn((*shape, PRIVILEGED_DIM), generator=rng),
    )


def random_episode(
    number: int,
    length: int = 12,
    time_limit: int | None = None,
    task: str = "ball",
    seed: int = 0,
    robot: RobotSpec = G1,
) -> Episode:
    """A valid episode of noise whose commanded targets agree with its actions.

    It ends by termination if ``length`` is less than ``time_limit`` (default: ``length``).
    """
    rng = np.random.default_rng((seed, number))
    limit = time_limit or length
    last = np.arange(length) == length - 1
    pixels = (length, *robot.depth)
    depth = rng.integers(280, round(1000 * robot.depth_max_m), pixels).astype(np.uint16)
    depth[rng.random(pixels) < 0.1] = 0
    action = rng.uniform(-1, 1, (length, robot.action_dim)).astype(np.float32)
    terms = rng.normal(size=(length, len(spec.REWARD_TERMS))).astype(np.float32)
    terms[:, -len(spec.ACTION_TERMS) :] = 0.0  # not in the target of Q
    return Episode(
        depth=depth,
        state=_state(rng, action, robot),
        action=action,
        reward=terms.sum(1),
        done=last,
        success=rng.random(length) < 0.1,
        truncated=last & (length == limit),
        task=task,
        time_limit=limit,
        metadata={"seed": seed, "episode": number, "ball": {"radius": 0.1}},
        reward_terms=terms,
        object=np.column_stack([rng.normal(size=(length, 3)), np.ones(length)]).astype(np.float32),
        robot=robot,
    )


def _state(
    rng: np.random.Generator, action: NDArray[np.float32], robot: RobotSpec
) -> NDArray[np.float32]:
    """(T, S) proprioception; of the G1, its command is the previous action."""
    state = rng.normal(size=(len(action), robot.state_dim)).astype(np.float32)
    if not robot.is_g1:
        return state
    before = np.vstack([np.zeros((1, spec.ACTION_DIM)), action[:-1]])
    hands, height = spec.STATE_SLICES["command_hands"], spec.STATE_SLICES["command_height"]
    state[:, hands.start : height.stop] = spec.ACTION_BOX.to_metric(before)
    return state
