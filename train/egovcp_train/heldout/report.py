"""Measurements of a model on held-out episodes, task by task."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from egovcp.data import EpisodeStore
from egovcp.data.index import evenly_spaced
from egovcp.data.store import gather
from egovcp.errors import DataError
from egovcp.model import Batch, Carry, WorldModel
from egovcp.model.latent_state import kl_divergence
from egovcp.model.losses import Rollout, filter_sequence
from egovcp.model.privileged_value import PrivilegedValue, sample_actions
from egovcp.model.value_losses import privileged_targets
from egovcp.robot_spec import G1, RobotSpec
from egovcp_train.datasets import to_tensors
from egovcp_train.heldout.open_loop import ImageStrip, OpenLoop, image_strips, select_strips

EPISODES_AT_ONCE: Final = 16
RANKED_ACTIONS: Final = 16
OPEN_LOOP_EPISODES: Final = 64
"""Of each task, for open-loop predictions, which take most of the time."""
ACTIVE_NATS: Final = 0.01  # KL below which a latent dimension carries no information
TERMINATION_HORIZONS: Final = (1, 5, 25)  # rows; D is trained on the first
_FLAT: Final = 1e-12  # variance, units of return squared, below which something is constant


class EpisodeBatch(NamedTuple):
    """Whole episodes of one task, padded to the longest."""

    task: str
    batch: Batch
    open_loop: bool = True
    """Whether open-loop predictions are measured on it."""


def episode_batches(
    store: EpisodeStore, device: torch.device, per_task: int | None = None
) -> Iterator[EpisodeBatch]:
    """The episodes of a store, task by task.

    Args:
        per_task: at most this many episodes of each task, evenly spread; None: all.
    """
    for task in sorted(set(store.tasks)):
        own = evenly_spaced(np.flatnonzero(np.array(store.tasks) == task), per_task)
        own = own[np.argsort(store.length[own], kind="stable")]  # little padding
        groups = np.split(own, range(EPISODES_AT_ONCE, len(own), EPISODES_AT_ONCE))
        predicted = evenly_spaced(
            np.arange(len(groups)), max(1, OPEN_LOOP_EPISODES // EPISODES_AT_ONCE)
        )
        for number, which in enumerate(groups):
            span = int(store.length[which].max())
            batch = to_tensors(gather(store, store.start[which], which, span), device)
            yield EpisodeBatch(task, batch, number in predicted)


# --- calibration of Q ----------------------------------------------------------------
def calibration(value: Tensor, target: Tensor) -> dict[str, float | int | None]:
    """Q against its target, (n,) each.

    Returns:
        rows; bias, mean of Q - target; correlation; r2, share of the target's variance that Q
        explains (below 0 if the mean is a better prediction); slope, regression of the target on Q
        (1: calibrated, above 1: Q varies too little). None where rows or variance are missing.
    """
    out: dict[str, float | int | None] = {"rows": target.numel(), "bias": None}
    out |= {"correlation": None, "r2": None, "slope": None}
    if target.numel() == 0:
        return out
    value, target = value.double(), target.double()
    out["bias"] = float((value - target).mean())
    variance = float(target.var(correction=0))
    if variance > _FLAT:
        out["r2"] = 1 - float((value - target).square().mean()) / variance
    centred = value - value.mean()
    if float(centred.square().mean()) > _FLAT:
        out["slope"] = float((centred * target).mean() / centred.square().mean())
        if variance > _FLAT:
            both = torch.stack([value, target])
            out["correlation"] = float(torch.corrcoef(both)[0, 1])
    return out


def ranking(value: Tensor, target: Tensor) -> float | None:
    """Correlation of the advantages of K actions over their mean, by Q and by its target (n, K).

    None if either does not depend on the action.
    """
    a, b = (x.double() - x.double().mean(1, keepdim=True) for x in (value, target))
    scale = float((a.square().mean() * b.square().mean()).sqrt())
    return float((a * b).mean()) / scale if scale > _FLAT else None


# --- termination ---------------------------------------------------------------------
class TerminationRows(NamedTuple):
    """Predicted and actual failure of rows, (n,) each."""

    logit: Tensor
    """D's log-odds, in the state that the row's action leads to."""
    ahead: Tensor
    """Rows until the failure, 1 if this row's action causes it; 0: no failure."""
    known: Tensor
    """Rows from this one on whose outcome is known."""


