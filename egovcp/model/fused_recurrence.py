"""The recurrence of the world model over a whole window, with a hand-written gradient.

Computes the same as `WorldModel.advance` and `WorldModel.infer` (or `WorldModel.imagine`) step by
step. Everything that depends on an observation or an action alone is projected beforehand:

    x_t = silu(norm(A z_{t-1} + action_t))
    r, c, u = norm(B [x_t, h_{t-1}])
    h_t = lerp(h_{t-1}, tanh(sigmoid(r) c), sigmoid(u))                            (1)
    mean, std = gaussian(D silu(norm(C h_t + embedding_t)))                        (2)
    z_t = mean + std * noise_t

At training batch sizes the call overhead of small operations dominates. Autograd would run about
80 of them per step backward and accumulate each weight gradient step by step. Here the backward
pass runs from the last step to the first; gate derivatives and weight gradients do not depend on
later steps and are computed for all steps at once.

Steps are stored one after the other in rows (R, ...): step t has ``rows[t]`` of them, at most as
many as step t - 1. Subclasses of `WorldModel` use the plain step-by-step loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from egovcp.model.latent_state import SHIFT, Carry, Gaussian
from egovcp.model.layer_gradients import LayerNorm, matrix_gradient, silu_gradient
from egovcp.model.world_model import WorldModel


def filter_window(
    model: WorldModel,
    start: Carry,
    action: Tensor,
    first: Tensor,
    embedding: Tensor,
    noise: Tensor | None,
) -> tuple[Carry, Gaussian]:
    """Filter a window of observations: states and posteriors, (B, T, ...).

    Args:
        start: h (B, H) and z (B, Z) of the step before the window.
        action: (B, T, 7), a_{t-1} of each step.
        first: (B, T) bool, an episode begins at this step.
        embedding: (B, T, U) of the observations.
        noise: (T, B, Z) with which z is sampled; None: z is the mean.
    """
    if type(model) is not WorldModel:
        return _filter_by_steps(model, start, action, first, embedding, noise)
    size, length = first.shape
    head = model.posterior
    outputs = _run(
        model,
        _weights(model, head.project_h, head.rest),
        [size] * length,
        start,
        action.masked_fill(first[..., None], 0.0).transpose(0, 1).flatten(0, 1),
        first.t().reshape(-1, 1),
        embedding.transpose(0, 1).flatten(0, 1),
        None if noise is None else noise.flatten(0, 1),
    )
    h, z, *posterior = (x.view(length, size, -1).transpose(0, 1).contiguous() for x in outputs)
    return Carry(h, z), Gaussian(*posterior)


def imagine_window(
    model: WorldModel, start: Carry, action: Tensor, rows: Sequence[int]
) -> list[Carry]:
    """Repeat `WorldModel.imagine`; returns the states after each step.

    Args:
        start: h (N, H) and z (N, Z).
        action: (R, 7), the actions of all steps in rows.
        rows: number of rows of each step, at most N and not increasing: states beyond it are not
            imagined further.
    """
    if type(model) is not WorldModel:
        carries, carry = list[Carry](), start
        for act in action.split_with_sizes(list(rows)):
            carry = model.imagine(Carry(carry.h[: len(act)], carry.z[: len(act)]), act)
            carries.append(carry)
        return carries
    weights = _weights(model, model.prior.first.parts[0], model.prior.rest)
    outputs = _run(model, weights, rows, start, action)
    parts = (x.split_with_sizes(list(rows)) for x in (outputs.h, outputs.z))
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


class _Weights(NamedTuple):
    """Weights of the recurrence; U units, Z latent, H hidden."""

    mix: Tensor  # (U, Z), A
    mix_scale: Tensor  # (U,)
    mix_shift: Tensor  # (U,)
    gru: Tensor  # (3H, U + H), B
    gru_scale: Tensor  # (3H,)
    gru_shift: Tensor  # (3H,), including the bias of the update gate
    head: Tensor  # (U, H), C
    head_scale: Tensor  # (U,)
    head_shift: Tensor  # (U,)
    out: Tensor  # (2Z, U), D
    out_shift: Tensor  # (2Z,)


class _Outputs(NamedTuple):
    """Outputs of the recurrence, or their gradients, (R, ...)."""

    h: Tensor
    z: Tensor
    mean: Tensor
    std: Tensor


class _Norms(NamedTuple):
    mix: LayerNorm
    gates: LayerNorm
    head: LayerNorm


class _Saved(NamedTuple):
    """What the backward pass needs, (R, ...); factors of products in the products' dtype."""

    state: Tensor  # h_{t-1}
    latent: Tensor  # z_{t-1}, a factor
    inputs: Tensor  # [x_t, h_{t-1}], a factor
    reset: Tensor  # sigmoid(r)
    candidate: Tensor  # tanh(sigmoid(r) c)
    update: Tensor  # sigmoid(u)
    new_state: Tensor  # h_t, a factor
    hidden: Tensor  # silu(norm(C h_t + embedding_t)), a factor
    spread: Tensor  # logits of the std


