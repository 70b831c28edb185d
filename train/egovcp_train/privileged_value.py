"""Fit of the privileged value, before the world model is trained.

`egovcp.model.privileged_value` says what it is for. It is fitted Q iteration (Ernst et al. 2005):
Q(s, a) is regressed on r + gamma Q(s', a'), where a' is the action that the planner would choose in
s', the best of some sampled ones. So it is the value of planned actions, although those of the
data are random. Returns of the data would be those of random actions, in which the effect of one
action is small.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.data.privileged import mirror_privileged
from egovcp.model import WorldModel
from egovcp.model.privileged_value import PrivilegedValue, sample_actions
from egovcp.plan import PlannerConfig
from egovcp.plan.search import action_costs
from egovcp.terminal import echo
from egovcp_train.config import PrivilegedValueConfig
from egovcp_train.datasets import TrainingData
from egovcp_train.device import precision
from egovcp_train.distributed import ProcessGroup

_WEIGHT_DECAY: Final = 1e-3
_MIN_STD: Final = 1e-3
_ROWS_AT_ONCE: Final = 1 << 16
_SAMPLED: Final = 14  # next actions besides holding the last one and moving to the neutral pose
_TARGET_DECAY: Final = 0.98
#: Standard deviation of errors of position, m, and velocity, m/s. Planned actions then leave the
#: margin that a policy needs, which only sees images.
_OBJECT_NOISE: Final = 0.1


class Inputs(NamedTuple):
    """Inputs of the privileged value."""

    state: Tensor  # (n, 74), standardised
    features: Tensor  # (n, F)
    action: Tensor  # (n, 7)

    def at(self, index: Tensor, other: Inputs, flip: Tensor) -> Inputs:
        """Rows ``index`` (m,), of ``other`` where ``flip`` (m, 1)."""
        pairs = zip(self, other, strict=True)
        return Inputs(*(torch.where(flip, b[index], a[index]) for a, b in pairs))


class Transitions:
    """Inputs and rewards of the N rows of episodes, and which rows have a successor.

    The mirrored inputs of a robot that is not symmetric are its inputs.
    """

    def __init__(self, model: WorldModel, store: EpisodeStore) -> None:
        """Those of ``store``, on the device of ``model``, whose normalisation is used."""
        self.model, device = model, model.state_mean.device
        own = (store.state, store.privileged, store.action)
        mirrored, robot = own, store.robot
        if robot.mirror is not None:
            mirrored = (
                robot.mirrored_state(store.state),
                mirror_privileged(store.privileged),
                robot.mirrored_action(store.action),
            )
        self.inputs, self.mirrored = (
            Inputs(model.standardise(state), *others)
            for state, *others in (
                (torch.from_numpy(x).to(device) for x in arrays) for arrays in (own, mirrored)
            )
        )
        self.reward = torch.from_numpy(store.reward).to(device)
        self.failed = torch.from_numpy(store.terminal_next).to(device)
        last = np.zeros(store.num_frames, np.bool_)
        last[store.start + store.length - 1] = True
        usable = np.flatnonzero(~last | store.terminal_next)
        self._usable = torch.from_numpy(usable).to(device)

    def sample(
        self, count: int, generator: torch.Generator
    ) -> tuple[Inputs, Tensor, Inputs, Tensor]:
        """Rows drawn at random, half of them mirrored, with an error of the object's position and
        velocity that is the same in both rows.

        Returns:
            inputs of the rows; their rewards (n,); inputs of the next rows; which rows ended in a
            failure (n,), without a next row.
        """
        device = self.reward.device
        drawn = torch.randint(len(self._usable), (count,), generator=generator, device=device)
        index = self._usable[drawn]
        flip = torch.rand(count, generator=generator, device=device)[:, None] < 0.5
        later = (index + 1).clamp(max=len(self.reward) - 1)
        now, then = (self.inputs.at(rows, self.mirrored, flip) for rows in (index, later))
        error = torch.zeros_like(now.features)
        error[:, spec.OBJECT_STATE] = _OBJECT_NOISE * torch.randn(
            (count, 6), generator=generator, device=device
        )
        now, then = (x._replace(features=x.features + error) for x in (now, then))
        return now, self.reward[index], then, self.failed[index]


def correlation(model: WorldModel, store: EpisodeStore, value: PrivilegedValue) -> dict[str, float]:
    """Task -> correlation of a value with the returns of the episodes of ``store``."""
    inputs = Transitions(model, store).inputs
    pieces = zip(*(torch.split(x, _ROWS_AT_ONCE) for x in inputs), strict=True)
    with torch.no_grad():
        expected = torch.cat([value(*piece) for piece in pieces]).cpu().numpy()
    tasks, found = np.repeat(np.array(store.tasks), store.length), {}
    for task in np.unique(tasks).tolist():
        own = (tasks == task) & store.mc_valid
        pair = expected[own], store.mc_return[own]
        if own.any() and all(np.ptp(x) > 0 for x in pair):
            found[task] = float(np.corrcoef(*pair)[0, 1])
    return found


def has_objects(store: EpisodeStore) -> bool:
    """Whether every dataset of a store records the positions of objects."""
    seen = store.privileged[:, spec.OBJECT_KNOWN] > 0
    known = np.add.reduceat(seen, store.start, dtype=np.int64)
    return all(known[store.dataset == number].any() for number in np.unique(store.dataset))


def fit(
    model: WorldModel,
    store: EpisodeStore,
    config: PrivilegedValueConfig,
    planner: PlannerConfig,
    seed: int,
    bf16: bool = False,
) -> PrivilegedValue:
    """Fit a value to the episodes of ``store``; shows its progress.

    Args:
        model: its normalisation and discount are used, and its device.
        store: training episodes.
        config: number and size of the updates.
        planner: costs of the actions that it plans.
        seed: seed of weights and draws.
        bf16: compute the values of the next rows with matrix products in bfloat16.
    """
    rows = Transitions(model, store)
    features, device = rows.inputs.features, rows.reward.device
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        value = PrivilegedValue(features.shape[-1], model.robot).to(device)
    value.mean.copy_(features.mean(0))
    value.std.copy_(features.std(0).clamp_min(_MIN_STD))
    seen = value.std[spec.OBJECT_STATE]
    seen.copy_((seen.square() + _OBJECT_NOISE**2).sqrt())
    target = copy.deepcopy(value).requires_grad_(False)
    parameters = list(value.parameters())
    optimizer = torch.optim.AdamW(parameters, lr=config.lr, weight_decay=_WEIGHT_DECAY, fused=True)
    generator = torch.Generator(device=device).manual_seed(seed)
    for step in tqdm(range(config.updates), desc="privileged value", mininterval=1.0):
        now, reward, then, failed = rows.sample(config.rows, generator)
        with precision(device, bf16):
            later = _planned_value(model, target, then, now.action, planner, generator)
        expected = reward + model.discount * later.masked_fill(failed, 0.0)
        for group in optimizer.param_groups:
            group["lr"] = config.lr * 0.5 * (1 + math.cos(math.pi * step / config.updates))
        optimizer.zero_grad()
        loss = (value(*now) - (expected - model.return_mean) / model.return_std).square().mean()
        loss.backward()
        optimizer.step()
        decay = min(_TARGET_DECAY, (1 + step) / (10 + step))  # fast at first
        with torch.no_grad():
            for own, new in zip(target.parameters(), parameters, strict=True):
                own.lerp_(new, 1 - decay)
    return value.requires_grad_(False)


@torch.no_grad()
def _planned_value(
    model: WorldModel,
    value: PrivilegedValue,
    inputs: Inputs,
    previous: Tensor,
    planner: PlannerConfig,
    generator: torch.Generator,
) -> Tensor:
    """Returns (n,) of the best of some actions after ``previous`` (n, 7), by the planner's J."""
    limit = spec.ACTION_RATE_LIMIT
    sampled = sample_actions(previous[:, None], _SAMPLED, generator)[:, 0]
    hold = previous[:, None]
    actions = torch.cat([sampled, hold, hold - hold.clamp(-limit, limit)], 1)  # (n, M, 7)
    returns = (
        value(inputs.state[:, None], inputs.features[:, None], actions) * model.return_std
        + model.return_mean
    )
    one_step = replace(planner, horizon=1)
    best = (returns - action_costs(hold, actions[:, :, None], one_step)).argmax(1, keepdim=True)
    of_best: Tensor = returns.gather(1, best)[:, 0]
    return of_best


def prepare(
    model: WorldModel, data: TrainingData, group: ProcessGroup, bf16: bool = False
) -> PrivilegedValue | None:
    """Fit the target of Q of a run in its first process, and say how well it agrees with returns.

    Returns:
        None if the target of Q is another one, also because the data lacks positions of objects.
    """
    config = data.config
    if config.policy.loss.q_target != "privileged":
        return None
    if not has_objects(data.heldout):
        if group.is_first:
            echo("the data has no positions of objects: Q is fitted to returns")
        return None
    state: dict[str, Tensor] = {}
    if group.is_first:
        value = fit(
            model,
            data.learning(),
            config.optimizer.privileged_value,
            config.planner,
            config.seed,
            bf16,
        )
        found = correlation(model, data.heldout, value)
        echo(
            "privileged value: correlation with held-out returns: "
            + ", ".join(f"{k} {v:.2f}" for k, v in found.items())
        )
        state = value.cpu().state_dict()
    return PrivilegedValue.restore(group.broadcast(state), model.robot).to(model.state_mean.device)
