"""The world model as the planner needs it: imagination, value, reward and termination, packed.

What it leaves out: the products that all candidates share at k = 0 are made once a plan, the
prior's deviation where nothing is drawn, termination where nobody asks, and whatever would follow
the last step. `egovcp.plan.objective.evaluate` says the same, slowly; `kernel/` is this in
8-bit integers.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from egovcp.model import WorldModel
from egovcp.model.nets import SplitMlp, ValueHead
from egovcp.plan.backends.floats import FloatHidden, FloatLinear, FloatRecurrence
from egovcp.plan.backends.layers import HiddenLayer, gru_layer, hidden_layers, weight_of
from egovcp.plan.backends.reading import q_of
from egovcp.plan.backends.root import Root, heads_of
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import Account


class _QNetwork:
    """A network of two hidden layers whose last narrow input is the action."""

    def __init__(self, mlp: SplitMlp, reads_h: bool, dtype: torch.dtype) -> None:
        first, second = hidden_layers(mlp, reads_h)
        self._first, self._second = FloatHidden(first, dtype), FloatHidden(second, dtype)
        action = weight_of(mlp.first.parts[-1])
        self._start = FloatHidden(first._replace(wide=None, narrow=action), dtype)

    def start(self, add: Tensor, action: Tensor) -> Tensor:
        """(..., outputs) at k = 0."""
        return self._second.last(self._start.between(None, action, add), None, None)

    def later(self, wide_h: Tensor | None, narrow: Tensor) -> Tensor:
        """(..., outputs) at k > 0."""
        return self._second.last(self._first.between(wide_h, narrow, None), None, None)


class _Head:
    """A head of Q, or of the reward, without what heads share."""

    def __init__(self, head: ValueHead, dtype: torch.dtype) -> None:
        self._reduced: FloatLinear | None = None
        if head.reduce is not None:
            self._reduced = FloatLinear(*map(weight_of, head.reduce.parts))
        self._network = _QNetwork(head.mlp, self._reduced is None, dtype)
        self.start = self._network.start

    def later(self, wide_h: Tensor, h: Tensor, z: Tensor, action: Tensor) -> Tensor:
        """(..., width) at k > 0."""
        if self._reduced is None:
            return self._network.later(wide_h, torch.cat([z, action], -1))
        return self._network.later(None, torch.cat([self._reduced(h, z), action], -1))


class PlanningNetwork:
    """Packed from a world model's weights as they are now; products in ``dtype``."""

    def __init__(self, model: WorldModel, config: PlannerConfig, dtype: torch.dtype) -> None:
        self._model, self._config = model, config
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        assert isinstance(norm, nn.LayerNorm)
        mix = HiddenLayer(None, torch.cat([z, action], 1), norm, None)
        self._mix = FloatHidden(mix, dtype)
        self._mix_start = FloatHidden(mix._replace(narrow=action), dtype)
        self._recur = FloatRecurrence(gru_layer(model.gru), dtype)
        wanted = None if config.latent == "sample" else model.config.latent
        self._prior = FloatHidden(hidden_layers(model.prior, True, wanted)[0], dtype)
        self._termination = FloatHidden(hidden_layers(model.termination_head, True)[0], dtype)
        self._heads = [_Head(head, dtype) for head in heads_of(model)]
        self._q_heads = self._heads[: model.config.q_heads]
        self._shared: _QNetwork | None = None
        if (shared := model.q_heads.passing) is not None:
            self._shared = _QNetwork(shared, False, dtype)
            self._passing = FloatHidden(hidden_layers(model.decode_passing, True)[0], dtype)

    def worth(self, root: Root, actions: Tensor, noise: Tensor | None) -> Tensor:
        """J (...) of plans (..., N, 7); noise (N - 1, latent) under ``latent=sample``."""
        each = actions.unbind(-2)
        account = Account(self._config, self._model, len(each))
        if account.asks_value(0):
            own = [
                head.start(add, each[0])
                for head, add in zip(self._q_heads, root.values, strict=False)
            ]
            account.value(self._read(own, self._shared_start(root, each[0])))
        else:
            account.reward(self._earned(self._heads[-1].start(root.values[-1], each[0])))
        x = self._mix_start.between(None, each[0], root.mix)
        wide_h: Tensor | None = None
        h, add = root.h, root.gates
        for k in range(1, len(each)):
            h, wide_h = self._recur(x, wide_h, add if k == 1 else None, h)
            z = self._next_z(wide_h, None if noise is None else noise[k - 1])
            if account.asks_value(k):
                own = [head.later(wide_h, h, z, each[k]) for head in self._q_heads]
                account.value(self._read(own, self._shared_later(root, k, wide_h, z, each[k])))
            else:
                account.reward(self._earned(self._heads[-1].later(wide_h, h, z, each[k])))
            if k == len(each) - 1:
                break  # nothing follows the last step
            account.risk(torch.sigmoid(self._termination.last(wide_h, z, None)[..., 0]))
            x = self._mix.between(None, torch.cat([z, each[k]], -1), None)
        return account.worth()

    def _shared_start(self, root: Root, action: Tensor) -> Tensor | float:
        """What the heads of Q share, (..., width) at k = 0."""
        if self._shared is None or root.passing is None:
            return 0.0
        return self._shared.start(root.passing, action)

    def _shared_later(
        self, root: Root, k: int, wide_h: Tensor, z: Tensor, action: Tensor
    ) -> Tensor | float:
        """The same at k > 0."""
        if self._shared is None:
            return 0.0
        told = self._told(wide_h, z) if root.flight is None else root.told(k)
        assert told is not None
        told = told.expand(*action.shape[:-1], -1)
        return self._shared.later(None, torch.cat([told, action], -1))

    def _next_z(self, wide_h: Tensor, noise: Tensor | None) -> Tensor:
        out = self._prior.last(wide_h, None, None)
        if noise is None:
            return out
        mean, raw = out.chunk(2, -1)
        std = F.softplus(raw + 0.54) + self._model.config.min_std
        return mean + std * noise

    def _told(self, wide_h: Tensor, z: Tensor) -> Tensor:
        """`WorldModel.passing`."""
        out = self._passing.last(wide_h, z, None)
        coming = torch.sigmoid(out[..., 3:])
        return torch.cat([coming, coming * out[..., :3]], -1)

    def _earned(self, outputs: Tensor) -> Tensor:
        """The reward (...) in its own units, of outputs (..., 1)."""
        return outputs[..., 0] * self._model.return_std

    def _read(self, own: list[Tensor], shared: Tensor | float) -> Tensor:
        outputs = torch.stack([q + shared for q in own], -2)
        return q_of(self._model, self._config, outputs)