def termination_rows(model: WorldModel, batch: Batch, rollout: Rollout) -> TerminationRows:
    """D on every row, as it is trained: on the state imagined one tick ahead."""
    logit = model.termination_logit(model.imagine(rollout.carry, batch.action))
    length = batch.valid.sum(1, keepdim=True)
    to_end = length - torch.arange(batch.valid.shape[1], device=length.device)
    fails = (batch.terminal_next & batch.valid).any(1, keepdim=True).expand_as(to_end)
    ahead = torch.where(fails, to_end, 0)
    # The outcome after a time limit is unknown.
    known = torch.where(fails, torch.iinfo(torch.int64).max, to_end)
    rows = batch.valid
    return TerminationRows(logit[rows].cpu(), ahead[rows].cpu(), known[rows].cpu())


def termination_scores(
    found: list[TerminationRows],
) -> dict[str, dict[str, float | int | None]]:
    """k -> AUC of "fails within k rows" (None without both outcomes), failing, rows."""
    logit, ahead, known = (torch.cat(x) for x in zip(*found, strict=True))
    out: dict[str, dict[str, float | int | None]] = {}
    for k in TERMINATION_HORIZONS:
        usable = known >= k
        failing = ((ahead > 0) & (ahead <= k))[usable]
        out[str(k)] = {
            "auc": auc(logit[usable], failing),
            "failing": int(failing.sum()),
            "rows": int(usable.sum()),
        }
    return out


def auc(score: Tensor, positive: Tensor) -> float | None:
    """Area under the ROC curve of (n,) from the ranks (Mann and Whitney), ties counting half.

    None without positives or without negatives.
    """
    positives = int(positive.sum())
    negatives = positive.numel() - positives
    if positives == 0 or negatives == 0:
        return None
    _, place, count = torch.unique(score, return_inverse=True, return_counts=True)
    last = count.cumsum(0).double()
    rank = (last - (count.double() - 1) / 2)[place]  # from 1; ties share their mean
    above = rank[positive].sum() - positives * (positives + 1) / 2
    return float(above) / (positives * negatives)


# --- report --------------------------------------------------------------------------
class Values(NamedTuple):
    """Q and its target at rows that have one, for the recorded action and K - 1 sampled ones."""

    value: Tensor  # (n, K)
    target: Tensor  # (n, K)

    def measures(self) -> dict[str, float | int | None]:
        """`calibration` for the recorded action, and `ranking` of several actions."""
        found = calibration(self.value[:, 0], self.target[:, 0])
        several = self.value.shape[1] > 1
        return found | ({"ranking": ranking(*self)} if several else {})


class HeldoutReport(NamedTuple):
    """All measurements."""

    metrics: dict[str, float]
    """Over all tasks: value/r2, value/slope, value/ranking (see `Values`), latent/kl (nats per
    row), latent/active (dimensions of z that carry information) and object_rmse_m (see
    `TaskMeasurements`)."""
    tasks: dict[str, dict[str, Any]]
    """Task -> episodes, rows, depth, state, termination, value, latent and object_rmse_m, which is
    None if it is unknown; JSON-able."""
    values: dict[str, Values]
    """Task -> Q and its target, for pictures."""
    strips: dict[str, list[ImageStrip]]
    """Task -> some open-loop predictions, for pictures."""
    planner_hz: int = G1.planner_hz
    """Ticks per second."""


