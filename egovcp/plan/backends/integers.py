"""The planning network packed for `kernel/kernel.c`: wide products in 8-bit integers.

Weights have a scale per output, inputs a scale per row: what a row gives does not depend on the
rows beside it.
"""

from __future__ import annotations

import ctypes
from itertools import accumulate
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel, value
from egovcp.model.config import ValueLoss
from egovcp.model.nets import SplitLinear, SplitMlp, ValueHead
from egovcp.plan.backends import library
from egovcp.plan.backends.layers import first_outputs, gru_layer, linears_of, norms_of, weight_of
from egovcp.plan.backends.root import heads_of, told_along
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

    description: library.Root
    tensors: tuple[object, ...]
    flight: Tensor | None  # (1, n) what is remembered of one
    told: dict[int, Tensor | None]  # (N, 4) by number of steps N


class IntegerNetwork:
    """Packed from a world model's weights as they are now.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
        UsageError: the model has sizes that the kernel does not take.
    """

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._kernel = kernel = library.library()
        self._model = model
        heads = len(heads_of(model))
        outputs = value.width(model.config.value_loss)
        self._width = 1 if outputs == 1 else _whole(outputs)
        assert self._width <= MOST_FEW
        self._packed = _Packed(model, config, library.layout(kernel))
        self._start = self._packed.start
        parts = self._start.values // heads
        sizes = [self._start.gates, *[parts] * heads, self._start.mix, self._start.passing]
        *self._places, self._sums = accumulate(sizes, initial=0)
        self._threads = library.Threads(kernel, torch.get_num_threads())

    def shared(self, carry: Carry) -> Shared:
        """Of one robot, from its state (1, ...)."""
        h, z = carry.h.contiguous(), carry.z.contiguous()
        told = self._model.passing(carry).contiguous() if self._start.passing else None
        words = torch.zeros(self._start.hidden + LANES, dtype=torch.int16)
        sums = torch.zeros(self._sums)
        address = sums.data_ptr()
        nothing = self._kernel.start(
            ctypes.byref(self._start),
            h.data_ptr(),
            z.data_ptr(),
            None if told is None else told.data_ptr(),
            words.data_ptr(),
            address,
        )
        gates, *each, mix, passing = (address + 4 * place for place in self._places)
        values = (ctypes.c_void_p * len(each))(*each)
        description = library.Root(
            words.data_ptr(), mix, gates, ctypes.addressof(values), passing, None, nothing
        )
        flight = carry.flight if self._start.passing else None
        return Shared(description, (words, sums, values), flight, {})

    def worth(self, shared: Shared, actions: Tensor, noise: Tensor | None) -> Tensor:
        """J (M,) of plans (M, N, 7), by as many threads as there are."""
        plans, steps, _ = actions.shape
        values = torch.empty(plans)
        if steps not in shared.told:  # the same for every iteration of a search
            shared.told[steps] = None if shared.flight is None else told_along(shared.flight, steps)
        told = shared.told[steps]
        shared.description.told = None if told is None else told.data_ptr()
        actions, noise = actions.contiguous(), None if noise is None else noise.contiguous()
        self._threads.judge(
            network=ctypes.addressof(self._packed.network),
            root=ctypes.addressof(shared.description),
            rows=plans,
            steps=steps,
            width=self._width,
            actions=actions.data_ptr(),
            noise=None if noise is None else noise.data_ptr(),
            worth=values.data_ptr(),
        )
        return values

    def soon(self) -> None:
        """There is going to be something to compute."""
        self._threads.call()


