"""The gradient of the recurrence over a window (`egovcp.model.fused_recurrence`), by hand.

From the last tick to the first, through products and norms. What h_t changes by with each gate does
not depend on later ticks and is computed for all at once, and so is the gradient of every weight:
one product over the rows of all ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from egovcp.model.gaussian import SHIFT

EPSILON = 1e-5  # of all norms


def takes_two_types(device: torch.device) -> bool:
    """Whether a norm there takes bfloat16 numbers and float32 weights."""
    return device.type == "cpu"


class Weights(NamedTuple):
    """What the recurrence is computed with: U units, Z latent, H hidden."""

    mix: Tensor  # (U, Z), A
    mix_scale: Tensor  # (U,)
    mix_shift: Tensor  # (U,)
    gru: Tensor  # (3H, U + H), B
    gru_scale: Tensor  # (3H,)
    gru_shift: Tensor  # (3H,), with the bias of the update gate
    head: Tensor  # (U, H), C
    head_scale: Tensor  # (U,)
    head_shift: Tensor  # (U,)
    out: Tensor  # (2Z, U), D
    out_shift: Tensor  # (2Z,)


class Outputs(NamedTuple):
    """What the recurrence found, or the gradient of it: rows (R, ...) of one tick after the other,
    as many of each as of the one before or fewer."""

    h: Tensor
    z: Tensor
    mean: Tensor
    std: Tensor


class Norm(NamedTuple):
    """A layer norm: what went in and what came out (R, n), mean and 1 / deviation (R, 1)."""

    x: Tensor
    y: Tensor
    mean: Tensor
    rstd: Tensor

    @classmethod
    def of(cls, x: Tensor, scale: Tensor, shift: Tensor) -> Norm:
        """The norm of (R, n)."""
        if not takes_two_types(x.device):
            x = x.to(scale.dtype)
        return cls(x, *torch.native_layer_norm(x, scale.shape, scale, shift, EPSILON))

    def back(self, gradient: Tensor, scale: Tensor) -> Tensor:
        """Gradient (R, n) of y -> of x."""
        return self._gradients(gradient, scale, (True, False, False))[0]

    def of_parameters(self, gradient: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, n) of y -> of scale and shift (n,)."""
        _, of_scale, of_shift = self._gradients(gradient, scale, (False, True, True))
        return of_scale, of_shift

    def _gradients(
        self, gradient: Tensor, scale: Tensor, which: tuple[bool, bool, bool]
    ) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = torch.ops.aten.native_layer_norm_backward(
            gradient, self.x, scale.shape, self.mean, self.rstd, scale, scale, which
        )
        return found

    def ticks(self, rows: Sequence[int]) -> list[Norm]:
        """Of one tick after the other."""
        parts = (x.split_with_sizes(list(rows)) for x in self)
        return [Norm(*part) for part in zip(*parts, strict=True)]


class Saved(NamedTuple):
    """What is known of all ticks, (R, ...); what products are made of is in their type."""

    state: Tensor  # h_{t-1}
    latent: Tensor  # z_{t-1}, as it was multiplied
    inputs: Tensor  # [x_t, h_{t-1}], as they were multiplied
    reset: Tensor  # sigmoid of it
    proposed: Tensor  # what h_t is drawn towards
    update: Tensor  # and by how much
    new: Tensor  # h_t, as it was multiplied
    hidden: Tensor  # what D was multiplied with
    spread: Tensor  # what the deviation is made of


class Norms(NamedTuple):
    """Those of all ticks."""

    mixed: Norm
    gates: Norm
    read: Norm


class Gradients(NamedTuple):
    """Of everything that goes in."""

    h: Tensor  # (B, H)
    z: Tensor  # (B, Z)
    action: Tensor  # (R, U)
    embedding: Tensor  # (R, U)
    weights: Weights