class _Gradients(NamedTuple):
    """Gradients of all inputs of the recurrence."""

    h: Tensor  # (B, H)
    z: Tensor  # (B, Z)
    action: Tensor  # (R, U)
    embedding: Tensor  # (R, U)
    weights: _Weights


class _Constants(NamedTuple):
    rows: tuple[int, ...]  # of each step
    min_std: float
    dtype: torch.dtype  # of matrix products
    save: bool  # for the backward pass


def _weights(model: WorldModel, head: nn.Module, rest: nn.Sequential) -> _Weights:
    """Weights of the GRU and of the head (posterior or prior) that predicts z."""
    h, mix, gru = model.config.hidden, model.mix_act[0], model.gru
    norm, _, out = rest
    bias = F.pad(gru.norm.bias.new_full((h,), gru.update_bias), (2 * h, 0))
    weights = [model.mix.parts[0].weight, mix.weight, mix.bias]
    weights += [torch.cat([part.weight for part in gru.project.parts], 1)]  # type: ignore[misc]
    weights += [gru.norm.weight, gru.norm.bias + bias]
    weights += [head.weight, norm.weight, norm.bias, out.weight, out.bias]
    return _Weights(*weights)  # type: ignore[arg-type]


def _run(
    model: WorldModel,
    weights: _Weights,
    rows: Sequence[int],
    start: Carry,
    action: Tensor,
    first: Tensor | None = None,
    embedding: Tensor | None = None,
    noise: Tensor | None = None,
) -> _Outputs:
    kind = action.device.type
    dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else action.dtype
    constants = _Constants(tuple(rows), model.config.min_std, dtype, torch.is_grad_enabled())
    projected = model.mix.parts[1](action)
    with torch.autocast(kind, enabled=False):
        outputs = _Recurrence.apply(  # type: ignore[no-untyped-call]
            constants, start.h, start.z, projected, embedding, first, noise, *weights
        )
    return _Outputs(*outputs)


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
        outputs, saved, norms = _forward(
            constants, Carry(h, z), action, embedding, first, noise, _Weights(*weights)
        )
        if saved is not None:
            ctx.rows = constants.rows
            flat = [x for norm in norms for x in norm]
            ctx.save_for_backward(first, noise, *saved, *flat, *weights)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor | None, ...]:
        first, noise, *rest = ctx.saved_tensors
        saved, rest = _Saved(*rest[: len(_Saved._fields)]), rest[len(_Saved._fields) :]
        norms = _Norms(*(LayerNorm(*rest[i : i + 4]) for i in (0, 4, 8)))
        weights = _Weights(*rest[12:])
        found = _backward(_Outputs(*outer), saved, norms, weights, ctx.rows, first, noise)
        embedding = found.embedding if ctx.needs_input_grad[4] else None
        return (None, found.h, found.z, found.action, embedding, None, None, *found.weights)


