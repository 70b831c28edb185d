"""The world model as the planner needs it: imagination, value and termination, packed.

What it leaves out: the products that all candidates share at k = 0 are made once a plan, the
prior's deviation where nothing is drawn, termination where nobody asks, and whatever would follow
the last step. `egovcp.plan.objective.evaluate` says the same, slowly.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from egovcp.model import Carry, WorldModel, value
from egovcp.model.nets import SplitMlp
from egovcp.model.world_model import QHead
from egovcp.plan.backends.layers import Arithmetic, HiddenLayer, gru_layer, hidden_layers, weight_of
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import Tally


class Root(NamedTuple):
    """What plans from a state share; (E, 1, ...), or of one robot (...)."""

    h: Tensor
    mix: Tensor  # sums of the first layer that leads to the GRU
    recurrence: Tensor  # sums of the GRU's gates
    values: tuple[Tensor, ...]  # sums of the first layers of Q, two for a head that is told


class _QNetwork[R]:
    """A network of two hidden layers whose last narrow input is the action."""

    def __init__(self, mlp: SplitMlp, reads_h: bool, arithmetic: Arithmetic[R]) -> None:
        first, second = hidden_layers(mlp, reads_h)
        *self._state_parts, action = mlp.first.parts
        self._first, self._second = arithmetic.hidden(first), arithmetic.hidden(second)
        self._start = arithmetic.hidden(first._replace(wide=None, narrow=weight_of(action)))

    def shared(self, *state: Tensor) -> Tensor:
        """The first layer's sums that do not depend on the action."""
        parts = [part(x) for part, x in zip(self._state_parts, state, strict=True)]
        total: Tensor = torch.stack(parts).sum(0)
        return total

    def start(self, add: Tensor, action: Tensor) -> Tensor:
        """(..., outputs) at k = 0."""
        return self._second.last(self._start.between(None, action, add), None, None)

    def later(self, wide_h: R | None, narrow: Tensor) -> Tensor:
        """(..., outputs) at k > 0."""
        return self._second.last(self._first.between(wide_h, narrow, None), None, None)


class _Head[R]:
    """One head of Q."""

    def __init__(self, head: QHead, arithmetic: Arithmetic[R]) -> None:
        self._reduce = head.state.reduce
        if self._reduce is not None:
            self._reduced = arithmetic.linear(*map(weight_of, self._reduce.parts))
        self._state = _QNetwork(head.state.mlp, self._reduce is None, arithmetic)
        self._passing = None if head.passing is None else _QNetwork(head.passing, False, arithmetic)

    def shared(self, carry: Carry, told: Tensor | None) -> list[Tensor]:
        """The sums of its networks' first layers."""
        state = carry if self._reduce is None else (self._reduce(*carry),)
        sums = [self._state.shared(*state)]
        if self._passing is not None and told is not None:
            sums.append(self._passing.shared(told))
        return sums

    def start(self, add: list[Tensor], action: Tensor) -> Tensor:
        """(..., width) at k = 0; takes its sums from the front of ``add``."""
        q = self._state.start(add.pop(0), action)
        return q if self._passing is None else q + self._passing.start(add.pop(0), action)

    def later(self, wide_h: R, h: Tensor, z: Tensor, told: Tensor | None, action: Tensor) -> Tensor:
        """(..., width) at k > 0."""
        if self._reduce is None:
            q = self._state.later(wide_h, torch.cat([z, action], -1))
        else:
            q = self._state.later(None, torch.cat([self._reduced(h, z), action], -1))
        if self._passing is None or told is None:
            return q
        return q + self._passing.later(None, torch.cat([told, action], -1))


