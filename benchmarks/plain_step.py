"""A gradient step in plain eager PyTorch, which `train_step.py` compares with.

The same mathematics as `egovcp.model` and `egovcp_train.loop` without a critic: the same weights,
loss terms and random draws, optimiser and averaging. Every network is a plain module on
concatenated inputs, the encoder and all heads work on whole stacked sequences, and the recurrence
is a loop over time.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp import spec
from egovcp.model import Batch, LossConfig, WorldModel
from egovcp.model.latent_state import SHIFT
from egovcp.model.losses import unbroken
from egovcp.model.networks import SplitLinear, SplitMlp
from egovcp_train.config import OptimizerConfig


def linear(split: SplitLinear) -> nn.Linear:
    """One layer on the concatenated inputs, with the same weights."""
    weight = torch.cat([part.weight.data for part in split.parts], 1)  # type: ignore[misc]
    layer = nn.Linear(*reversed(weight.shape), bias=False)
    layer.weight.data = weight
    return layer


def mlp(split: SplitMlp) -> nn.Sequential:
    """The same MLP on the concatenated inputs."""
    return nn.Sequential(linear(split.first), *copy.deepcopy(split.rest))


class PlainGru(nn.Module):
    """GRU with a normalised projection."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.project = linear(model.gru.project)
        self.norm = copy.deepcopy(model.gru.norm)
        self.update_bias = model.gru.update_bias

    def forward(self, x: Tensor, h: Tensor) -> Tensor:
        parts = self.norm(self.project(torch.cat([x, h], -1)))
        reset, candidate, update = parts.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        update = torch.sigmoid(update + self.update_bias)
        return update * candidate + (1 - update) * h


