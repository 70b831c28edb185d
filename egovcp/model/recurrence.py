"""The posterior over whole sequences: the recurrence of `WorldModel`, and its gradient by hand.

Step by step through the modules, half of the time of a gradient step's recurrence goes to the
bookkeeping of some thousand small operations. Written as one function whose backward pass is known,
each step is the operations that depend on the step before and nothing else, and the gradients of
the weights are one product each over all steps at once. Forward, in the notation of `WorldModel`:

    x  = silu(norm_1(z W_z + a W_a))
    n  = norm_2([x, h] W)                  = [r, c, u]
    h' = (1 - g) h + g tanh(sigmoid(r) c),   g = sigmoid(u + bias)
    s  = silu(norm_3(h' W_p + e))
    [m, l] = s W_o + b_o,   d = softplus(l + 0.54) + floor,   z' = m + d noise

with a the last action, e the embedding of the observation, and h and z zeros where an episode
begins. The results are those of `WorldModel.advance` and `infer` up to rounding.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from egovcp.model.gaussian import STD_SHIFT, Gaussian
from egovcp.model.world_model import Carry, WorldModel


class Filtered(NamedTuple):
    """The states of every step, and the posterior that z is of; (B, T, ...)."""

    carry: Carry
    posterior: Gaussian


def filter_embeddings(
    model: WorldModel,
    embedding: Tensor,
    prev_action: Tensor,
    is_first: Tensor,
    carry: Carry,
    noise: Tensor | None,
) -> Filtered:
    """Filter (B, T, ...) embeddings, actions a_{t-1} and ``is_first`` from ``carry`` on.

    ``noise`` (T, B, latent) is what z is sampled with; without it z is the posterior mean.
    """
    project_z, project_a = model.mix.parts
    action = prev_action.masked_fill(is_first[..., None], 0.0)
    normed_1, normed_2, normed_3 = model.mix_act[0], model.gru.norm, model.posterior.rest[0]
    assert isinstance(normed_1, nn.LayerNorm)
    assert isinstance(normed_3, nn.LayerNorm)
    last = model.posterior.rest[2]
    h, z, mean, std = _Recurrence.apply(  # type: ignore[no-untyped-call]
        _Constants(is_first, noise, model.gru.update_bias, model.config.min_std, normed_1.eps),
        project_a(action).transpose(0, 1),
        embedding.transpose(0, 1),
        carry.h,
        carry.z,
        project_z.weight,
        normed_1.weight,
        normed_1.bias,
        torch.cat([part.weight for part in model.gru.project.parts], 1),  # type: ignore[misc]
        normed_2.weight,
        normed_2.bias,
        model.posterior.project_h.weight,
        normed_3.weight,
        normed_3.bias,
        last.weight,
        last.bias,
    )
    return Filtered(Carry(h, z), Gaussian(mean, std))


def filter_steps(
    model: WorldModel,
    embedding: Tensor,
    prev_action: Tensor,
    is_first: Tensor,
    carry: Carry,
    noise: Tensor | None,
) -> Filtered:
    """The same step by step through the modules: for no gradient, and for autocast."""
    carries: list[Carry] = []
    posteriors: list[Gaussian] = []
    for t in range(is_first.shape[1]):
        h = model.advance(carry, prev_action[:, t], is_first[:, t])
        posterior = model.infer(h, embedding[:, t])
        mean, std = posterior
        carry = Carry(h, mean if noise is None else mean + std * noise[t])
        carries.append(carry)
        posteriors.append(posterior)
    h_seq, z_seq = (torch.stack(parts, 1) for parts in zip(*carries, strict=True))
    means, stds = (torch.stack(parts, 1) for parts in zip(*posteriors, strict=True))
    return Filtered(Carry(h_seq, z_seq), Gaussian(means, stds))


class _Constants(NamedTuple):
    """What has no gradient."""

    is_first: Tensor  # (B, T)
    noise: Tensor | None  # (T, B, latent)
    update_bias: float
    min_std: float
    eps: float


class _Norm:
    """A LayerNorm that is applied step by step, and differentiated."""

    def __init__(self, weight: Tensor, bias: Tensor, eps: float) -> None:
        self.weight, self.bias, self.eps = weight, bias, eps
        self.shape = list(weight.shape)
        self.mean: list[Tensor] = []
        self.rstd: list[Tensor] = []
        self.input: list[Tensor] = []
        self.output: list[Tensor] = []

    def __call__(self, x: Tensor) -> Tensor:
        out, mean, rstd = torch.native_layer_norm(x, self.shape, self.weight, self.bias, self.eps)
        for kept, value in zip(
            (self.input, self.output, self.mean, self.rstd), (x, out, mean, rstd), strict=True
        ):
            kept.append(value)
        return out

    def of_input(self, grad: Tensor, t: int) -> Tensor:
        """Gradient with respect to the input of step t."""
        mean, rstd = self.mean[t], self.rstd[t]
        found: Tensor = torch.ops.aten.native_layer_norm_backward(
            grad,
            self.input[t],
            self.shape,
            mean,
            rstd,
            self.weight,
            self.bias,
            [True, False, False],
        )[0]
        return found

    def of_weights(self, grads: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients with respect to weight and bias, from those of all outputs (T, B, N)."""
        inputs, mean, rstd = (torch.stack(x) for x in (self.input, self.mean, self.rstd))
        _, weight, bias = torch.ops.aten.native_layer_norm_backward(
            grads, inputs, self.shape, mean, rstd, self.weight, self.bias, [False, True, True]
        )
        return weight, bias


