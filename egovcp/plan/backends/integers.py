"""The planning network packed for `kernel/kernel.c`: wide products in 8-bit integers.

Weights have a scale per output, inputs a scale per row: what a row gives does not depend on the
rows beside it.
"""

from __future__ import annotations

import ctypes
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel, value
from egovcp.model.config import ValueLoss
from egovcp.model.networks import SplitMlp
from egovcp.plan.backends import library
from egovcp.plan.backends.layers import first_outputs, gru_layer, linears_of, norms_of, weight_of
from egovcp.plan.backends.tables import LEAST_SILU, ONE, UNIT, silu_table, tanh_table
from egovcp.plan.config import PlannerConfig

LANES: Final = 16
WORDS: Final = 32
"""Vectors of the widest kernel: outputs are filled up to whole ones."""
WIDEST: Final = 1024
MOST_FEW: Final = 128
LEVELS: Final = 127
OBJECTIVES: Final = ("value", "reward", "td")
RULES: Final = ("paper", "shift", "survival")
"""As the kernel counts them."""


class Shared(NamedTuple):
    """What the candidates of one robot share, as the kernel reads it; keeps its tensors alive."""

    description: library.SharedPrefix
    tensors: tuple[Tensor, ...]


class IntegerNetwork:
    """Packed from a world model's weights as they are now.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
        UsageError: the model has sizes that the kernel does not take.
    """

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._kernel = kernel = library.library()
        self._packed = _Packed(model, config, library.layout(kernel))
        self._start = start = self._packed.start
        value_at, mix_at = start.gates, start.gates + start.heads
        self._places = (mix_at, 0, value_at, value_at + model.config.units)
        self._sums = mix_at + start.mix
        self._threads = library.Threads(kernel, torch.get_num_threads())

    def shared(self, carry: Carry) -> Shared:
        """Of one robot, from its state (1, ...)."""
        h, z = carry.h.contiguous(), carry.z.contiguous()
        words = torch.zeros(self._start.hidden + LANES, dtype=torch.int16)
        sums = torch.zeros(self._sums)
        address = sums.data_ptr()
        nothing = self._kernel.start(
            ctypes.byref(self._start), h.data_ptr(), z.data_ptr(), words.data_ptr(), address
        )
        places = (address + 4 * place for place in self._places)  # mix, gates, value, reward
        return Shared(library.SharedPrefix(words.data_ptr(), *places, nothing), (words, sums))

    def plan_value(self, shared: Shared, actions: Tensor, noise: Tensor | None) -> Tensor:
        """J (M,) of plans (M, N, 7), by as many threads as there are."""
        plans, steps, _ = actions.shape
        values = torch.empty(plans)
        actions, noise = actions.contiguous(), None if noise is None else noise.contiguous()
        self._threads.evaluate(
            network=ctypes.addressof(self._packed.network),
            root=ctypes.addressof(shared.description),
            rows=plans,
            steps=steps,
            actions=actions.data_ptr(),
            noise=None if noise is None else noise.data_ptr(),
            worth=values.data_ptr(),
        )
        return values

    def soon(self) -> None:
        """There is going to be something to compute."""
        self._threads.call()