class PlanningNetwork[R]:
    """Packed from a world model's weights as they are now."""

    def __init__(self, model: WorldModel, config: PlannerConfig, arithmetic: Arithmetic[R]) -> None:
        self._model, self._config = model, config
        z, action = map(weight_of, model.mix.parts)
        norm = model.mix_act[0]
        both = torch.cat([z, action], 1)
        assert isinstance(norm, nn.LayerNorm)
        mix = HiddenLayer(None, False, both, norm, None)
        self._mix = arithmetic.hidden(mix)
        start = mix._replace(narrow=action)
        self._mix_start = arithmetic.hidden(start)
        self._recur = arithmetic.recurrence(gru_layer(model.gru))
        drawn = config.latent == "sample"
        wanted = None if drawn else model.config.latent
        self._prior = arithmetic.hidden(hidden_layers(model.prior, True, wanted)[0])
        self._termination = arithmetic.hidden(hidden_layers(model.termination_head, True)[0])
        self._heads = [_Head(head, arithmetic) for head in model.q_heads]
        told = model.passing_value_head is not None
        passing = hidden_layers(model.decode_passing, True)[0] if told else None
        self._passing = None if passing is None else arithmetic.hidden(passing)

    def root(self, carry: Carry) -> Root:
        """From the robots' states (E, ...)."""
        model = self._model
        carry = model.spread(carry)
        told = None if self._passing is None else model.passing(carry)
        return Root(
            carry.h,
            model.mix.parts[0](carry.z),
            model.gru.project.parts[1](carry.h),
            tuple(sums for head in self._heads for sums in head.shared(carry, told)),
        )

    def noise(self, horizon: int, generator: torch.Generator | None) -> list[Tensor]:
        """Of the imagined states under ``latent=sample``, (latent,) each; else nothing."""
        if self._config.latent == "mean":
            return []
        size, device = (self._model.config.latent,), self._model.state_mean.device
        return [torch.randn(size, generator=generator, device=device) for _ in range(horizon - 1)]

    def worth(self, root: Root, actions: Tensor, noise: list[Tensor]) -> Tensor:
        """J (...) of plans (..., N, 7)."""
        each = actions.unbind(-2)
        tally = Tally(self._config, self._model.return_floor)
        sums = list(root.values)
        tally.value(self._read([head.start(sums, each[0]) for head in self._heads]))
        x = self._mix_start.between(None, each[0], root.mix)
        wide_h: R | None = None
        h, add = root.h, root.recurrence
        for k in range(1, len(each)):
            h, wide_h = self._recur(x, wide_h, add if k == 1 else None, h)
            z = self._next_z(wide_h, noise[k - 1] if noise else None)
            told = self._told(wide_h, z)
            q = [head.later(wide_h, h, z, told, each[k]) for head in self._heads]
            tally.value(self._read(q))
            if k == len(each) - 1:
                break  # nothing follows the last step
            tally.risk(torch.sigmoid(self._termination.last(wide_h, z, None)[..., 0]))
            x = self._mix.between(None, torch.cat([z, each[k]], -1), None)
        return tally.mean(len(each))

    def _next_z(self, wide_h: R, noise: Tensor | None) -> Tensor:
        out = self._prior.last(wide_h, None, None)
        if noise is None:
            return out
        mean, raw = out.chunk(2, -1)
        std = F.softplus(raw + 0.54) + self._model.config.min_std
        return mean + std * noise

    def _told(self, wide_h: R, z: Tensor) -> Tensor | None:
        """`WorldModel.passing`."""
        if self._passing is None:
            return None
        out = self._passing.last(wide_h, z, None)
        coming = torch.sigmoid(out[..., 3:])
        return torch.cat([coming, coming * out[..., :3]], -1)

    def _read(self, outputs: list[Tensor]) -> Tensor:
        """Q in units of return of what its heads say."""
        model = self._model
        each = [value.read(q, model.config.value_loss) for q in outputs]
        if len(each) == 1:
            q = each[0]
        elif self._config.ensemble == "mean":
            q = torch.stack(each).mean(0)
        else:
            q = torch.stack(each).amin(0)
        return torch.addcmul(model.return_mean, q, model.return_std)
