"""All held-out measures of a model, task by task."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from egovcp.errors import DataError
from egovcp.model import Batch, WorldModel
from egovcp.model.latent_state import kl_divergence
from egovcp.model.losses import Rollout, filter_sequence
from egovcp_train.evaluation import ACTIVE_NATS, Summary
from egovcp_train.heldout.calibration import calibration
from egovcp_train.heldout.episodes import Recorded
from egovcp_train.heldout.open_loop import OpenLoop
from egovcp_train.heldout.strips import Strip, best, strips
from egovcp_train.heldout.termination import Foretold, foretell, termination_scores


class Values(NamedTuple):
    """Rows whose return is complete, (n,) each."""

    value: Tensor
    target: Tensor


class Report(NamedTuple):
    """What was measured."""

    metrics: dict[str, float]
    """Over all tasks, see `egovcp_train.evaluation.evaluate`."""
    tasks: dict[str, dict[str, Any]]
    """Task -> episodes, rows, depth, state, termination, value, latent; JSON-able."""
    values: dict[str, Values]
    """Task -> Q and returns, for pictures."""
    strips: dict[str, list[Strip]]
    """Task -> some open-loop predictions, for pictures."""


class TaskReport:
    """The measures of one task, summed over groups of its episodes."""

    def __init__(self, stride: int) -> None:
        self.episodes = self.rows = 0
        self.open_loop = OpenLoop(stride)
        self.foretold: list[Foretold] = []
        self.values: list[Values] = []
        self.kl: list[Tensor] = []
        self.strips: list[Strip] = []

    def add(self, model: WorldModel, episodes: Recorded, rollout: Rollout) -> None:
        """Measure one group of episodes."""
        batch = episodes.batch
        self.episodes += len(batch.valid)
        self.rows += int(batch.valid.sum())
        self.open_loop.add(model, episodes, rollout)
        self.foretold.append(foretell(model, batch, rollout))
        self.values.append(_values(model, batch, rollout))
        self.strips = best([*self.strips, *strips(model, episodes, rollout)])
        kl = kl_divergence(rollout.posterior, rollout.prior)[batch.valid]
        self.kl.append(kl.double().sum(0).cpu())

    def all_values(self) -> Values:
        """Those of all groups."""
        return Values(*(torch.cat(x) for x in zip(*self.values, strict=True)))

    def result(self) -> dict[str, Any]:
        """The measures, JSON-able."""
        kl = torch.stack(self.kl).sum(0) / self.rows
        return {
            "episodes": self.episodes,
            "rows": self.rows,
            "depth": self.open_loop.depth(),
            "state": self.open_loop.state(),
            "termination": termination_scores(self.foretold),
            "value": calibration(*self.all_values()),
            "latent": {
                "active": int((kl > ACTIVE_NATS).sum()),
                "dimensions": len(kl),
                "share": float((kl > ACTIVE_NATS).double().mean()),
                "kl_nats": float(kl.sum()),
            },
        }


@torch.no_grad()
def measure(
    model: WorldModel,
    episodes: Iterable[Recorded],
    stride: int = 4,
    stopped: Callable[[], bool] = lambda: False,
) -> Report:
    """Filter the episodes once, as the robot does, and measure everything.

    Args:
        model: the model.
        episodes: groups of episodes.
        stride: rows between the starts of open-loop predictions.
        stopped: once it returns true, the rest of the episodes is left out.

    Raises:
        DataError: there are no episodes.
        KeyboardInterrupt: it was stopped before anything was measured.
    """
    model.eval()
    summary = Summary()
    tasks: dict[str, TaskReport] = {}
    for group in episodes:
        if stopped():
            break
        rollout = filter_sequence(model, group.batch, sample=False)
        summary.add(model, group.batch, rollout)
        tasks.setdefault(group.task, TaskReport(stride)).add(model, group, rollout)
    if not tasks:
        if stopped():
            raise KeyboardInterrupt
        raise DataError("no episodes to measure")
    return Report(
        summary.result(),
        {task: found.result() for task, found in tasks.items()},
        {task: found.all_values() for task, found in tasks.items()},
        {task: found.strips for task, found in tasks.items()},
    )


def _values(model: WorldModel, batch: Batch, rollout: Rollout) -> Values:
    usable = batch.valid & batch.mc_valid
    value = model.value(rollout.carry, batch.action)
    return Values(value[usable].cpu(), batch.mc_return[usable].cpu())


def scalars(tasks: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The report as one number per name, ``wall/depth_near_h4``; what is None is left out."""
    found: dict[str, float | None] = {}
    for task, report in tasks.items():
        for kind, model, repeat in (
            ("depth", "model_mm", "repeat_mm"),
            ("state", "model", "repeat"),
        ):
            for part, horizons in report[kind].items():
                for k, errors in horizons.items():
                    found[f"{task}/{kind}_{part}_h{k}"] = errors[model]
                    found[f"{task}/{kind}_{part}_repeat_h{k}"] = errors[repeat]
        for k, scores in report["termination"].items():
            found[f"{task}/termination_auc_{k}"] = scores["auc"]
        for name in ("slope", "r2", "bias"):
            found[f"{task}/value_{name}"] = report["value"][name]
        found[f"{task}/latent_active"] = report["latent"]["share"]
    return {name: value for name, value in found.items() if value is not None}