def _forward(
    constants: _Constants,
    start: Carry,
    action: Tensor,
    embedding: Tensor | None,
    first: Tensor | None,
    noise: Tensor | None,
    w: _Weights,
) -> tuple[_Outputs, _Saved | None, list[LayerNorm]]:
    """In rows: action (R, U), embedding (R, U), first (R, 1), noise (R, Z)."""
    p, rows, (h, z) = constants.dtype, list(constants.rows), start
    mix, gru, head, out = (x.to(p).t() for x in (w.mix, w.gru, w.head, w.out))
    out_shift = w.out_shift.to(p)
    outputs: list[_Outputs] = []
    saved: list[_Saved] = []
    norms: list[_Norms] = []

    def steps(x: Tensor | None) -> Sequence[Any]:
        return [None] * len(rows) if x is None else x.split_with_sizes(rows)

    observed = None if embedding is None else embedding.to(p)
    inputs_of_step = map(steps, (action.to(p), observed, noise))
    starts = _episode_starts(first, rows)
    for act, seen, noise_t, starts_t in zip(*inputs_of_step, starts, strict=True):
        h, z = h[: len(act)], z[: len(act)]
        if starts_t is not None:  # replaced, not multiplied by zero, so that a reset removes NaN
            h, z = h.masked_fill(starts_t, 0.0), z.masked_fill(starts_t, 0.0)
        latent, before = z.to(p), h
        mixed = LayerNorm.apply(torch.addmm(act, latent, mix), w.mix_scale, w.mix_shift)
        inputs = torch.cat([F.silu(mixed.y).to(p), h.to(p)], 1)
        gates = LayerNorm.apply(inputs @ gru, w.gru_scale, w.gru_shift)
        reset, candidate, update = gates.y.chunk(3, -1)
        reset, update = torch.sigmoid(reset), torch.sigmoid(update)
        candidate = torch.tanh(reset * candidate)
        h = torch.lerp(h, candidate.to(h.dtype), update.to(h.dtype))
        state = h.to(p)
        raw = state @ head if seen is None else torch.addmm(seen, state, head)
        read = LayerNorm.apply(raw, w.head_scale, w.head_shift)
        hidden = F.silu(read.y).to(p)
        mean, spread = torch.addmm(out_shift, hidden, out).to(h.dtype).chunk(2, -1)
        std = F.softplus(spread + SHIFT) + constants.min_std
        z = mean if noise_t is None else torch.addcmul(mean, std, noise_t)
        outputs.append(_Outputs(h, z, mean, std))
        if constants.save:
            saved.append(
                _Saved(before, latent, inputs, reset, candidate, update, state, hidden, spread)
            )
            norms.append(_Norms(mixed, gates, read))
    whole = _Outputs(*map(torch.cat, zip(*outputs, strict=True)))
    if not constants.save:
        return whole, None, []
    joined = [LayerNorm(*map(torch.cat, zip(*x, strict=True))) for x in zip(*norms, strict=True)]
    return whole, _Saved(*map(torch.cat, zip(*saved, strict=True))), joined


