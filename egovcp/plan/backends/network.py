"""The world model as the planner needs it: imagination, value and termination, packed.

What it leaves out: the products that all candidates share at k = 0 are made once a plan, the
prior's deviation where nothing is drawn, termination where nobody asks, and whatever would follow
the last step. `egovcp.plan.objective.evaluate` says the same, slowly; `kernel.c` is this in
8-bit integers.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from egovcp.model import WorldModel
from egovcp.model.nets import SplitMlp
from egovcp.model.world_model import QHead
from egovcp.plan.backends.floats import FloatHidden, FloatLinear, FloatRecurrence
from egovcp.plan.backends.layers import HiddenLayer, gru_layer, hidden_layers, weight_of
from egovcp.plan.backends.reading import q_of
from egovcp.plan.backends.root import Root
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import Tally


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
    """One head of Q."""

    def __init__(self, head: QHead, dtype: torch.dtype) -> None:
        self._reduced: FloatLinear | None = None
        if head.state.reduce is not None:
            self._reduced = FloatLinear(*map(weight_of, head.state.reduce.parts))
        self._state = _QNetwork(head.state.mlp, self._reduced is None, dtype)
        self._passing = None if head.passing is None else _QNetwork(head.passing, False, dtype)

    def start(self, add: list[Tensor], heard: Tensor | float, action: Tensor) -> Tensor:
        """(..., width) at k = 0; takes its sums from the front of ``add``."""
        q = self._state.start(add.pop(0), action)
        if self._passing is None:
            return q
        return q + heard * self._passing.start(add.pop(0), action)

    def later(
        self,
        wide_h: Tensor,
        h: Tensor,
        z: Tensor,
        told: Tensor | None,
        heard: Tensor | float,
        action: Tensor,
    ) -> Tensor:
        """(..., width) at k > 0."""
        if self._reduced is None:
            q = self._state.later(wide_h, torch.cat([z, action], -1))
        else:
            q = self._state.later(None, torch.cat([self._reduced(h, z), action], -1))
        if self._passing is None or told is None:
            return q
        told = told.expand(*action.shape[:-1], -1)
        return q + heard * self._passing.later(None, torch.cat([told, action], -1))


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
        self._heads = [_Head(head, dtype) for head in model.q_heads]
        self._passing: FloatHidden | None = None
        if model.passing_value_head is not None:
            self._passing = FloatHidden(hidden_layers(model.decode_passing, True)[0], dtype)

    def worth(self, root: Root, actions: Tensor, noise: Tensor | None) -> Tensor:
        """J (...) of plans (..., N, 7); noise (N - 1, latent) under ``latent=sample``."""
        each = actions.unbind(-2)
        tally = Tally(self._config, self._model.return_floor)
        sums = list(root.values)
        heard = self._heard(root.told(0))
        tally.value(self._read([head.start(sums, heard, each[0]) for head in self._heads]))
        x = self._mix_start.between(None, each[0], root.mix)
        wide_h: Tensor | None = None
        h, add = root.h, root.gates
        for k in range(1, len(each)):
            h, wide_h = self._recur(x, wide_h, add if k == 1 else None, h)
            z = self._next_z(wide_h, None if noise is None else noise[k - 1])
            told = self._told(wide_h, z) if root.flight is None else root.told(k)
            heard = self._heard(told)
            q = [head.later(wide_h, h, z, told, heard, each[k]) for head in self._heads]
            tally.value(self._read(q))
            if k == len(each) - 1:
                break  # nothing follows the last step
            tally.risk(torch.sigmoid(self._termination.last(wide_h, z, None)[..., 0]))
            x = self._mix.between(None, torch.cat([z, each[k]], -1), None)
        return tally.mean(len(each))

    def _heard(self, told: Tensor | None) -> Tensor | float:
        return 1.0 if told is None else self._model.heard(told)

    def _next_z(self, wide_h: Tensor, noise: Tensor | None) -> Tensor:
        out = self._prior.last(wide_h, None, None)
        if noise is None:
            return out
        mean, raw = out.chunk(2, -1)
        std = F.softplus(raw + 0.54) + self._model.config.min_std
        return mean + std * noise

    def _told(self, wide_h: Tensor, z: Tensor) -> Tensor | None:
        """`WorldModel.passing`."""
        if self._passing is None:
            return None
        out = self._passing.last(wide_h, z, None)
        coming = torch.sigmoid(out[..., 3:])
        return torch.cat([coming, coming * out[..., :3]], -1)

    def _read(self, outputs: list[Tensor]) -> Tensor:
        return q_of(self._model, self._config, torch.stack(outputs, -2))