def backward(
    outer: Outputs,
    kept: Saved,
    norms: Norms,
    w: Weights,
    rows: Sequence[int],
    first: Tensor | None,
    noise: Tensor | None,
) -> Gradients:
    """The gradients of all inputs.

    Args:
        outer: of what was found.
        kept: on the way there.
        norms: on the way there.
        w: the weights.
        rows: of each tick.
        first: (R, 1) bool, if an episode may begin.
        noise: (R, Z) with which z was drawn; None: it was not.
    """
    p, units = kept.inputs.dtype, len(w.mix)
    mix, gru, head, out = (x.to(p) for x in (w.mix, w.gru, w.head, w.out))

    def ticks(x: Tensor) -> Sequence[Tensor]:
        return x.split_with_sizes(list(rows))

    alone, by_latent = _of_logits(outer, kept.spread, noise)
    slopes = _gate_slopes(kept, norms.gates.y)
    d_new = outer.h.clone()  # what comes from later ticks is added
    of_tick = zip(
        *map(ticks, (d_new, alone, by_latent, slopes, 1 - kept.update.to(d_new.dtype))),
        *(norm.ticks(rows) for norm in norms),
        beginnings(first, rows),
        strict=True,
    )
    d_h, d_z = d_new[:0], outer.z[:0]
    steps: list[tuple[Tensor, ...]] = []
    for new, known, latent, slope, keep, mixed, gates, read, again in reversed(list(of_tick)):
        later = len(d_h)
        known[:later].addcmul_(torch.cat([d_z, d_z], 1), latent[:later])
        logits = known.to(p)
        e_read = _silu_back(logits @ out, read.y)
        d_read = read.back(e_read, w.head_scale).to(p)
        new += d_read @ head
        new[:later] += d_h
        e_gates = (new.to(slope.dtype)[:, None] * slope.view(len(new), 3, new.shape[1])).flatten(1)
        d_gates = gates.back(e_gates, w.gru_scale).to(p)
        d_inputs = d_gates @ gru
        e_mixed = _silu_back(d_inputs[:, :units], mixed.y)
        d_mixed = mixed.back(e_mixed, w.mix_scale).to(p)
        d_h = new * keep + d_inputs[:, units:]
        d_z = (d_mixed @ mix).to(d_h.dtype)
        if again is not None:
            d_h, d_z = d_h.masked_fill(again, 0.0), d_z.masked_fill(again, 0.0)
        steps.append((logits, e_read, d_read, e_gates, d_gates, e_mixed, d_mixed))
    logits, e_read, d_read, e_gates, d_gates, e_mixed, d_mixed = (
        torch.cat(step[::-1]) for step in zip(*steps, strict=True)
    )
    weights = Weights(
        _of_weight(d_mixed, kept.latent, w.mix),
        *norms.mixed.of_parameters(e_mixed, w.mix_scale),
        _of_weight(d_gates, kept.inputs, w.gru),
        *norms.gates.of_parameters(e_gates, w.gru_scale),
        _of_weight(d_read, kept.new, w.head),
        *norms.read.of_parameters(e_read, w.head_scale),
        _of_weight(logits, kept.hidden, w.out),
        alone.sum(0),
    )
    return Gradients(d_h, d_z, d_mixed, d_read, weights)


def beginnings(first: Tensor | None, rows: Sequence[int]) -> list[Tensor | None]:
    """Of each tick (B, 1) bool, the rows at which an episode begins; None where none does, which
    saves two operations, unless a GPU has to be waited for. Where there are beginnings all ticks
    have as many rows."""
    if first is None:
        return [None] * len(rows)
    ticks = first.view(len(rows), -1)
    if first.device.type != "cpu":
        return [tick[:, None] for tick in ticks]
    some = ticks.any(1).tolist()
    return [tick[:, None] if any_ else None for tick, any_ in zip(ticks, some, strict=True)]


def _silu_back(gradient: Tensor, y: Tensor) -> Tensor:
    found: Tensor = torch.ops.aten.silu_backward(gradient.to(y.dtype), y)
    return found


def _of_weight(gradient: Tensor, x: Tensor, like: Tensor) -> Tensor:
    """Of a matrix, from the gradients of its products (R, m) and what it was multiplied with
    (R, n)."""
    return (gradient.t() @ x).to(like.dtype)


def _gate_slopes(kept: Saved, y: Tensor) -> Tensor:
    """By how much h_t changes with each gate in ``y``, (R, 3H)."""
    by_sigmoid, by_tanh = torch.ops.aten.sigmoid_backward, torch.ops.aten.tanh_backward
    candidate = y.chunk(3, -1)[1]
    through = by_tanh(kept.update, kept.proposed)
    by_reset = by_sigmoid(through * candidate, kept.reset)
    by_update = by_sigmoid(kept.proposed - kept.state.to(y.dtype), kept.update)
    return torch.cat([by_reset, through * kept.reset, by_update], -1)


def _of_logits(outer: Outputs, spread: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor]:
    """What the gradient of the logits is if nothing comes of later ticks, and what it gains by the
    gradient of z from there, (R, 2Z) both."""
    slope = torch.sigmoid(spread + SHIFT)
    noise_t = torch.zeros_like(slope) if noise is None else noise * slope
    by_latent = torch.cat([torch.ones_like(slope), noise_t], -1)
    alone = torch.cat([outer.mean, outer.std * slope], -1)
    return alone.addcmul_(torch.cat([outer.z, outer.z], 1), by_latent), by_latent