def _whole(count: int) -> int:
    """Filled up to whole vectors."""
    return -(-count // LANES) * LANES


class _Packed:
    """A network's description for the kernel, and the tensors that it points into."""

    def __init__(self, model: WorldModel, config: PlannerConfig, layout: library.Layout) -> None:
        self._kept: list[object] = []
        self._layout = layout
        c = model.config
        if max(2 * c.latent, c.value_state) > MOST_FEW:
            raise UsageError(
                f"a latent of {c.latent} or value_state of {c.value_state}: the int8 planner takes "
                f"up to {MOST_FEW // 2} and {MOST_FEW}; {library.OTHERWISE}"
            )
        self.network = n = library.Network()
        n.hidden, n.latent, n.actions, n.heads = c.hidden, c.latent, spec.ACTION_DIM, c.q_heads
        n.min_std = c.min_std
        n.silu, n.tanh = (self._keep(t, torch.int16) for t in (silu_table(), tanh_table()))
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        assert isinstance(norm, nn.LayerNorm)
        n.mix = self._layer(norm, beside=z, few=[action])
        n.gru = self._gru(model)
        n.prior, top = self._one_hidden(model.prior)
        self._prior_top(first_outputs(top, None if config.latent == "sample" else c.latent))
        n.termination, top = self._one_hidden(model.termination_head)
        n.termination_top = self._top(top)
        if (shared := model.q_heads.passing) is not None:
            n.passing = self._mlp(shared, wide=False)
            n.told, top = self._one_hidden(model.decode_passing)
            n.told_top = self._top(top)
        n.reading = library.Reading(
            OBJECTIVES.index(config.objective),
            RULES.index(config.termination_rule),
            config.ensemble == "min",
            *self._bins(c.value_loss),
            *map(float, (model.return_mean, model.return_std, model.return_floor)),
            config.termination_threshold,
            float(model.discount),
        )
        self.start = self._shared(model)
        heads = (library.Head * c.q_heads)(*map(self._head, model.q_heads.states))
        n.head = ctypes.cast(heads, ctypes.c_void_p)
        if model.reward_head is not None:
            n.reward = self._head(model.reward_head)
        self._kept.append(heads)

    def _bins(self, kind: ValueLoss) -> tuple[int, int | None]:
        """How many numbers the outputs of a head are a distribution over, and these."""
        values = value.bins(kind)
        if values is None:
            return 0, None
        return len(values), self._keep(nn.functional.pad(values, (0, -len(values) % LANES)))

    def _shared(self, model: WorldModel) -> library.Start:
        """The weights of what candidates share, centred as those of their layers."""
        of_h, of_z = [gru_layer(model.gru).wide_h], []
        for head in heads_of(model):
            *state, _ = map(weight_of, head.mlp.first.parts)
            if head.reduce is not None:
                state = [state[0] @ weight_of(part) for part in head.reduce.parts]
            of_h.append(state[0])
            of_z.append(state[1])
        of_z.append(weight_of(model.mix.parts[0]))
        shared = model.q_heads.passing
        told = (
            weight_of(model.mix.parts[0])[:0]
            if shared is None
            else weight_of(shared.first.parts[0])
        )
        h, z = (torch.cat([_centred_columns(w) for w in parts]) for parts in (of_h, of_z))
        gates, mix = len(of_h[0]), len(of_z[-1])
        sizes = (model.config.hidden, model.config.latent, gates, len(h) - gates, mix, len(told))
        return library.Start(*sizes, *(self._keep(w.t()) for w in (h, z, _centred_columns(told))))

    def _keep(self, tensor: Tensor, dtype: torch.dtype = torch.float32) -> int:
        """The address of a copy."""
        copy = tensor.detach().to("cpu", dtype).contiguous().clone()
        self._kept.append(copy)
        return copy.data_ptr()

    def _head(self, head: ValueHead) -> library.Head:
        packed = library.Head()
        if head.reduce is not None:
            packed.reduce_h, packed.reduce_z = self._reduced(head.reduce)
        packed.state = self._mlp(head.mlp, wide=head.reduce is None)
        return packed

    def _reduced(self, reduce: SplitLinear) -> tuple[library.Linear, library.Narrow]:
        """Two layers whose outputs add up: of h, which comes in words, and of z."""
        h, z = map(weight_of, reduce.parts)
        bias = h.new_zeros(len(h))
        z, _ = _filled(z, bias)
        return self._linear(h / ONE, bias, single=False), library.Narrow(
            z.shape[1], self._keep(z.t())
        )

    def _top(self, top: nn.Linear) -> library.Linear:
        """Of a hidden layer, which comes in words."""
        return self._linear(top.weight / UNIT, top.bias, single=len(top.bias) == 1)

    def _mlp(self, mlp: SplitMlp, wide: bool) -> library.Mlp:
        """Two hidden layers, the first one of h and z if ``wide``, else of a few numbers."""
        *state, action = map(weight_of, mlp.first.parts)
        first, second = norms_of(mlp)
        between, top = linears_of(mlp)
        packed = library.Mlp()
        if wide:
            packed.first = self._layer(first, wide=state[0], beside=state[1], few=[action])
        else:
            packed.first = self._layer(first, few=[action, state[0]])
        packed.second = self._layer(second, wide=between.weight, wide_is_state=False)
        packed.top = self._top(top)
        return packed

    def _one_hidden(self, mlp: SplitMlp) -> tuple[library.Layer, nn.Linear]:
        """One hidden layer of h, or of h and z; and the layer on top."""
        weights = [weight_of(part) for part in mlp.first.parts]
        (norm,), (top,) = norms_of(mlp), linears_of(mlp)
        beside = weights[1] if len(weights) > 1 else None
        return self._layer(norm, wide=weights[0], beside=beside), top

    def _prior_top(self, top: nn.Linear) -> None:
        weight, bias = _filled(top.weight, top.bias)
        self.network.prior_outputs = len(bias)
        self.network.prior_bias = self._keep(bias)
        self.network.prior_top = self._wide(weight, state=False)

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
        few: list[Tensor] | None = None,
        wide_is_state: bool = True,
    ) -> library.Layer:
        layer = self._normalised(UNIT * norm.weight, UNIT * norm.bias, norm.eps)
        if wide is not None:
            layer.wide = self._wide(_centred_columns(wide), wide_is_state)
        if beside is not None:
            layer.beside = self._wide(_centred_columns(beside), state=True)
        if few is not None:
            layer.few = self._narrow(torch.cat(few, 1))
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

    def _narrow(self, weight: Tensor) -> library.Narrow:
        return library.Narrow(weight.shape[1], self._keep(_centred_columns(weight).t()))

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

    def _linear(self, weight: Tensor, bias: Tensor, single: bool) -> library.Linear:
        """Of a weight (N, K) for words. No lane of a sum may pass 2^31: that limits a row's sum."""
        inputs, weight, lanes = weight.shape[1], weight.detach(), self._layout.lanes
        if single:
            blocks = torch.nn.functional.pad(weight, (0, -inputs % WORDS)).view(1, -1, lanes, 2)
            largest = blocks.abs().sum((1, 3)).amax(1)
        else:
            weight, bias = _filled(weight, bias)
            blocks = weight.view(-1, lanes, inputs // 2, 2).transpose(1, 2)
            largest = weight.abs().sum(1)
        least = weight.abs().amax(1) / (ONE - 1)
        scale = torch.maximum(largest / (2 * ONE - 2 * WIDEST), least).clamp_min(1e-30)
        whole = blocks / scale.view(-1, 1, 1 if single else lanes, 1)
        parts = (self._keep(whole.round(), torch.int16), self._keep(scale), self._keep(bias))
        return library.Linear(inputs, len(bias), *parts)


def _filled(weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """(n, K), (n,) -> whole vectors of outputs, the further ones zero."""
    more = (0, -len(bias) % LANES)
    pad = torch.nn.functional.pad
    return pad(weight.detach(), (0, 0, *more)), pad(bias.detach(), more)


def _centred_columns(weight: Tensor) -> Tensor:
    """A weight (N, K) whose outputs have no mean: LayerNorm takes it away in any case."""
    return weight - weight.mean(0)
