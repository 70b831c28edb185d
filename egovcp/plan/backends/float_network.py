"""The world model in float32 for planning, on any device: imagination, value, reward, termination.

It computes the products that all candidates share at k = 0 once per plan, and omits the prior's
deviation if nothing is sampled, termination where the objective does not need it, and what would
follow the last step. `egovcp.plan.objective.evaluate` is the reference; `kernel/` is the same in
8-bit integers.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from egovcp.model import Carry, WorldModel, value
from egovcp.model.latent_state import Gaussian
from egovcp.model.networks import SplitMlp
from egovcp.plan.backends.layers import (
    GruLayer,
    HiddenLayer,
    gru_layer,
    hidden_layers,
    weight_of,
)
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import ReturnAccumulator


class SharedPrefix(NamedTuple):
    """Sums of first layers that all candidates of a robot share; (E, 1, ...) for E robots."""

    h: Tensor
    mix: Tensor  # of the layer before the GRU, from z
    gates: Tensor  # of the GRU's gates, from h
    value: Tensor  # of the value head, from h and z
    reward: Tensor | None  # of the reward head, from h and z; None: the model has none


def shared_prefix(model: WorldModel, carry: Carry) -> SharedPrefix:
    """The shared sums at the robots' states (E, ...)."""
    carry = model.expand_candidates(carry)
    reward = None if model.reward_head is None else _state_sums(model.reward_head, carry)
    return SharedPrefix(
        carry.h,
        model.mix.parts[0](carry.z),
        model.gru.project.parts[1](carry.h),
        _state_sums(model.value_head, carry),
        reward,
    )


def _state_sums(head: SplitMlp, carry: Carry) -> Tensor:
    """The first layer of a head over (h, z, a), without the part of the action."""
    of_h, of_z, _ = head.first.parts
    sums: Tensor = of_h(carry.h) + of_z(carry.z)
    return sums


class FloatHidden:
    """One hidden layer, and the linear layer on top if it is the last one."""

    def __init__(self, layer: HiddenLayer) -> None:
        self._wide = None if layer.wide is None else layer.wide.t().contiguous()
        self._narrow = None if layer.narrow is None else layer.narrow.t().contiguous()
        self._gamma, self._beta = layer.norm.weight.detach(), layer.norm.bias.detach()
        self._epsilon = layer.norm.eps
        if layer.last is not None:
            self._last, self._bias = layer.last.weight.detach(), layer.last.bias.detach()

    def __call__(
        self, wide: Tensor | None = None, narrow: Tensor | None = None, add: Tensor | None = None
    ) -> Tensor:
        """The layer's outputs (..., units); ``add`` is a shared partial sum."""
        total = add
        if wide is not None:
            assert self._wide is not None
            part = wide @ self._wide
            total = part if total is None else total + part
        if narrow is not None:
            assert self._narrow is not None
            part = narrow @ self._narrow
            total = part if total is None else total + part
        assert total is not None
        normal = F.layer_norm(total, self._gamma.shape, self._gamma, self._beta, self._epsilon)
        return F.silu(normal)

    def last(self, wide: Tensor | None = None, narrow: Tensor | None = None) -> Tensor:
        """(..., outputs) of the linear layer on top."""
        return F.linear(self(wide, narrow), self._last, self._bias)


class FloatGru:
    """The GRU."""

    def __init__(self, layer: GruLayer) -> None:
        self._x, self._h = layer.wide_x.t().contiguous(), layer.wide_h.t().contiguous()
        self._layer = layer

    def __call__(self, x: Tensor, h: Tensor, gates: Tensor | None = None) -> Tensor:
        """The next h (..., hidden); ``gates`` is the sum h W_h if already computed."""
        total = x @ self._x + (h @ self._h if gates is None else gates)
        layer = self._layer
        normal = F.layer_norm(total, layer.gamma.shape, layer.gamma, layer.beta, layer.epsilon)
        reset, candidate, update = normal.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(h.expand_as(candidate), candidate, torch.sigmoid(update))


class _Head:
    """The head of Q or of the reward: two hidden layers over (h, z, a)."""

    def __init__(self, mlp: SplitMlp) -> None:
        first, second = hidden_layers(mlp)
        self._first, self._second = FloatHidden(first), FloatHidden(second)
        self._of_action = FloatHidden(first._replace(narrow=weight_of(mlp.first.parts[-1])))

    def start(self, add: Tensor, action: Tensor) -> Tensor:
        """(..., outputs) at k = 0, from the shared sums of h and z."""
        return self._second.last(self._of_action(narrow=action, add=add))

    def later(self, h: Tensor, z_and_action: Tensor) -> Tensor:
        """(..., outputs) at k > 0."""
        return self._second.last(self._first(h, z_and_action))


class PlanningNetwork:
    """Imagination, value, reward and termination of a world model, with packed weights."""

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._model, self._config = model, config
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        assert isinstance(norm, nn.LayerNorm)
        mix = HiddenLayer(None, torch.cat([z, action], 1), norm, None)
        self._mix = FloatHidden(mix)
        self._mix_start = FloatHidden(mix._replace(narrow=action))
        self._recur = FloatGru(gru_layer(model.gru))
        wanted = None if config.latent == "sample" else model.config.latent
        self._prior = FloatHidden(hidden_layers(model.prior, wanted)[0])
        self._termination = FloatHidden(hidden_layers(model.termination_head)[0])
        self._value = _Head(model.value_head)
        self._reward = None if model.reward_head is None else _Head(model.reward_head)

    def plan_value(self, prefix: SharedPrefix, actions: Tensor, noise: Tensor | None) -> Tensor:
        """V (...) of plans (..., P, 7); noise (P - 1, latent) under ``latent=sample``."""
        each = actions.unbind(-2)
        accumulator = ReturnAccumulator(self._config, self._model, len(each))
        if accumulator.needs_value(0):
            accumulator.add_value(self._q(self._value.start(prefix.value, each[0])))
        else:
            assert self._reward is not None
            assert prefix.reward is not None
            accumulator.add_reward(self._r(self._reward.start(prefix.reward, each[0])))
        x = self._mix_start(narrow=each[0], add=prefix.mix)
        h = prefix.h
        for k in range(1, len(each)):
            h = self._recur(x, h, prefix.gates if k == 1 else None)
            z = self._next_z(h, None if noise is None else noise[k - 1])
            z_and_action = torch.cat([z, each[k]], -1)
            if accumulator.needs_value(k):
                accumulator.add_value(self._q(self._value.later(h, z_and_action)))
            else:
                assert self._reward is not None
                accumulator.add_reward(self._r(self._reward.later(h, z_and_action)))
            if not accumulator.needs_termination(k):
                break
            accumulator.add_termination(torch.sigmoid(self._termination.last(h, z)[..., 0]))
            x = self._mix(narrow=z_and_action)
        return accumulator.plan_value()

    def _next_z(self, h: Tensor, noise: Tensor | None) -> Tensor:
        out = self._prior.last(h)
        if noise is None:
            return out
        prior = Gaussian.from_logits(out, self._model.config.min_std)
        return prior.mean + prior.std * noise

    def _q(self, outputs: Tensor) -> Tensor:
        """Q (...) in units of return, of the value head's outputs (..., width)."""
        q = value.read(outputs, self._model.config.value_loss)
        return torch.addcmul(self._model.return_mean, q, self._model.return_std)

    def _r(self, outputs: Tensor) -> Tensor:
        """The reward (...) in its own units, of outputs (..., 1)."""
        return outputs[..., 0] * self._model.return_std
