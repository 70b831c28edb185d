"""What the model knows of episodes it was not trained on."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from egovcp.model import Batch, WorldModel
from egovcp.model.latent_state import kl_divergence
from egovcp.model.losses import Rollout, filter_sequence
from egovcp_train.heldout.calibration import calibration

ACTIVE_NATS = 0.01  # a latent dimension with less KL than this carries nothing


class Summary:
    """Metrics over all tasks together, summed over batches of whole episodes."""

    def __init__(self) -> None:
        self._totals: dict[str, list[float]] = {}
        self._values: list[Tensor] = []
        self._returns: list[Tensor] = []

    def add(self, model: WorldModel, batch: Batch, rollout: Rollout) -> None:
        """Measure one batch, filtered as ``rollout``."""
        kl = kl_divergence(rollout.posterior, rollout.prior)[batch.valid].mean(0)
        self._totals.setdefault("latent/kl", []).append(float(kl.sum()))
        self._totals.setdefault("latent/active", []).append(float((kl > ACTIVE_NATS).sum()))
        usable = batch.valid & batch.mc_valid
        self._values.append(model.value(rollout.carry, batch.action)[usable])
        self._returns.append(batch.mc_return[usable])

    def result(self) -> dict[str, float]:
        """The metrics, see `evaluate`."""
        metrics = {name: sum(v) / len(v) for name, v in self._totals.items()}
        return {
            **metrics,
            **_calibration(torch.cat(self._values), torch.cat(self._returns)),
        }


@torch.no_grad()
def evaluate(model: WorldModel, batches: Iterable[Batch]) -> dict[str, float]:
    """Held-out metrics over batches of whole episodes.

    value/r2         variance of the Monte Carlo return that Q explains
    value/slope      regression of the return on Q: 1 is calibrated
    latent/active    dimensions of z that carry information
    """
    model.eval()
    summary = Summary()
    for batch in batches:
        # as on the robot
        summary.add(model, batch, filter_sequence(model, batch, sample=False))
    return summary.result()


def _calibration(value: Tensor, target: Tensor) -> dict[str, float]:
    if target.numel() < 2:
        return {}
    found = calibration(value, target)
    return {f"value/{k}": v for k in ("r2", "slope") if (v := found[k]) is not None}
