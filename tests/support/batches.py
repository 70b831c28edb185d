"""Training batches with known structure."""

from __future__ import annotations

import torch

from egovcp import spec
from egovcp.model import Batch
from egovcp.testing import random_batch


def memory_batch(size: int = 32, length: int = 6, seed: int = 0) -> Batch:
    """Sequences whose return can only be predicted from memory.

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
        privileged=torch.zeros_like(batch.privileged),
    )