class _Recurrence(torch.autograd.Function):
    """(T, B, ...) of what does not depend on the step before -> h, z, mean, std, (B, T, ...)."""

    @staticmethod
    def forward(ctx: Any, constants: _Constants, *inputs: Tensor) -> tuple[Tensor, ...]:
        actions, embeddings, h, z, w_z, g_1, b_1, w, g_2, b_2, w_p, g_3, b_3, w_o, b_o = inputs
        is_first, noise, update_bias, min_std, eps = constants
        norms = _Norm(g_1, b_1, eps), _Norm(g_2, b_2, eps), _Norm(g_3, b_3, eps)
        first = is_first.t()[..., None]
        restarts = first.flatten(1).any(1).tolist()
        kept: list[tuple[Tensor, ...]] = []
        hs, zs, means, stds = [], [], [], []
        for t, (action, embedding) in enumerate(zip(actions, embeddings, strict=True)):
            if restarts[t]:  # replaced, not multiplied by zero: a reset heals NaN, too
                h, z = h.masked_fill(first[t], 0.0), z.masked_fill(first[t], 0.0)
            x = F.silu(norms[0](torch.addmm(action, z, w_z.t())))
            xh = torch.cat([x, h], 1)
            reset, candidate, update = norms[1](xh @ w.t()).chunk(3, 1)
            reset, gate = torch.sigmoid(reset), torch.sigmoid(update + update_bias)
            new = torch.tanh(reset * candidate)
            kept.append((z, xh, reset, candidate, new, gate))
            h = torch.lerp(h, new, gate)
            s = F.silu(norms[2](torch.addmm(embedding, h, w_p.t())))
            mean, raw = torch.addmm(b_o, s, w_o.t()).chunk(2, 1)
            shifted = raw + STD_SHIFT
            std = F.softplus(shifted) + min_std
            z = mean if noise is None else torch.addcmul(mean, std, noise[t])
            kept[-1] += (s, shifted)
            hs.append(h)
            zs.append(z)
            means.append(mean)
            stds.append(std)
        ctx.constants, ctx.norms, ctx.kept, ctx.hs = constants, norms, kept, hs
        ctx.first, ctx.restarts = first, restarts
        ctx.weights = w_z, w, w_p, w_o
        return tuple(torch.stack(parts, 1) for parts in (hs, zs, means, stds))

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        norm_1, norm_2, norm_3 = ctx.norms
        w_z, w, w_p, w_o = ctx.weights
        noise = ctx.constants.noise
        of_hs, of_zs, of_means, of_stds = (g.unbind(1) for g in grads)
        of_h, of_z = torch.zeros_like(ctx.hs[0]), torch.zeros_like(of_zs[0])
        # gradients of every step, last step first: of both sides of each norm, and of the output
        steps: list[tuple[Tensor, ...]] = []
        for t in reversed(range(len(ctx.kept))):
            _, xh, reset, candidate, new, gate, _, shifted = ctx.kept[t]
            of_z = of_z + of_zs[t]
            of_mean, of_std = of_means[t] + of_z, of_stds[t]
            if noise is not None:
                of_std = torch.addcmul(of_std, of_z, noise[t])
            of_out = torch.cat([of_mean, of_std * torch.sigmoid(shifted)], 1)
            of_n3 = torch.ops.aten.silu_backward(of_out @ w_o, norm_3.output[t])
            of_e = norm_3.of_input(of_n3, t)
            of_h = torch.addmm(of_h + of_hs[t], of_e, w_p)
            h = xh[:, w_z.shape[0] :]
            of_gate = of_h * (new - h)
            of_product = torch.ops.aten.tanh_backward(of_h * gate, new)
            of_n2 = torch.cat(
                [
                    torch.ops.aten.sigmoid_backward(of_product * candidate, reset),
                    of_product * reset,
                    torch.ops.aten.sigmoid_backward(of_gate, gate),
                ],
                1,
            )
            of_p = norm_2.of_input(of_n2, t)
            of_x, of_old = (of_p @ w).split([w_z.shape[0], h.shape[1]], 1)
            of_n1 = torch.ops.aten.silu_backward(of_x, norm_1.output[t])
            of_m = norm_1.of_input(of_n1, t)
            of_h = of_old + of_h * (1.0 - gate)
            of_z = of_m @ w_z
            if ctx.restarts[t]:
                of_h = of_h.masked_fill(ctx.first[t], 0.0)
                of_z = of_z.masked_fill(ctx.first[t], 0.0)
            steps.append((of_m, of_n1, of_p, of_n2, of_e, of_n3, of_out))
        of_m, of_n1, of_p, of_n2, of_e, of_n3, of_out = (
            torch.stack(parts[::-1]) for parts in zip(*steps, strict=True)
        )
        zs, xhs = (torch.cat(parts) for parts in list(zip(*ctx.kept, strict=True))[:2])
        ss = torch.cat([kept[6] for kept in ctx.kept])
        return (
            None,
            of_m,
            of_e,
            of_h,
            of_z,
            of_m.flatten(0, 1).t() @ zs,
            *norm_1.of_weights(of_n1),
            of_p.flatten(0, 1).t() @ xhs,
            *norm_2.of_weights(of_n2),
            of_e.flatten(0, 1).t() @ torch.cat(ctx.hs),
            *norm_3.of_weights(of_n3),
            of_out.flatten(0, 1).t() @ ss,
            of_out.sum((0, 1)),
        )
