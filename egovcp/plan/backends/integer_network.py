"""The planning network for `kernel/kernel.c`: wide products in 8-bit integers.

Weights have a scale per output, inputs a scale per row, so that the result of a row does not depend
on the other rows. Activations are piecewise linear, in 16-bit fixed point.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel, value
from egovcp.model.config import ValueLoss
from egovcp.model.networks import SplitMlp
from egovcp.plan.backends import library
from egovcp.plan.backends.layers import first_outputs, gru_layer, linears_of, norms_of, weight_of
from egovcp.plan.config import PlannerConfig

LANES: Final = 16
WORDS: Final = 32
"""Lanes of float and 16-bit vectors of the widest kernel: outputs are padded to multiples."""
MAX_WIDE: Final = 1024
MAX_NARROW: Final = 128
MAX_ROWS: Final = 16
"""Candidates of a block of the widest kernel."""
MAX_STACK_BYTES: Final = 1 << 20
"""Limit of the actions and values of a block, which are on the stack."""
LEVELS: Final = 127
"""Largest integer of a weight."""
OBJECTIVES: Final = ("value", "reward", "td")
RULES: Final = ("paper", "shift", "survival")
"""In the order of the kernel's enumerations."""
NODES: Final = 64
"""Nodes of the table of an activation."""
HIDDEN_ONE: Final = 2048
"""Fixed-point 1 of hidden layers; 16 bits hold values up to 16."""
STATE_ONE: Final = 32768
"""Fixed-point 1 of h, tanh and gates."""
LEAST_SILU: Final = -571 / HIDDEN_ONE
"""Offset of the bytes of hidden layers, below the minimum of SiLU, -0.27846."""


class KernelPrefix(NamedTuple):
    """The shared prefix of one robot for the kernel, and the tensors that it points into."""

    struct: library.CSharedPrefix
    tensors: tuple[Tensor, ...]


class IntegerNetwork:
    """A world model packed for the kernel; later changes of its weights are not seen.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
        UsageError: the model has sizes that the kernel does not support.
    """

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._kernel = kernel = library.load_kernel()
        self._packed = _Packed(model, config, library.weight_layout(kernel))
        self._prefix_weights = weights = self._packed.prefix_weights
        value_at, mix_at = weights.gates, weights.gates + weights.heads
        self._offsets = (mix_at, 0, value_at, value_at + model.config.units)
        self._sum_count = mix_at + weights.mix
        self._threads = library.Threads(kernel, torch.get_num_threads())

    def shared_prefix(self, carry: Carry) -> KernelPrefix:
        """The shared prefix of one robot at its state (1, ...)."""
        h, z = carry.h.contiguous(), carry.z.contiguous()
        words = torch.zeros(self._prefix_weights.hidden + LANES, dtype=torch.int16)
        sums = torch.zeros(self._sum_count)
        address = sums.data_ptr()
        weights = ctypes.byref(self._prefix_weights)
        nan = self._kernel.shared_prefix(
            weights, h.data_ptr(), z.data_ptr(), words.data_ptr(), address
        )
        addresses = (address + 4 * offset for offset in self._offsets)  # mix, gates, value, reward
        return KernelPrefix(library.CSharedPrefix(words.data_ptr(), *addresses, nan), (words, sums))

    def plan_value(self, prefix: KernelPrefix, actions: Tensor, noise: Tensor | None) -> Tensor:
        """V (M,) of plans (M, P, 7)."""
        plans, steps, _ = actions.shape
        values = torch.empty(plans)
        actions, noise = actions.contiguous(), None if noise is None else noise.contiguous()
        self._threads.evaluate(
            network=ctypes.addressof(self._packed.network),
            prefix=ctypes.addressof(prefix.struct),
            plans=plans,
            steps=steps,
            actions=actions.data_ptr(),
            noise=None if noise is None else noise.data_ptr(),
            values=values.data_ptr(),
        )
        return values

    def wake(self) -> None:
        """Wake the threads for evaluations that follow."""
        self._threads.wake()


