"""Fit of the privileged value, before the world model is trained.

`egovcp.model.privileged_value` says what it is for. It is a regression of the Monte Carlo returns
of rows drawn at random, half of them mirrored.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.data.privileged import mirror_privileged
from egovcp.model import WorldModel
from egovcp.model.privileged_value import PrivilegedValue
from egovcp.terminal import echo
from egovcp_train.config import PrivilegedValueConfig
from egovcp_train.datasets import TrainingData
from egovcp_train.distributed import ProcessGroup

_WEIGHT_DECAY: Final = 1e-3
_MIN_STD: Final = 1e-3
_ROWS_AT_ONCE: Final = 1 << 16

type Inputs = tuple[Tensor, ...]
"""Standardised proprioception (n, 74), privileged features (n, F) and actions (n, 7)."""


class PrivilegedRows:
    """Inputs and standardised returns of the N rows of episodes whose return is complete.

    The mirrored inputs of a robot that is not symmetric are its inputs.
    """

    def __init__(self, model: WorldModel, store: EpisodeStore) -> None:
        """The rows of ``store``, on the device of ``model``, whose normalisation is used."""
        rows, device = store.mc_valid, model.state_mean.device
        own = (store.state, store.privileged, store.action)
        mirrored, robot = own, store.robot
        if robot.mirror is not None:
            mirrored = (
                robot.mirrored_state(store.state),
                mirror_privileged(store.privileged),
                robot.mirrored_action(store.action),
            )
        self.inputs, self.mirrored = (
            (model.standardise(state), *others)
            for state, *others in (
                (torch.from_numpy(x[rows]).to(device) for x in arrays) for arrays in (own, mirrored)
            )
        )
        target = torch.from_numpy(store.mc_return[rows]).to(device)
        self.target = (target - model.return_mean) / model.return_std
        self._tasks = np.repeat(np.array(store.tasks), store.length)[rows]

    def sample(self, count: int, generator: torch.Generator) -> tuple[Inputs, Tensor]:
        """Inputs and returns of rows drawn at random, half of them mirrored."""
        device = self.target.device
        index = torch.randint(len(self.target), (count,), generator=generator, device=device)
        flip = torch.rand(count, generator=generator, device=device)[:, None] < 0.5
        both = zip(self.inputs, self.mirrored, strict=True)
        return tuple(torch.where(flip, b[index], a[index]) for a, b in both), self.target[index]

    @torch.no_grad()
    def explained(self, value: PrivilegedValue) -> dict[str, float]:
        """Task -> share R2 of the variance of the returns that a value explains."""
        pieces = zip(*(torch.split(x, _ROWS_AT_ONCE) for x in self.inputs), strict=True)
        error = (torch.cat([value(*piece) for piece in pieces]) - self.target).cpu().numpy()
        target, found = self.target.cpu().numpy(), {}
        for task in np.unique(self._tasks).tolist():
            own = self._tasks == task
            variance = float(target[own].var())
            if variance > 0:
                found[task] = 1 - float(np.square(error[own]).mean()) / variance
        return found


def has_objects(store: EpisodeStore) -> bool:
    """Whether every dataset of a store records the positions of objects."""
    seen = store.privileged[:, spec.OBJECT_KNOWN] > 0
    known = np.add.reduceat(seen, store.start, dtype=np.int64)
    return all(known[store.dataset == number].any() for number in np.unique(store.dataset))


def fit(
    model: WorldModel, store: EpisodeStore, config: PrivilegedValueConfig, seed: int
) -> PrivilegedValue:
    """Fit a value to the returns of the episodes of ``store``; shows its progress.

    Args:
        model: its normalisation is used, and its device.
        store: training episodes.
        config: number and size of the updates.
        seed: seed of weights and draws.
    """
    rows = PrivilegedRows(model, store)
    features, device = rows.inputs[1], rows.target.device
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        value = PrivilegedValue(features.shape[-1], model.robot).to(device)
    value.mean.copy_(features.mean(0))
    value.std.copy_(features.std(0).clamp_min(_MIN_STD))
    optimizer = torch.optim.AdamW(
        value.parameters(), lr=config.lr, weight_decay=_WEIGHT_DECAY, fused=True
    )
    generator = torch.Generator(device=device).manual_seed(seed)
    for step in tqdm(range(config.updates), desc="privileged value", mininterval=1.0):
        inputs, target = rows.sample(config.rows, generator)
        for group in optimizer.param_groups:
            group["lr"] = config.lr * 0.5 * (1 + math.cos(math.pi * step / config.updates))
        optimizer.zero_grad()
        loss = (value(*inputs) - target).square().mean()
        loss.backward()
        optimizer.step()
    return value.requires_grad_(False)


def prepare(model: WorldModel, data: TrainingData, group: ProcessGroup) -> PrivilegedValue | None:
    """Fit the target of Q of a run in its first process, and say how well it predicts returns.

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
        value = fit(model, data.learning(), config.optimizer.privileged_value, config.seed)
        found = PrivilegedRows(model, data.heldout).explained(value)
        shares = ", ".join(f"{task} {share:.2f}" for task, share in found.items())
        echo(f"the privileged value explains this share of held-out returns: {shares}")
        state = value.cpu().state_dict()
    return PrivilegedValue.restore(group.broadcast(state), model.robot).to(model.state_mean.device)