class PlainModel(nn.Module):
    """The world model's networks."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.config = model.config
        self.encode_depth = copy.deepcopy(model.encode_depth.layers)
        self.encode_state = mlp(model.encode_state)
        self.mix = nn.Sequential(linear(model.mix), *copy.deepcopy(model.mix_act))
        self.gru = PlainGru(model)
        self.embed = linear(model.embed_observation)
        self.posterior_h = copy.deepcopy(model.posterior.project_h)
        self.posterior = copy.deepcopy(model.posterior.rest)
        self.prior = mlp(model.prior)
        self.decoder_input = copy.deepcopy(model.decode_depth.project)
        self.patch = model.decode_depth.PATCH
        patches = copy.deepcopy(model.decode_depth.layers)
        self.decode_depth = nn.Sequential(*patches, nn.PixelShuffle(self.patch))
        self.decode_state = mlp(model.decode_state)
        self.termination = mlp(model.termination_head)
        self.value = mlp(model.value_head)
        assert model.object_head is not None
        self.object = mlp(model.object_head)
        for name, buffer in model.named_buffers():
            self.register_buffer(name, buffer.clone())

    def gaussian(self, logits: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = logits.chunk(2, -1)
        return mean, F.softplus(raw + SHIFT) + self.config.min_std

    def transition(self, h: Tensor, z: Tensor, action: Tensor) -> Tensor:
        new: Tensor = self.gru(self.mix(torch.cat([z, action], -1)), h)
        return new

    def decode_image(self, features: Tensor) -> Tensor:
        """(N, features) -> nearness (N, 48, 64)."""
        maps = self.decoder_input(features)
        rows, cols = spec.DEPTH_ROWS // self.patch, spec.DEPTH_COLS // self.patch
        maps = maps.view(len(maps), -1, rows, cols)
        image: Tensor = self.decode_depth(maps)[:, 0]
        return image


def max_pool_3x3(x: Tensor) -> Tensor:
    """(N, H, W) -> maximum over 3 x 3 pixels."""
    return F.max_pool2d(x[:, None], 3, stride=1, padding=1)[:, 0]


def nearness(depth_mm: Tensor, max_m: float) -> Tensor:
    """(N, H, W) mm -> nearness in [0, 1], small holes closed."""
    near = (1 - depth_mm.float() * (1e-3 / max_m)).clamp(0, 1)
    near = torch.where(depth_mm == 0, torch.zeros_like(near), near)
    return -max_pool_3x3(-max_pool_3x3(near))


def mean_where(x: Tensor, mask: Tensor) -> Tensor:
    mask = mask.float()
    return (x * mask).sum() / mask.sum().clamp(min=1)


def pixel_weights(near: Tensor, batch: Batch, loss: LossConfig) -> Tensor:
    """Weight of every pixel, (B, T, H, W)."""
    before = near[:, :-1].flatten(0, 1)
    high, low = (x.view_as(near[:, 1:]) for x in (max_pool_3x3(before), -max_pool_3x3(-before)))
    threshold = loss.motion_threshold
    moving = (near[:, 1:] > high + threshold) | (near[:, 1:] < low - threshold)
    moving = F.pad(moving, (0, 0, 0, 0, 1, 0)) & ~batch.is_first[..., None, None]
    close = near > loss.proximity_threshold
    return 1 + loss.motion_weight * moving.float() + loss.proximity_weight * close.float()


def plain_loss(model: PlainModel, batch: Batch, generator: torch.Generator) -> Tensor:
    """The total loss of a batch."""
    config, loss = model.config, model.config.loss
    size, length = batch.valid.shape
    near = nearness(batch.depth.flatten(0, 1), config.depth_max_m)
    state = ((batch.state - model.state_mean) / model.state_std).clamp(-10, 10)  # type: ignore[operator]
    image = model.encode_depth(torch.stack([near, (near > 0).float()], 1))
    observation = torch.cat([image, model.encode_state(state.flatten(0, 1))], -1)
    observation = model.embed(observation).view(size, length, -1)
    near = near.view(size, length, *near.shape[1:])

    h, z = torch.zeros(size, config.hidden), torch.zeros(size, config.latent)
    hs, zs, means, stds = [], [], [], []
    for t in range(length):
        keep = (~batch.is_first[:, t, None]).float()
        h = model.transition(h * keep, z * keep, batch.prev_action[:, t] * keep)
        mean, std = model.gaussian(model.posterior(model.posterior_h(h) + observation[:, t]))
        z = mean + std * torch.randn(mean.shape, generator=generator)
        hs.append(h)
        zs.append(z)
        means.append(mean)
        stds.append(std)
    h, z, mean, std = (torch.stack(x, 1) for x in (hs, zs, means, stds))
    features = torch.cat([h, z], -1)
    prior_mean, prior_std = model.gaussian(model.prior(h))

    weight = pixel_weights(near, batch, loss)
    error = (0.5 * (model.decode_state(features) - state) ** 2).mean(-1)
    values = value_terms(model, h, z, batch)
    multistep_losses = multistep_terms(model, (h, z), near, state, weight, batch, generator)
    terms = [
        loss.depth * depth_loss(model, features, near, weight, batch, generator),
        loss.state * mean_where(error, batch.valid),
        loss.object * object_loss(model, features, batch.object, batch.valid & batch.object_known),
        *kl_terms(model, (mean, std), (prior_mean, prior_std), batch),
        *values,
        *multistep_losses,
    ]
    return torch.stack(terms).sum()


def depth_loss(
    model: PlainModel,
    features: Tensor,
    near: Tensor,
    weight: Tensor,
    batch: Batch,
    generator: torch.Generator,
) -> Tensor:
    every = model.config.loss.decode_every
    chosen = slice(int(torch.randint(every, (), generator=generator)), None, every)
    image = model.decode_image(features[:, chosen].flatten(0, 1))
    error = 0.5 * (image - near[:, chosen].flatten(0, 1)) ** 2
    error = error * weight[:, chosen].flatten(0, 1)
    return mean_where(error.mean((-2, -1)), batch.valid[:, chosen].flatten())


def object_loss(model: PlainModel, features: Tensor, state: Tensor, known: Tensor) -> Tensor:
    target = ((state - model.object_mean) / model.object_std).clamp(-5, 5)  # type: ignore[operator]
    return mean_where((0.5 * (model.object(features) - target) ** 2).mean(-1), known)


def kl_terms(
    model: PlainModel, q: tuple[Tensor, Tensor], p: tuple[Tensor, Tensor], batch: Batch
) -> list[Tensor]:
    loss = model.config.loss

    def kl(q: tuple[Tensor, Tensor], p: tuple[Tensor, Tensor]) -> Tensor:
        posterior, prior = (torch.distributions.Normal(*x, validate_args=False) for x in (q, p))
        nats = torch.distributions.kl_divergence(posterior, prior).sum(-1)
        return mean_where(nats.clamp(min=loss.free_nats), batch.valid)

    fixed_q, fixed_p = ((x[0].detach(), x[1].detach()) for x in (q, p))
    return [loss.kl_prior * kl(fixed_q, p), loss.kl_posterior * kl(q, fixed_p)]


def value_error(value: Tensor, target: Tensor) -> Tensor:
    """Squared error (...,) of values (..., 1)."""
    return (value.squeeze(-1) - target).square()


def value_terms(model: PlainModel, h: Tensor, z: Tensor, batch: Batch) -> list[Tensor]:
    loss = model.config.loss
    target = (batch.mc_return - model.return_mean) / model.return_std  # type: ignore[operator]
    usable = batch.valid & batch.mc_valid
    filtered = torch.cat([h, z, batch.action], -1)
    value = mean_where(value_error(model.value(filtered), target), usable)
    h = model.transition(h, z, batch.action)
    z = model.gaussian(model.prior(h))[0]
    fall = F.binary_cross_entropy_with_logits(
        model.termination(torch.cat([h, z], -1)).squeeze(-1),
        batch.terminal_next.float(),
        reduction="none",
    )
    next_features = torch.cat([h[:, :-1], z[:, :-1], batch.action[:, 1:]], -1)
    known = usable[:, 1:] & unbroken(batch, 1)
    imagined = mean_where(value_error(model.value(next_features), target[:, 1:]), known)
    return [
        loss.value * value,
        loss.termination * mean_where(fall, batch.valid),
        loss.imagined_value * imagined,
    ]


def multistep_terms(
    model: PlainModel,
    states: tuple[Tensor, Tensor],
    near: Tensor,
    state: Tensor,
    weight: Tensor,
    batch: Batch,
    generator: torch.Generator,
) -> list[Tensor]:
    loss, length = model.config.loss, near.shape[1]
    horizons = [k for k in loss.multistep_horizons if k < length]
    every = min(loss.multistep_stride, length - min(horizons))
    first = int(torch.randint(every, (), generator=generator))
    start = torch.arange(first, length - min(horizons), every)
    h, z = (x[:, start] for x in states)
    imagined, rows, known = [], [], []
    for k in range(1, max(horizons) + 1):
        start = start[start + k < length]
        h, z = h[:, : len(start)], z[:, : len(start)]
        h = model.transition(h, z, batch.action[:, start + k - 1])
        z = model.gaussian(model.prior(h))[0]
        if k in horizons:
            imagined.append(torch.cat([h, z], -1))
            rows.append(start + k)
            known.append(unbroken(batch, k)[:, start])
    features, at, valid = torch.cat(imagined, 1), torch.cat(rows), torch.cat(known, 1)
    image = model.decode_image(features.flatten(0, 1)).view(len(near), len(at), *near.shape[2:])
    depth = (0.5 * weight[:, at] * (image - near[:, at]) ** 2).mean((-2, -1))
    proprioception = (0.5 * (model.decode_state(features) - state[:, at]) ** 2).mean(-1)
    return [
        loss.multistep_depth * mean_where(depth, valid),
        loss.multistep_state * mean_where(proprioception, valid),
        loss.multistep_object
        * object_loss(model, features, batch.object[:, at], valid & batch.object_known[:, at]),
    ]


class PlainLearner:
    """Model, averaged model and optimiser."""

    def __init__(self, model: WorldModel, config: OptimizerConfig, seed: int) -> None:
        self.model = PlainModel(model)
        self.averaged = copy.deepcopy(self.model).requires_grad_(False)
        self.config = config
        self.optimizer = torch.optim.AdamW(
            self.model.parameters(), lr=config.lr, weight_decay=config.weight_decay
        )
        self.generator = torch.Generator().manual_seed(seed)

    def update(self, batch: Batch) -> float:
        """One gradient step; returns the loss before it."""
        loss = plain_loss(self.model, batch, self.generator)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.model.parameters(), self.config.grad_clip)
        self.optimizer.step()
        with torch.no_grad():
            for mean, value in zip(
                self.averaged.parameters(), self.model.parameters(), strict=True
            ):
                mean.mul_(self.config.ema).add_(value, alpha=1 - self.config.ema)
        return float(loss.detach())
