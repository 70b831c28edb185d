"""The recurrence of the world model over a whole window, with its gradient written by hand.

The same as one step of `WorldModel` after the other, where what has to be known of an observation
or an action is projected for all ticks before:

    x_t = silu(norm(A z_{t-1} + action_t))
    r, c, u = norm(B [x_t, h_{t-1}])
    h_t = lerp(h_{t-1}, tanh(sigmoid(r) c), sigmoid(u))                            (1)
    mean, std = gaussian(D silu(norm(C h_t + embedding_t)))                        (2)
    z_t = mean + std * noise_t

With few rows an operation costs its call more than its arithmetic. On the way back autograd would
call some 80 of them a tick, and add up the gradient of every weight tick by tick.

A subclass of `WorldModel` may have steps of its own, and is asked for one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from egovcp.model.carry import Carry
from egovcp.model.fused_backward import (
    Norm,
    Norms,
    Outputs,
    Saved,
    Weights,
    backward,
    beginnings,
)
from egovcp.model.gaussian import SHIFT, Gaussian
from egovcp.model.world_model import WorldModel


class _Constants(NamedTuple):
    rows: tuple[int, ...]  # of each tick
    min_std: float
    product: torch.dtype  # in which products are computed
    keep: bool  # what the way back needs


def filter_window(
    model: WorldModel,
    start: Carry,
    action: Tensor,
    first: Tensor,
    embedding: Tensor,
    noise: Tensor | None,
) -> tuple[Carry, Gaussian]:
    """`WorldModel.advance` and `WorldModel.infer` by turns; states and posteriors (B, T, ...).

    Args:
        model: the world model.
        start: h (B, H) and z (B, Z) of the tick before.
        action: (B, T, 7) that led to each tick.
        first: (B, T) bool, an episode begins.
        embedding: (B, T, U) of the observations.
        noise: (T, B, Z) with which z is drawn; None: z is the mean.
    """
    if type(model) is not WorldModel:
        return _filter_by_steps(model, start, action, first, embedding, noise)
    size, length = first.shape
    head = model.posterior
    found = _run(
        model,
        _weights(model, head.project_h, head.rest),
        [size] * length,
        start,
        action.masked_fill(first[..., None], 0.0).transpose(0, 1).flatten(0, 1),
        first.t().reshape(-1, 1),
        embedding.transpose(0, 1).flatten(0, 1),
        None if noise is None else noise.flatten(0, 1),
    )
    h, z, *posterior = (x.view(length, size, -1).transpose(0, 1).contiguous() for x in found)
    return Carry(h, z), Gaussian(*posterior)


def imagine_window(
    model: WorldModel, start: Carry, action: Tensor, rows: Sequence[int]
) -> list[Carry]:
    """`WorldModel.imagine` over and over; the states after each tick.

    Args:
        model: the world model.
        start: h (N, H) and z (N, Z).
        action: (R, 7) one tick after the other.
        rows: of each tick, at most N, and at most those of the tick before: the rest is not
            imagined further.
    """
    if type(model) is not WorldModel:
        return _imagine_by_steps(model, start, action, rows)
    weights = _weights(model, model.prior.first.parts[0], model.prior.rest)
    found = _run(model, weights, rows, start, action)
    parts = (x.split_with_sizes(list(rows)) for x in (found.h, found.z))
    return [Carry(h, z) for h, z in zip(*parts, strict=True)]


def _filter_by_steps(
    model: WorldModel,
    carry: Carry,
    action: Tensor,
    first: Tensor,
    embedding: Tensor,
    noise: Tensor | None,
) -> tuple[Carry, Gaussian]:
    carries: list[Carry] = []
    posteriors: list[Gaussian] = []
    for t in range(first.shape[1]):
        h = model.advance(carry, action[:, t], first[:, t])
        posterior = model.infer(h, embedding[:, t])
        z = posterior.mean if noise is None else posterior.mean + posterior.std * noise[t]
        carry = Carry(h, z)
        carries.append(carry)
        posteriors.append(posterior)
    means, stds = (torch.stack(part, 1) for part in zip(*posteriors, strict=True))
    return Carry.join(carries, lambda parts: torch.stack(parts, 1)), Gaussian(means, stds)


def _imagine_by_steps(
    model: WorldModel, carry: Carry, action: Tensor, rows: Sequence[int]
) -> list[Carry]:
    carries: list[Carry] = []
    for act in action.split_with_sizes(list(rows)):
        carry = model.imagine(Carry(carry.h[: len(act)], carry.z[: len(act)]), act)
        carries.append(carry)
    return carries


def _weights(model: WorldModel, head: nn.Module, rest: nn.Sequential) -> Weights:
    """Those of the recurrence, and of the head that says what z is."""
    h, mix, gru = model.config.hidden, model.mix_act[0], model.gru
    norm, _, out = rest
    bias = F.pad(gru.norm.bias.new_full((h,), gru.update_bias), (2 * h, 0))
    found = [model.mix.parts[0].weight, mix.weight, mix.bias]
    found += [torch.cat([part.weight for part in gru.project.parts], 1)]  # type: ignore[misc]
    found += [gru.norm.weight, gru.norm.bias + bias]
    found += [head.weight, norm.weight, norm.bias, out.weight, out.bias]
    return Weights(*found)  # type: ignore[arg-type]


def _run(
    model: WorldModel,
    weights: Weights,
    rows: Sequence[int],
    start: Carry,
    action: Tensor,
    first: Tensor | None = None,
    embedding: Tensor | None = None,
    noise: Tensor | None = None,
) -> Outputs:
    kind = action.device.type
    product = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else action.dtype
    constants = _Constants(tuple(rows), model.config.min_std, product, torch.is_grad_enabled())
    projected = model.mix.parts[1](action)
    with torch.autocast(kind, enabled=False):
        found = _Recurrence.apply(  # type: ignore[no-untyped-call]
            constants, start.h, start.z, projected, embedding, first, noise, *weights
        )
    return Outputs(*found)


class _Recurrence(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        constants: _Constants,
        h: Tensor,
        z: Tensor,
        action: Tensor,
        embedding: Tensor | None,
        first: Tensor | None,
        noise: Tensor | None,
        *weights: Tensor,
    ) -> tuple[Tensor, ...]:
        found, kept, norms = _forward(
            constants, h, z, action, embedding, first, noise, Weights(*weights)
        )
        if kept is not None:
            ctx.rows = constants.rows
            several = [x for norm in norms for x in norm]
            ctx.save_for_backward(first, noise, *kept, *several, *weights)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor | None, ...]:
        first, noise, *rest = ctx.saved_tensors
        kept, rest = Saved(*rest[: len(Saved._fields)]), rest[len(Saved._fields) :]
        norms = Norms(*(Norm(*rest[i : i + 4]) for i in (0, 4, 8)))
        found = backward(Outputs(*outer), kept, norms, Weights(*rest[12:]), ctx.rows, first, noise)
        embedding = found.embedding if ctx.needs_input_grad[4] else None
        return (None, found.h, found.z, found.action, embedding, None, None, *found.weights)


def _forward(
    constants: _Constants,
    h: Tensor,
    z: Tensor,
    action: Tensor,
    embedding: Tensor | None,
    first: Tensor | None,
    noise: Tensor | None,
    w: Weights,
) -> tuple[Outputs, Saved | None, list[Norm]]:
    """Rows are those of `Outputs`: action (R, U), embedding (R, U), first (R, 1), noise (R, Z)."""
    p = constants.product
    mix, gru, head, out = (x.to(p).t() for x in (w.mix, w.gru, w.head, w.out))
    out_shift = w.out_shift.to(p)
    found: list[Outputs] = []
    kept: list[Saved] = []
    norms: list[Norms] = []

    def ticks(x: Tensor | None) -> Sequence[Any]:
        rows = constants.rows
        return [None] * len(rows) if x is None else x.split_with_sizes(list(rows))

    seen = None if embedding is None else embedding.to(p)
    begun = beginnings(first, constants.rows)
    given = map(ticks, (action.to(p), seen, noise))
    for act, look, noise_t, new in zip(*given, begun, strict=True):
        h, z = h[: len(act)], z[: len(act)]
        if new is not None:  # replaced, not multiplied by zero: a reset heals NaN, too
            h, z = h.masked_fill(new, 0.0), z.masked_fill(new, 0.0)
        latent, before = z.to(p), h
        mixed = Norm.of(torch.addmm(act, latent, mix), w.mix_scale, w.mix_shift)
        inputs = torch.cat([F.silu(mixed.y).to(p), h.to(p)], 1)
        gates = Norm.of(inputs @ gru, w.gru_scale, w.gru_shift)
        reset, candidate, update = gates.y.chunk(3, -1)
        reset, update = torch.sigmoid(reset), torch.sigmoid(update)
        proposed = torch.tanh(reset * candidate)
        h = torch.lerp(h, proposed.to(h.dtype), update.to(h.dtype))
        state = h.to(p)
        raw = state @ head if look is None else torch.addmm(look, state, head)
        read = Norm.of(raw, w.head_scale, w.head_shift)
        hidden = F.silu(read.y).to(p)
        mean, spread = torch.addmm(out_shift, hidden, out).to(h.dtype).chunk(2, -1)
        std = F.softplus(spread + SHIFT) + constants.min_std
        z = mean if noise_t is None else torch.addcmul(mean, std, noise_t)
        found.append(Outputs(h, z, mean, std))
        if constants.keep:
            kept.append(
                Saved(before, latent, inputs, reset, proposed, update, state, hidden, spread)
            )
            norms.append(Norms(mixed, gates, read))
    whole = Outputs(*map(torch.cat, zip(*found, strict=True)))
    if not constants.keep:
        return whole, None, []
    several = [Norm(*map(torch.cat, zip(*norm, strict=True))) for norm in zip(*norms, strict=True)]
    return whole, Saved(*map(torch.cat, zip(*kept, strict=True))), several