class TaskMeasurements:
    """Measurements of one task, summed over batches of its episodes."""

    def __init__(
        self, stride: int, robot: RobotSpec = G1, critic: PrivilegedValue | None = None
    ) -> None:
        self._critic = critic
        self.episodes = self.rows = 0
        self.open_loop = OpenLoop(stride, robot)
        self.termination: list[TerminationRows] = []
        self.strips: list[ImageStrip] = []
        self.kl = torch.zeros(0)
        """Sum over the rows, of each dimension of z."""
        self.object_error = self.object_rows = 0.0
        """Sum of squared distances of the object's decoded from its known position, m^2, and
        rows; 0 for a model that does not decode it."""
        self._values: list[Values] = []

    def add(self, model: WorldModel, batch: Batch, open_loop: bool) -> None:
        """Filter a batch of episodes as on the robot, and measure it."""
        rollout = filter_sequence(model, batch)
        self.episodes += len(batch.valid)
        self.rows += int(batch.valid.sum())
        if open_loop:
            self.open_loop.add(model, batch, rollout)
            self.strips = select_strips([*self.strips, *image_strips(model, batch, rollout)])
        self.termination.append(termination_rows(model, batch, rollout))
        self._values.append(self._compare(model, rollout.carry, batch))
        if model.object_head is not None:
            known = batch.valid & batch.object_known
            error = (model.object_position(rollout.carry) - batch.object[..., :3])[known]
            self.object_error += float(error.double().square().sum())
            self.object_rows += len(error)
        kl = kl_divergence(rollout.posterior, rollout.prior)[batch.valid].double().sum(0).cpu()
        self.kl = kl + self.kl if len(self.kl) else kl

    def _compare(self, model: WorldModel, carry: Carry, batch: Batch) -> Values:
        """Q and its target."""
        action = batch.action[:, :, None]
        if self._critic is None:
            target, usable = batch.mc_return[..., None], batch.valid & batch.mc_valid
        else:
            generator = torch.Generator(device=action.device).manual_seed(0)
            others = sample_actions(batch.prev_action, RANKED_ACTIONS - 1, generator)
            action = torch.cat([action, others], 2)
            found = privileged_targets(model, batch, self._critic, action)
            target, usable = found.value * model.return_std + model.return_mean, found.usable
        value = model.value(carry.map(lambda x: x[:, :, None]), action)
        return Values(value[usable].cpu(), target[usable].cpu())

    @property
    def values(self) -> Values:
        """Q and its target of all batches."""
        return Values(*(torch.cat(x) for x in zip(*self._values, strict=True)))

    def result(self) -> dict[str, Any]:
        """The measurements, JSON-able."""
        kl = self.kl / self.rows
        return {
            "episodes": self.episodes,
            "rows": self.rows,
            "depth": self.open_loop.depth(),
            "state": self.open_loop.state(),
            "termination": termination_scores(self.termination),
            "value": self.values.measures(),
            "latent": {
                "active": int((kl > ACTIVE_NATS).sum()),
                "dimensions": len(kl),
                "share": float((kl > ACTIVE_NATS).double().mean()),
                "kl_nats": float(kl.sum()),
            },
            "object_rmse_m": rmse([self]),
        }


def rmse(tasks: Sequence[TaskMeasurements]) -> float | None:
    """Root mean squared error of the object's position over some tasks, m; None: unknown."""
    rows = sum(task.object_rows for task in tasks)
    return math.sqrt(sum(task.object_error for task in tasks) / rows) if rows else None


@torch.no_grad()
def measure(
    model: WorldModel,
    episodes: Iterable[EpisodeBatch],
    stride: int = 4,
    stopped: Callable[[], bool] = lambda: False,
    critic: PrivilegedValue | None = None,
) -> HeldoutReport:
    """Measure a model.

    Args:
        stride: rows between the starts of open-loop predictions.
        stopped: once it returns true, the remaining episodes are left out.
        critic: the target of Q; None: the return of the data's actions.

    Raises:
        DataError: there are no episodes.
        KeyboardInterrupt: it was stopped before anything was measured.
    """
    model.eval()
    tasks: dict[str, TaskMeasurements] = {}
    for task, batch, open_loop in episodes:
        if stopped():
            break
        if task not in tasks:
            tasks[task] = TaskMeasurements(stride, model.robot, critic)
        tasks[task].add(model, batch, open_loop)
    if not tasks:
        if stopped():
            raise KeyboardInterrupt
        raise DataError("no episodes to measure")
    values = {task: found.values for task, found in tasks.items()}
    return HeldoutReport(
        _over_all_tasks(list(tasks.values()), list(values.values())),
        {task: found.result() for task, found in tasks.items()},
        values,
        {task: found.strips for task, found in tasks.items()},
        model.robot.planner_hz,
    )


def _over_all_tasks(tasks: list[TaskMeasurements], values: list[Values]) -> dict[str, float]:
    kl = torch.stack([task.kl for task in tasks]).sum(0) / sum(task.rows for task in tasks)
    found = Values(*(torch.cat(x) for x in zip(*values, strict=True))).measures()
    names = ("r2", "slope", "ranking")
    error = rmse(tasks)
    return {
        **({} if error is None else {"object_rmse_m": error}),
        "latent/kl": float(kl.sum()),
        "latent/active": float((kl > ACTIVE_NATS).sum()),
        **{f"value/{name}": v for name in names if (v := found.get(name)) is not None},
    }


def scalars(tasks: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The report as one number per name, such as ``wall/depth_near_h4``, without those of None."""
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
        for name in ("slope", "r2", "bias", "correlation", "ranking"):
            found[f"{task}/value_{name}"] = report["value"].get(name)
        found[f"{task}/latent_active_share"] = report["latent"]["share"]
        found[f"{task}/object_rmse_m"] = report["object_rmse_m"]
    return {name: value for name, value in found.items() if value is not None}