def _backward(
    outer: _Outputs,
    saved: _Saved,
    norms: _Norms,
    w: _Weights,
    rows: Sequence[int],
    first: Tensor | None,
    noise: Tensor | None,
) -> _Gradients:
    """Gradients of all inputs from those of the outputs. Names: d_x is the gradient of x; d_x_norm
    that of the output of the layer norm of x."""
    p, units = saved.inputs.dtype, len(w.mix)
    mix, gru, head, out = (x.to(p) for x in (w.mix, w.gru, w.head, w.out))

    def steps(x: Tensor) -> Sequence[Tensor]:
        return x.split_with_sizes(list(rows))

    d_logits_direct, latent_slope = _logit_gradients(outer, saved.spread, noise)
    gate_slope = _gate_slopes(saved, norms.gates.y)
    d_state = outer.h.clone()  # gradients of later steps are added to it
    keep = 1 - saved.update.to(d_state.dtype)
    per_step = zip(
        *map(steps, (d_state, d_logits_direct, latent_slope, gate_slope, keep)),
        *(norm.steps(rows) for norm in norms),
        _episode_starts(first, rows),
        strict=True,
    )
    d_h, d_z = d_state[:0], outer.z[:0]
    history: list[tuple[Tensor, ...]] = []
    for d_new, direct, z_slope, slope, kept, mixed, gates, read, starts in reversed(list(per_step)):
        later = len(d_h)
        direct[:later].addcmul_(torch.cat([d_z, d_z], 1), z_slope[:later])
        d_logits = direct.to(p)
        d_head_norm = silu_gradient(d_logits @ out, read.y)
        d_head = read.input_gradient(d_head_norm, w.head_scale).to(p)
        d_new += d_head @ head
        d_new[:later] += d_h
        d_gates_norm = (
            d_new.to(slope.dtype)[:, None] * slope.view(len(d_new), 3, d_new.shape[1])
        ).flatten(1)
        d_gates = gates.input_gradient(d_gates_norm, w.gru_scale).to(p)
        d_inputs = d_gates @ gru
        d_mix_norm = silu_gradient(d_inputs[:, :units], mixed.y)
        d_mix = mixed.input_gradient(d_mix_norm, w.mix_scale).to(p)
        d_h = d_new * kept + d_inputs[:, units:]
        d_z = (d_mix @ mix).to(d_h.dtype)
        if starts is not None:
            d_h, d_z = d_h.masked_fill(starts, 0.0), d_z.masked_fill(starts, 0.0)
        history.append((d_logits, d_head_norm, d_head, d_gates_norm, d_gates, d_mix_norm, d_mix))
    d_logits, d_head_norm, d_head, d_gates_norm, d_gates, d_mix_norm, d_mix = (
        torch.cat(step[::-1]) for step in zip(*history, strict=True)
    )
    weights = _Weights(
        matrix_gradient(d_mix, saved.latent, w.mix),
        *norms.mix.weight_gradients(d_mix_norm, w.mix_scale),
        matrix_gradient(d_gates, saved.inputs, w.gru),
        *norms.gates.weight_gradients(d_gates_norm, w.gru_scale),
        matrix_gradient(d_head, saved.new_state, w.head),
        *norms.head.weight_gradients(d_head_norm, w.head_scale),
        matrix_gradient(d_logits, saved.hidden, w.out),
        d_logits_direct.sum(0),
    )
    return _Gradients(d_h, d_z, d_mix, d_head, weights)


def _episode_starts(first: Tensor | None, rows: Sequence[int]) -> list[Tensor | None]:
    """(B, 1) bool per step. On a CPU it is None for a step without a start, which saves two
    operations; on a GPU that test would wait for the device."""
    if first is None:
        return [None] * len(rows)
    steps = first.view(len(rows), -1)
    if first.device.type != "cpu":
        return [step[:, None] for step in steps]
    some = steps.any(1).tolist()
    return [step[:, None] if any_ else None for step, any_ in zip(steps, some, strict=True)]


def _gate_slopes(saved: _Saved, gates: Tensor) -> Tensor:
    """Derivative of h_t with respect to r, c and u, (R, 3H)."""
    by_sigmoid, by_tanh = torch.ops.aten.sigmoid_backward, torch.ops.aten.tanh_backward
    c = gates.chunk(3, -1)[1]
    through = by_tanh(saved.update, saved.candidate)
    by_reset = by_sigmoid(through * c, saved.reset)
    by_update = by_sigmoid(saved.candidate - saved.state.to(gates.dtype), saved.update)
    return torch.cat([by_reset, through * saved.reset, by_update], -1)


def _logit_gradients(
    outer: _Outputs, spread: Tensor, noise: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Gradient of the logits [mean, spread] without later steps, and the derivative of z with
    respect to them, both (R, 2Z)."""
    slope = torch.sigmoid(spread + SHIFT)
    noise_slope = torch.zeros_like(slope) if noise is None else noise * slope
    latent_slope = torch.cat([torch.ones_like(slope), noise_slope], -1)
    direct = torch.cat([outer.mean, outer.std * slope], -1)
    return direct.addcmul_(torch.cat([outer.z, outer.z], 1), latent_slope), latent_slope
