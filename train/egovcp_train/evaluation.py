"""What the model knows of episodes it was not trained on."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from egovcp.model import Batch, WorldModel
from egovcp.model.gaussian import kl_divergence
from egovcp.model.losses import Rollout, filter_sequence
from egovcp.model.world_model import PASSING_UNIT
from egovcp_train.heldout.calibration import calibration

MIN_SPREAD = 0.01  # squared units; one throw alone has no spread of which a share could be foreseen
ACTIVE_NATS = 0.01  # a latent dimension with less KL than this carries nothing


class Summary:
    """Metrics over all tasks together, summed over batches of whole episodes."""

    def __init__(self) -> None:
        self._totals: dict[str, list[float]] = {}
        self._values: list[Tensor] = []
        self._returns: list[Tensor] = []
        self._passing: list[tuple[Tensor, Tensor]] = []

    def add(self, model: WorldModel, batch: Batch, rollout: Rollout) -> None:
        """Measure one batch, filtered as ``rollout``."""
        kl = kl_divergence(rollout.posterior, rollout.prior)[batch.valid].mean(0)
        self._totals.setdefault("latent/kl", []).append(float(kl.sum()))
        self._totals.setdefault("latent/active", []).append(float((kl > ACTIVE_NATS).sum()))
        usable = batch.valid & batch.mc_valid
        self._values.append(model.value(rollout.carry, batch.action)[usable])
        self._returns.append(batch.mc_return[usable])
        label = batch.passing.masked_fill(~batch.valid[..., None], 0.0)
        foreseen = model.decode_passing(rollout.carry.h, rollout.carry.z)
        self._passing.append((foreseen.flatten(0, 1), label.flatten(0, 1)))

    def result(self) -> dict[str, float]:
        """The metrics, see `evaluate`."""
        metrics = {name: sum(v) / len(v) for name, v in self._totals.items()}
        foreseen, labels = (torch.cat(xs) for xs in zip(*self._passing, strict=True))
        return {
            **metrics,
            **_passing(foreseen, labels),
            **_calibration(torch.cat(self._values), torch.cat(self._returns)),
        }


@torch.no_grad()
def evaluate(model: WorldModel, batches: Iterable[Batch]) -> dict[str, float]:
    """Held-out metrics over batches of whole episodes.

    value/r2         variance of the Monte Carlo return that Q explains
    value/slope      regression of the return on Q: 1 is calibrated
    passing/r2_X     variance of where (y, z) and when (time) something will pass that is foreseen
    passing/seen     share of the rows in which it is right whether anything is on its way
    latent/active    dimensions of z that carry information
    """
    model.eval()
    summary = Summary()
    for batch in batches:
        # as on the robot
        summary.add(model, batch, filter_sequence(model, batch, sample=False))
    return summary.result()


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
    found = calibration(value, target)
    return {f"value/{k}": v for k in ("r2", "slope") if (v := found[k]) is not None}
