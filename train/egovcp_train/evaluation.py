"""What the model knows of episodes it was not trained on."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from egovcp.model import Batch, Carry, WorldModel
from egovcp.model.gaussian import kl_divergence
from egovcp.model.losses import filter_sequence, moving_pixels
from egovcp.model.world_model import PASSING_UNIT

OPEN_LOOP_HORIZONS = (1, 4, 8)
CONTEXT = 4  # frames filtered before an open-loop prediction starts
MIN_SPREAD = 0.01  # squared units; one throw alone has no spread of which a share could be foreseen
ACTIVE_NATS = 0.01  # a latent dimension with less KL than this carries nothing


@torch.no_grad()
def evaluate(model: WorldModel, batches: Iterable[Batch]) -> dict[str, float]:
    """Held-out metrics, averaged over batches of whole episodes.

    value/r2         variance of the Monte Carlo return that Q explains
    value/slope      regression of the return on Q: 1 is calibrated
    depth/moving_hK  RMS error, metres, on moving pixels, K ticks ahead without observation
    depth/repeat_hK  the same for repeating the last image
    passing/r2_X     variance of where (y, z) and when (time) something will pass that is foreseen
    passing/seen     share of the rows in which it is right whether anything is on its way
    latent/active    dimensions of z that carry information
    """
    model.eval()
    totals: dict[str, list[float]] = {}
    values: list[Tensor] = []
    returns: list[Tensor] = []
    passing: list[tuple[Tensor, Tensor]] = []
    for batch in batches:
        rollout = filter_sequence(model, batch, sample=False)  # as on the robot
        kl = kl_divergence(rollout.posterior, rollout.prior)[batch.valid].mean(0)
        totals.setdefault("latent/kl", []).append(float(kl.sum()))
        totals.setdefault("latent/active", []).append(float((kl > ACTIVE_NATS).sum()))
        usable = batch.valid & batch.mc_valid
        values.append(model.value(rollout.carry, batch.action)[usable])
        returns.append(batch.mc_return[usable])
        label = batch.passing.masked_fill(~batch.valid[..., None], 0.0)
        passing.append((model.decode_passing(rollout.carry.h, rollout.carry.z), label))
        for name, error in _open_loop(model, batch, rollout.carry, rollout.near).items():
            totals.setdefault(name, []).append(error)
    metrics = {name: sum(v) / len(v) for name, v in totals.items()}
    foreseen, labels = (
        torch.cat([x.flatten(0, 1) for x in xs]) for xs in zip(*passing, strict=True)
    )
    return {
        **metrics,
        **_passing(foreseen, labels),
        **_calibration(torch.cat(values), torch.cat(returns)),
    }


def _passing(output: Tensor, label: Tensor) -> dict[str, float]:
    known, on = label[:, 4] > 0, label[:, 3] > 0
    if not on.any():
        return {}
    right = ((output[:, 3] > 0) == on)[known].float().mean()
    error = output[on, :3] - label[on, :3] / label.new_tensor(PASSING_UNIT)
    spread = (label[on, :3] / label.new_tensor(PASSING_UNIT)).var(0, correction=0)
    if spread.min() < MIN_SPREAD:
        return {"passing/seen": float(right)}
    r2 = 1 - error.square().mean(0) / spread
    names = ("passing/r2_y", "passing/r2_z", "passing/r2_time")
    return {"passing/seen": float(right), **dict(zip(names, r2.tolist(), strict=True))}


def _calibration(value: Tensor, target: Tensor) -> dict[str, float]:
    if target.numel() < 2:
        return {}
    residual = (value - target).square().mean()
    spread = target.var(correction=0).clamp_min(1e-12)
    centred = value - value.mean()
    slope = (centred * target).mean() / centred.square().mean().clamp_min(1e-12)
    return {"value/r2": float(1 - residual / spread), "value/slope": float(slope)}


def _open_loop(model: WorldModel, batch: Batch, carry: Carry, near: Tensor) -> dict[str, float]:
    """RMS depth error on moving pixels, imagined from every row after the context."""
    length = batch.valid.shape[1]
    last_start = length - max(OPEN_LOOP_HORIZONS)
    if last_start <= CONTEXT:
        return {}
    rows = slice(CONTEXT, last_start)
    start = Carry(carry.h[:, rows], carry.z[:, rows])
    errors: dict[str, float] = {}
    for k in range(1, max(OPEN_LOOP_HORIZONS) + 1):
        start = model.imagine(start, batch.action[:, CONTEXT + k - 1 : last_start + k - 1])
        if k not in OPEN_LOOP_HORIZONS:
            continue
        ahead = slice(CONTEXT + k, last_start + k)
        mask = (moving_pixels(near, 0.04)[:, ahead] > 0) & batch.valid[:, ahead, None, None]
        if not mask.any():
            continue
        truth = near[:, ahead]
        image = model.decode_depth(start.features.flatten(0, 1)).view_as(truth)
        scale = model.config.depth_max_m
        errors[f"depth/moving_h{k}"] = scale * _rms((image - truth)[mask])
        errors[f"depth/repeat_h{k}"] = scale * _rms((near[:, rows] - truth)[mask])
    return errors


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())
