"""Training of the privileged value, the critic of Q (`egovcp.model.privileged_value`).

Q(s, a) is regressed on r + gamma Q(s', a') (fitted Q iteration; Ernst et al. 2005), where a' is the
best of some actions by the planner's J. So it is the value of planned actions, although those of
the data are random. Returns of the data would be those of random actions, in which the effect of
one action is small.

Before the world model is trained, a' is the best by the privileged value itself (`fit`): a policy
that knows where the object is, now and later. While it is trained, a' is the best by the Q of the
world model, which sees images (`Critic.compute_gradients`): the value of the policy that is
trained, and so of acting early where images leave the object's position open.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import compress
from typing import Any, Final, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.data.privileged import mirror_privileged
from egovcp.model import Batch, WorldModel
from egovcp.model.latent_state import Carry
from egovcp.model.losses import masked_mean
from egovcp.model.privileged_value import PrivilegedValue, sample_actions
from egovcp.model.value_losses import bootstrapped
from egovcp.plan import PlannerConfig
from egovcp.plan.search import action_costs
from egovcp.terminal import echo
from egovcp_train.config import PrivilegedValueConfig
from egovcp_train.datasets import TrainingData
from egovcp_train.device import precision

_WEIGHT_DECAY: Final = 1e-3
_MIN_STD: Final = 1e-3
_ROWS_AT_ONCE: Final = 1 << 16
_SAMPLED: Final = 14  # next actions besides holding the last one and moving to the neutral pose
_TARGET_DECAY: Final = 0.98
#: Standard deviation of errors of the object's position and velocity in what the critic is trained
#: on, in units of `WorldModel.object_std` (G1: 0.11, 0.03 and 0.02 m along x, y and z, and 0.18,
#: 0.06 and 0.12 m/s): planned actions then leave some margin. Images leave more open.
_OBJECT_ERROR: Final = 0.12


class Inputs(NamedTuple):
    """Inputs of the privileged value."""

    state: Tensor  # (n, 74), standardised
    features: Tensor  # (n, F)
    action: Tensor  # (n, 7)

    @classmethod
    def of(cls, model: WorldModel, *arrays: NDArray[np.float32]) -> Self:
        """Those of proprioception, features and actions, on the device of ``model``."""
        device = model.state_mean.device
        state, features, action = (torch.from_numpy(x).to(device) for x in arrays)
        return cls(model.standardise(state), features, action)

    def at(self, index: Tensor, other: Inputs, flip: Tensor) -> Inputs:
        """Rows ``index`` (m,), of ``other`` where ``flip`` (m, 1)."""
        pairs = zip(self, other, strict=True)
        return Inputs(*(torch.where(flip, b[index], a[index]) for a, b in pairs))


class Transitions:
    """Inputs and rewards of the N rows of episodes, and which rows have a successor.

    The mirrored inputs are the inputs if the robot is not symmetric, or without ``mirror``.
    """

    def __init__(self, model: WorldModel, store: EpisodeStore, mirror: bool = True) -> None:
        """Those of ``store``, on the device of ``model``, whose normalisation is used."""
        self.model = model
        device = model.state_mean.device
        robot = store.robot
        self.inputs = self.mirrored = Inputs.of(model, store.state, store.privileged, store.action)
        if mirror and robot.mirror is not None:
            self.mirrored = Inputs.of(
                model,
                robot.mirrored_state(store.state),
                mirror_privileged(store.privileged),
                robot.mirrored_action(store.action),
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
        noise = torch.randn((count, 6), generator=generator, device=device)
        now, then = (
            x._replace(features=_with_error(self.model, x.features, noise)) for x in (now, then)
        )
        return now, self.reward[index], then, self.failed[index]


def correlation(model: WorldModel, store: EpisodeStore, value: PrivilegedValue) -> dict[str, float]:
    """Task -> correlation of a value with the returns of the episodes of ``store``."""
    inputs = Inputs.of(model, store.state, store.privileged, store.action)
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
    """Whether some episode of each task in each dataset records positions of its object."""
    seen = store.privileged[:, spec.OBJECT_KNOWN] > 0
    known = np.logical_or.reduceat(seen, store.start)
    groups = list(zip(store.dataset.tolist(), store.tasks, strict=True))
    return set(groups) == set(compress(groups, known))


class Critic:
    """The privileged value in training: network, target network and optimiser."""

    def __init__(self, value: PrivilegedValue, planner: PlannerConfig, lr: float) -> None:
        """
        Args:
            value: the network, which is trained in place.
            planner: costs of the actions that it plans.
            lr: learning rate.
        """
        self.value = value.requires_grad_()
        self.parameters = list(value.parameters())
        self._target = copy.deepcopy(value).requires_grad_(False)
        self._one_step = replace(planner, horizon=1)
        self._optimizer = torch.optim.AdamW(
            self.parameters, lr=lr, weight_decay=_WEIGHT_DECAY, fused=True
        )
        self._updates = 0

    @classmethod
    def restore(cls, state: Mapping[str, Any], model: WorldModel, planner: PlannerConfig) -> Self:
        """The critic that a ``state_dict`` describes, on the device of ``model``."""
        value = PrivilegedValue.restore(state["value"], model.robot)
        critic = cls(value.to(model.state_mean.device), planner, lr=0.0)
        critic._target.load_state_dict(state["target"])
        critic._optimizer.load_state_dict(state["optimizer"])
        critic._updates = state["updates"]
        return critic

    def state_dict(self) -> dict[str, Any]:
        return {
            "value": self.value.state_dict(),
            "target": self._target.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "updates": self._updates,
        }

    def set_learning_rate(self, lr: float) -> None:
        for group in self._optimizer.param_groups:
            group["lr"] = lr

    def step(self) -> None:
        """Update the network by the gradients of its parameters, then the target network."""
        self._optimizer.step()
        decay = min(_TARGET_DECAY, (1 + self._updates) / (10 + self._updates))  # fast at first
        with torch.no_grad():
            for own, new in zip(self._target.parameters(), self.parameters, strict=True):
                own.lerp_(new, 1 - decay)
        self._updates += 1

    def compute_gradients(
        self,
        model: WorldModel,
        batch: Batch,
        states: Carry,
        sampled: Tensor,
        generator: torch.Generator | None = None,
        bf16: bool = False,
    ) -> Tensor:
        """Mean squared error at the rows of a batch, whose gradient replaces those of the
        parameters. The next action is the best by the Q of ``model``.

        Args:
            model: the world model.
            batch: windows of episodes.
            states: the filtered states (B, T, ...).
            sampled: actions (B, T, K, 7), from which the next one is chosen, besides the recorded
                one, holding the previous one and moving to the neutral pose.
            generator: draws an error of the object's position and velocity for each window.
            bf16: compute the Q of ``model`` with matrix products in bfloat16.
        """
        state = model.standardise(batch.state)
        noise = torch.randn((len(state), 1, 6), generator=generator, device=state.device)
        features = _with_error(model, batch.privileged, noise)
        with torch.no_grad():
            actions = _candidates(batch.prev_action, batch.action[:, :, None], sampled)
            with precision(actions.device, bf16):
                returns = model.value(states.map(lambda x: x[:, :, None]), actions)
            best = self._best(
                returns.flatten(0, 1), actions.flatten(0, 1), batch.prev_action, model.discount
            )
            action = actions.flatten(0, 1)[torch.arange(len(best), device=best.device), best]
            later = self._target(state, features, action.view_as(batch.action))
            later = later * model.return_std + model.return_mean
            expected, usable = bootstrapped(model, batch, later)
            expected = (expected - model.return_mean) / model.return_std
        squared = (self.value(state, features, batch.action) - expected).square()
        return self._backward(masked_mean(squared, usable))

    def fit_step(
        self,
        model: WorldModel,
        rows: Transitions,
        count: int,
        generator: torch.Generator,
        bf16: bool = False,
    ) -> None:
        """One update on ``count`` rows, whose next action is the best by this value itself."""
        now, reward, then, failed = rows.sample(count, generator)
        with torch.no_grad():
            sampled = sample_actions(now.action[:, None], _SAMPLED, generator)[:, 0]
            actions = _candidates(now.action, sampled)
            with precision(actions.device, bf16):
                later = self._target(then.state[:, None], then.features[:, None], actions)
            later = later * model.return_std + model.return_mean
            best = self._best(later, actions, now.action, model.discount)
            later = later.gather(1, best[:, None])[:, 0].masked_fill(failed, 0.0)
            expected = (reward + model.discount * later - model.return_mean) / model.return_std
        self._backward((self.value(*now) - expected).square().mean())
        self.step()

    def _best(self, returns: Tensor, actions: Tensor, previous: Tensor, discount: Tensor) -> Tensor:
        """Indices (n,) of the best of actions (n, M, 7) by the planner's J, from the returns
        (n, M), the previous actions (..., 7) and the discount per step."""
        start = previous.reshape(len(actions), 1, -1)
        costs = action_costs(start, actions[:, :, None], self._one_step, discount)
        return (returns - costs).argmax(1)

    def _backward(self, loss: Tensor) -> Tensor:
        gradients = torch.autograd.grad(loss, self.parameters)
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        return loss.detach()


def _with_error(model: WorldModel, features: Tensor, noise: Tensor) -> Tensor:
    """Features (..., F) with an error of the object's position and velocity from standard normal
    noise (..., 6)."""
    changed = features.clone()
    changed[..., spec.OBJECT_STATE] += _OBJECT_ERROR * model.object_std * noise
    return changed


def _candidates(previous: Tensor, *actions: Tensor) -> Tensor:
    """The given actions (..., M_i, 7), the previous one (..., 7) again, and a step from it towards
    the neutral pose, (..., M + 2, 7)."""
    limit, hold = spec.ACTION_RATE_LIMIT, previous[..., None, :]
    return torch.cat([*actions, hold, hold - hold.clamp(-limit, limit)], -2)


def fit(
    model: WorldModel,
    store: EpisodeStore,
    config: PrivilegedValueConfig,
    planner: PlannerConfig,
    seed: int,
    progress: Callable[[int], float],
    bf16: bool = False,
    mirror: bool = True,
) -> Critic:
    """Fit a value to the episodes of ``store``; shows its progress.

    Args:
        model: its normalisation and discount are used, and its device.
        store: training episodes.
        config: number and size of the updates.
        planner: costs of the actions that it plans.
        seed: seed of weights and draws.
        progress: part of the fit, in [0, 1], that is done after so many updates.
        bf16: compute the values of the next rows with matrix products in bfloat16.
        mirror: mirror half of the rows left to right.
    """
    rows = Transitions(model, store, mirror)
    features, device = rows.inputs.features, rows.reward.device
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        value = PrivilegedValue(features.shape[-1], model.robot).to(device)
    value.mean.copy_(features.mean(0))
    value.std.copy_(features.std(0).clamp_min(_MIN_STD))
    seen = value.std[spec.OBJECT_STATE]
    seen.copy_((seen.square() + (_OBJECT_ERROR * model.object_std).square()).sqrt())
    critic = Critic(value, planner, config.lr)
    generator = torch.Generator(device=device).manual_seed(seed)
    updates = 0  # a disabled bar does not count
    with tqdm(total=config.updates, desc="privileged value", mininterval=1.0) as bar:
        while (done := progress(updates)) < 1:
            critic.set_learning_rate(config.lr * 0.5 * (1 + math.cos(math.pi * done)))
            critic.fit_step(model, rows, config.rows, generator, bf16)
            updates += 1
            bar.update()
    return critic


def prepare(
    model: WorldModel,
    data: TrainingData,
    progress: Callable[[int], float],
    bf16: bool = False,
) -> Critic | None:
    """`fit` the critic of a run, and say how well it agrees with returns.

    Returns:
        None unless q_target=privileged, and the training episodes of each task in each dataset
        record object positions.
    """
    config = data.config
    if config.policy.loss.q_target != "privileged":
        return None
    store = data.training_episodes()
    if not has_objects(store):
        echo("not every task of each dataset has positions of objects: Q is fitted to returns")
        return None
    critic = fit(
        model,
        store,
        config.critic_fit,
        config.planner,
        config.seed,
        progress,
        bf16,
        config.sampling.mirror,
    )
    found = correlation(model, data.heldout, critic.value)
    echo(
        "privileged value: correlation with held-out returns: "
        + ", ".join(f"{k} {v:.2f}" for k, v in found.items())
    )
    return critic