class _Packed:
    """A network's description for the kernel, and the tensors that it points into."""

    def __init__(self, model: WorldModel, config: PlannerConfig, layout: library.Layout) -> None:
        self._kept: list[Tensor] = []
        self._layout = layout
        c = model.config
        if 2 * c.latent > MOST_FEW:
            raise UsageError(
                f"a latent of {c.latent}: the int8 planner takes up to {MOST_FEW // 2}; "
                f"{library.OTHERWISE}"
            )
        self.network = n = library.Network()
        n.hidden, n.latent, n.actions = c.hidden, c.latent, spec.ACTION_DIM
        n.min_std = c.min_std
        n.silu, n.tanh = (self._keep(t, torch.int16) for t in (silu_table(), tanh_table()))
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        assert isinstance(norm, nn.LayerNorm)
        n.mix = self._layer(norm, beside=z, few=action)
        n.gru = self._gru(model)
        n.prior, top = self._one_hidden(model.prior)
        n.prior_top = self._top(first_outputs(top, None if config.latent == "sample" else c.latent))
        n.termination, top = self._one_hidden(model.termination_head)
        n.termination_top = self._dot(top)
        n.reading = library.Reading(
            OBJECTIVES.index(config.objective),
            RULES.index(config.termination_rule),
            *self._bins(c.value_loss),
            *map(float, (model.return_mean, model.return_std, model.min_return)),
            config.termination_threshold,
            float(model.discount),
        )
        self.start = self._shared(model)
        n.value = self._head(model.value_head)
        if model.reward_head is not None:
            n.reward = self._head(model.reward_head)

    def _bins(self, kind: ValueLoss) -> tuple[int, int | None]:
        """Number of the bins of Q and their values; none if Q is a number."""
        values = value.bins(kind)
        if values is None:
            return 0, None
        return len(values), self._keep(nn.functional.pad(values, (0, -len(values) % LANES)))

    def _shared(self, model: WorldModel) -> library.Start:
        """The weights of what candidates share, centred as those of their layers."""
        heads = [head for head in (model.value_head, model.reward_head) if head is not None]
        of_h = [gru_layer(model.gru).wide_h, *(weight_of(head.first.parts[0]) for head in heads)]
        of_z = [*(weight_of(head.first.parts[1]) for head in heads), weight_of(model.mix.parts[0])]
        h, z = (torch.cat([_centred_columns(w) for w in parts]) for parts in (of_h, of_z))
        gates, mix = len(of_h[0]), len(of_z[-1])
        sizes = (model.config.hidden, model.config.latent, gates, len(h) - gates, mix)
        return library.Start(*sizes, self._keep(h.t()), self._keep(z.t()))

    def _keep(self, tensor: Tensor, dtype: torch.dtype = torch.float32) -> int:
        """The address of a copy."""
        copy = tensor.detach().to("cpu", dtype).contiguous().clone()
        self._kept.append(copy)
        return copy.data_ptr()

    def _head(self, mlp: SplitMlp) -> library.Head:
        """Two hidden layers over (h, z, a)."""
        h, z, action = map(weight_of, mlp.first.parts)
        first, second = norms_of(mlp)
        between, top = linears_of(mlp)
        packed = library.Head()
        packed.first = self._layer(first, wide=h, beside=z, few=action)
        packed.second = self._layer(second, wide=between.weight, wide_is_state=False)
        if len(top.bias) == 1:
            packed.one = self._dot(top)
        else:
            packed.many = self._top(top)
        return packed

    def _one_hidden(self, mlp: SplitMlp) -> tuple[library.Layer, nn.Linear]:
        """One hidden layer of h, or of h and z; and the layer on top."""
        weights = [weight_of(part) for part in mlp.first.parts]
        (norm,), (top,) = norms_of(mlp), linears_of(mlp)
        beside = weights[1] if len(weights) > 1 else None
        return self._layer(norm, wide=weights[0], beside=beside), top

    def _top(self, top: nn.Linear) -> library.Top:
        """Many outputs, of a hidden layer in bytes."""
        more = -len(top.bias) % LANES
        weight = nn.functional.pad(top.weight.detach(), (0, 0, 0, more))
        bias = nn.functional.pad(top.bias.detach(), (0, more))
        assert len(bias) <= MOST_FEW
        return library.Top(len(bias), self._wide(weight, state=False), self._keep(bias))

    def _dot(self, top: nn.Linear) -> library.Dot:
        """One output, of a hidden layer in words. No lane of its sum may pass 2^31: that limits
        the weights."""
        weight = top.weight.detach()[0] / UNIT
        inputs = len(weight)
        weight = nn.functional.pad(weight, (0, -inputs % WORDS))
        largest = weight.view(-1, self._layout.lanes, 2).abs().sum((0, 2)).amax()
        least = weight.abs().amax() / (ONE - 1)
        scale = float(torch.maximum(largest / (2 * ONE - 2 * WIDEST), least).clamp_min(1e-30))
        whole = self._keep((weight / scale).round(), torch.int16)
        return library.Dot(inputs, whole, scale, float(top.bias.detach()[0]))

    def _gru(self, model: WorldModel) -> library.Layer:
        gru = gru_layer(model.gru)
        half = ONE / 4 / 2  # tanh takes words of up to 4; gates are tanh of half their sums
        unit = torch.tensor([half, UNIT, half]).repeat_interleave(model.config.hidden)
        layer = self._normalised(unit * gru.gamma, unit * gru.beta, gru.epsilon)
        layer.wide = self._wide(_centred_columns(gru.wide_x), state=False)
        layer.beside = self._wide(_centred_columns(gru.wide_h), state=True)
        return layer

    def _layer(
        self,
        norm: nn.LayerNorm,
        wide: Tensor | None = None,
        beside: Tensor | None = None,
        few: Tensor | None = None,
        wide_is_state: bool = True,
    ) -> library.Layer:
        layer = self._normalised(UNIT * norm.weight, UNIT * norm.bias, norm.eps)
        if wide is not None:
            layer.wide = self._wide(_centred_columns(wide), wide_is_state)
        if beside is not None:
            layer.beside = self._wide(_centred_columns(beside), state=True)
        if few is not None:
            layer.few = library.Narrow(few.shape[1], self._keep(_centred_columns(few).t()))
        return layer

    def _normalised(self, gamma: Tensor, beta: Tensor, epsilon: float) -> library.Layer:
        outputs = len(gamma)
        if outputs % LANES or outputs > WIDEST:
            raise UsageError(
                f"a layer of {outputs} units: the int8 planner takes multiples of {LANES} up to "
                f"{WIDEST}; {library.OTHERWISE}"
            )
        layer = library.Layer()
        layer.outputs, layer.epsilon = outputs, epsilon
        pad = torch.nn.functional.pad
        layer.gamma, layer.beta = (self._keep(pad(x, (0, LANES))) for x in (gamma, beta))
        return layer

    def _wide(self, weight: Tensor, state: bool) -> library.Wide:
        """Of a weight (N, K) for inputs of h or z (symmetric), or of a hidden layer."""
        zero, offset = (128, 0.0) if state else (0, LEAST_SILU)
        weight = torch.nn.functional.pad(
            weight.detach().float(), (0, -weight.shape[1] % self._layout.depth)
        )
        outputs, inputs = weight.shape
        if inputs > WIDEST:
            raise UsageError(f"a layer of {inputs} inputs; {library.OTHERWISE}")
        scale = weight.abs().amax(1).clamp_min(1e-12) / LEVELS
        whole = (weight / scale[:, None]).round()
        total = whole.sum(1)
        _, lanes, group = self._layout
        blocks = whole.view(outputs // lanes, lanes, inputs // group, group).transpose(1, 2)
        return library.Wide(
            inputs,
            self._keep(blocks, torch.int8),
            self._keep(scale),
            self._keep(-zero * total, torch.int32),
            self._keep(offset * scale * total),
        )


def _centred_columns(weight: Tensor) -> Tensor:
    """A weight (N, K) whose outputs have no mean: LayerNorm takes it away in any case."""
    return weight - weight.mean(0)
