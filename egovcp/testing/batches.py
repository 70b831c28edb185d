"""Training batches made of random numbers."""

from __future__ import annotations

import torch

from egovcp import spec
from egovcp.model import Batch


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
        reward=torch.randn(shape, generator=rng),
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
    )