class _Packed:
    """A network as the kernel's structures, and the tensors that they point into."""

    def __init__(
        self, model: WorldModel, config: PlannerConfig, layout: library.WeightLayout
    ) -> None:
        self._tensors: list[Tensor] = []
        self._layout = layout
        c = model.config
        if 2 * c.latent > MAX_NARROW:
            raise UsageError(
                f"a latent of {c.latent}: the int8 planner takes up to {MAX_NARROW // 2}; "
                f"{library.FLOAT32_HINT}"
            )
        numbers = config.actions * (model.robot.action_dim + 2)  # of a candidate
        if 4 * MAX_ROWS * numbers > MAX_STACK_BYTES:
            raise UsageError(
                f"a plan of {config.actions} steps of {model.robot.action_dim} actions is too long "
                f"for the int8 planner; {library.FLOAT32_HINT}"
            )
        self.network = n = library.CNetwork()
        n.hidden, n.latent, n.actions = c.hidden, c.latent, model.robot.action_dim
        n.min_std = c.min_std
        n.silu, n.tanh = (self._address(t, torch.int16) for t in (silu_table(), tanh_table()))
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        assert isinstance(norm, nn.LayerNorm)
        n.mix = self._layer(norm, second=z, narrow=action)
        n.gru = self._gru(model)
        n.prior, top = self._one_hidden(model.prior)
        n.prior_top = self._top(first_outputs(top, None if config.latent == "sample" else c.latent))
        n.termination, top = self._one_hidden(model.termination_head)
        n.termination_top = self._dot(top)
        n.readout = library.CReadout(
            OBJECTIVES.index(config.objective),
            RULES.index(config.termination_rule),
            *self._bins(c.value_loss),
            *map(float, (model.return_mean, model.return_std, model.min_return)),
            config.termination_threshold,
            float(model.discount),
        )
        self.prefix_weights = self._shared(model)
        n.value = self._head(model.value_head)
        if model.reward_head is not None:
            n.reward = self._head(model.reward_head)

    def _bins(self, kind: ValueLoss) -> tuple[int, int | None]:
        """Number of the bins of Q and the address of their values; (0, None) if Q is a scalar."""
        values = value.bins(kind)
        if values is None:
            return 0, None
        return len(values), self._address(F.pad(values, (0, -len(values) % LANES)))

    def _shared(self, model: WorldModel) -> library.CPrefixWeights:
        """The weights of the shared prefix, centred like those of their layers."""
        heads = [head for head in (model.value_head, model.reward_head) if head is not None]
        gates, mix = gru_layer(model.gru).wide_h, weight_of(model.mix.parts[0])
        h_parts = [gates, *(weight_of(head.first.parts[0]) for head in heads)]
        z_parts = [*(weight_of(head.first.parts[1]) for head in heads), mix]
        h, z = (torch.cat([_centred_columns(w) for w in parts]) for parts in (h_parts, z_parts))
        heads_size = len(h) - len(gates)
        sizes = (model.config.hidden, model.config.latent, len(gates), heads_size, len(mix))
        return library.CPrefixWeights(*sizes, self._address(h.t()), self._address(z.t()))

    def _address(self, tensor: Tensor, dtype: torch.dtype = torch.float32) -> int:
        """Address of a copy, which lives as long as this object."""
        copy = tensor.detach().to("cpu", dtype).contiguous().clone()
        self._tensors.append(copy)
        return copy.data_ptr()

    def _head(self, mlp: SplitMlp) -> library.CHead:
        """Two hidden layers over (h, z, a)."""
        h, z, action = map(weight_of, mlp.first.parts)
        first, second = norms_of(mlp)
        between, top = linears_of(mlp)
        packed = library.CHead()
        packed.first = self._layer(first, wide=h, second=z, narrow=action)
        packed.second = self._layer(second, wide=between.weight, wide_is_state=False)
        if len(top.bias) == 1:
            packed.scalar_top = self._dot(top)
        else:
            packed.vector_top = self._top(top)
        return packed

    def _one_hidden(self, mlp: SplitMlp) -> tuple[library.CLayer, nn.Linear]:
        """One hidden layer of h, or of h and z; and the layer on top."""
        weights = [weight_of(part) for part in mlp.first.parts]
        (norm,), (top,) = norms_of(mlp), linears_of(mlp)
        second = weights[1] if len(weights) > 1 else None
        return self._layer(norm, wide=weights[0], second=second), top

    def _top(self, top: nn.Linear) -> library.CTop:
        """A linear layer with many outputs, of a hidden layer in bytes."""
        more = -len(top.bias) % LANES
        weight = F.pad(top.weight.detach(), (0, 0, 0, more))
        bias = F.pad(top.bias.detach(), (0, more))
        assert len(bias) <= MAX_NARROW
        return library.CTop(len(bias), self._wide(weight, state=False), self._address(bias))

    def _dot(self, top: nn.Linear) -> library.CDot:
        """A linear layer with one output, of a hidden layer in 16 bits.

        The weights are scaled so that no lane of the sum exceeds 2^31.
        """
        weight = top.weight.detach()[0] / HIDDEN_ONE
        inputs = len(weight)
        weight = F.pad(weight, (0, -inputs % WORDS))
        largest = weight.view(-1, self._layout.lanes, 2).abs().sum((0, 2)).amax()
        least = weight.abs().amax() / (STATE_ONE - 1)
        scale = float(
            torch.maximum(largest / (2 * STATE_ONE - 2 * MAX_WIDE), least).clamp_min(1e-30)
        )
        whole = self._address((weight / scale).round(), torch.int16)
        return library.CDot(inputs, whole, scale, float(top.bias.detach()[0]))

    def _gru(self, model: WorldModel) -> library.CLayer:
        gru = gru_layer(model.gru)
        half = STATE_ONE / 4 / 2  # the input range of tanh is 4; gates are tanh of half their sums
        unit = torch.tensor([half, HIDDEN_ONE, half]).repeat_interleave(model.config.hidden)
        layer = self._normalised(unit * gru.gamma, unit * gru.beta, gru.epsilon)
        layer.wide = self._wide(_centred_columns(gru.wide_x), state=False)
        layer.second = self._wide(_centred_columns(gru.wide_h), state=True)
        return layer

    def _layer(
        self,
        norm: nn.LayerNorm,
        wide: Tensor | None = None,
        second: Tensor | None = None,
        narrow: Tensor | None = None,
        wide_is_state: bool = True,
    ) -> library.CLayer:
        layer = self._normalised(HIDDEN_ONE * norm.weight, HIDDEN_ONE * norm.bias, norm.eps)
        if wide is not None:
            layer.wide = self._wide(_centred_columns(wide), wide_is_state)
        if second is not None:
            layer.second = self._wide(_centred_columns(second), state=True)
        if narrow is not None:
            layer.narrow = library.CNarrow(
                narrow.shape[1], self._address(_centred_columns(narrow).t())
            )
        return layer

    def _normalised(self, gamma: Tensor, beta: Tensor, epsilon: float) -> library.CLayer:
        outputs = len(gamma)
        if outputs % LANES or outputs > MAX_WIDE:
            raise UsageError(
                f"a layer of {outputs} units: the int8 planner takes multiples of {LANES} up to "
                f"{MAX_WIDE}; {library.FLOAT32_HINT}"
            )
        layer = library.CLayer()
        layer.outputs, layer.epsilon = outputs, epsilon
        layer.gamma, layer.beta = (self._address(F.pad(x, (0, LANES))) for x in (gamma, beta))
        return layer

    def _wide(self, weight: Tensor, state: bool) -> library.CWide:
        """A weight (N, K) for inputs h or z (symmetric range), or for a hidden layer."""
        zero, offset = (128, 0.0) if state else (0, LEAST_SILU)
        weight = F.pad(weight.detach().float(), (0, -weight.shape[1] % self._layout.depth))
        outputs, inputs = weight.shape
        assert inputs <= MAX_WIDE, "its inputs are the outputs of other layers"
        scale = weight.abs().amax(1).clamp_min(1e-12) / LEVELS
        whole = (weight / scale[:, None]).round()
        total = whole.sum(1)
        _, lanes, group = self._layout
        blocks = whole.view(outputs // lanes, lanes, inputs // group, group).transpose(1, 2)
        return library.CWide(
            inputs,
            self._address(blocks, torch.int8),
            self._address(scale),
            self._address(-zero * total, torch.int32),
            self._address(offset * scale * total),
        )


def _centred_columns(weight: Tensor) -> Tensor:
    """A weight (N, K) whose outputs have mean zero, which LayerNorm would subtract."""
    return weight - weight.mean(0)


def silu_table() -> Tensor:
    """(2, 64) of SiLU(-a), a up to 8, unit `HIDDEN_ONE`: values at nodes, and half the rise of a
    piece."""
    return _lines(lambda a: -a * torch.sigmoid(-a), 8.0 / NODES, HIDDEN_ONE)


def tanh_table() -> Tensor:
    """(2, 64) of tanh(a), a up to 4, unit `STATE_ONE`."""
    table = _lines(torch.tanh, 4.0 / NODES, STATE_ONE)
    table[0, 0] = 0  # odd
    return table


def _lines(function: Callable[[Tensor], Tensor], spacing: float, unit: int) -> Tensor:
    """Piecewise linear approximation of a function of a >= 0 with nodes ``spacing`` apart.

    Within half a spacing of a node it is the line with the smallest maximum error; beyond the last
    node it is constant.
    """
    node = spacing * torch.arange(NODES, dtype=torch.float64)
    left, right = function(node - spacing / 2), function(node + spacing / 2)
    left[0] = 2 * function(node)[0] - right[0]  # no left neighbour
    value = (function(node) + (left + right) / 2) / 2
    rise = (right - left) / 2
    rise[-1] = 0.0
    return (
        (unit * torch.stack([value, rise])).round().clamp(-STATE_ONE, STATE_ONE - 1).to(torch.int16)
    )
