"""The world model as the planner needs it: imagination, value, reward and termination, packed.

It computes the products that all candidates share at k = 0 once a plan, and leaves out the prior's
deviation if nothing is drawn, termination where the objective does not need it, and whatever would
follow the last step. `egovcp.plan.objective.evaluate` is the reference; `kernel/` is the same in
8-bit integers.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from egovcp.model import WorldModel, value
from egovcp.model.networks import SplitMlp
from egovcp.plan.backends.floats import FloatHidden, FloatRecurrence
from egovcp.plan.backends.layers import HiddenLayer, gru_layer, hidden_layers, weight_of
from egovcp.plan.backends.shared_prefix import SharedPrefix
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import ReturnAccumulator


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
    """Packed from a world model's weights as they are now."""

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._model, self._config = model, config
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        assert isinstance(norm, nn.LayerNorm)
        mix = HiddenLayer(None, torch.cat([z, action], 1), norm, None)
        self._mix = FloatHidden(mix)
        self._mix_start = FloatHidden(mix._replace(narrow=action))
        self._recur = FloatRecurrence(gru_layer(model.gru))
        wanted = None if config.latent == "sample" else model.config.latent
        self._prior = FloatHidden(hidden_layers(model.prior, wanted)[0])
        self._termination = FloatHidden(hidden_layers(model.termination_head)[0])
        self._value = _Head(model.value_head)
        self._reward = None if model.reward_head is None else _Head(model.reward_head)

    def plan_value(self, root: SharedPrefix, actions: Tensor, noise: Tensor | None) -> Tensor:
        """J (...) of plans (..., N, 7); noise (N - 1, latent) under ``latent=sample``."""
        each = actions.unbind(-2)
        accumulator = ReturnAccumulator(self._config, self._model, len(each))
        if accumulator.asks_value(0):
            accumulator.value(self._q(self._value.start(root.value, each[0])))
        else:
            assert self._reward is not None
            assert root.reward is not None
            accumulator.reward(self._r(self._reward.start(root.reward, each[0])))
        x = self._mix_start(narrow=each[0], add=root.mix)
        h = root.h
        for k in range(1, len(each)):
            h = self._recur(x, h, root.gates if k == 1 else None)
            z = self._next_z(h, None if noise is None else noise[k - 1])
            z_and_action = torch.cat([z, each[k]], -1)
            if accumulator.asks_value(k):
                accumulator.value(self._q(self._value.later(h, z_and_action)))
            else:
                assert self._reward is not None
                accumulator.reward(self._r(self._reward.later(h, z_and_action)))
            if k == len(each) - 1:
                break  # nothing follows the last step
            accumulator.risk(torch.sigmoid(self._termination.last(h, z)[..., 0]))
            x = self._mix(narrow=z_and_action)
        return accumulator.plan_value()

    def _next_z(self, h: Tensor, noise: Tensor | None) -> Tensor:
        out = self._prior.last(h)
        if noise is None:
            return out
        mean, raw = out.chunk(2, -1)
        std = F.softplus(raw + 0.54) + self._model.config.min_std
        return mean + std * noise

    def _q(self, outputs: Tensor) -> Tensor:
        """Q (...) in units of return, of the value head's outputs (..., width)."""
        q = value.read(outputs, self._model.config.value_loss)
        return torch.addcmul(self._model.return_mean, q, self._model.return_std)

    def _r(self, outputs: Tensor) -> Tensor:
        """The reward (...) in its own units, of outputs (..., 1)."""
        return outputs[..., 0] * self._model.return_std
