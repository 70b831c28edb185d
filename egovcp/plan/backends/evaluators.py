"""Evaluators of plans that compute with packed networks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from egovcp.cuda_graphs import Recorded
from egovcp.model import Carry, WorldModel
from egovcp.plan.backends.integers import IntegerNetwork
from egovcp.plan.backends.network import PlanningNetwork
from egovcp.plan.backends.shared_prefix import SharedPrefix, shared_prefix
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import PlanValue


class FloatEvaluator:
    """All candidates of all robots at once, on any device; on a GPU by CUDA graphs.

    Args:
        model: is packed as it is now.
        config: of the planner.
    """

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._model, self._config = model, config
        self._root: Callable[[Carry], SharedPrefix] = partial(shared_prefix, model)
        self._plan_value: Callable[[SharedPrefix, Tensor, Tensor | None], Tensor]
        self._plan_value = PlanningNetwork(model, config).plan_value
        if model.state_mean.device.type == "cuda":
            self._root, self._plan_value = Recorded(self._root), Recorded(self._plan_value)

    @property
    def shapes(self) -> int:
        """Of how many shapes there are CUDA graphs."""
        return sum(f.shapes for f in (self._root, self._plan_value) if isinstance(f, Recorded))

    @torch.no_grad()
    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`."""
        root = self._root(carry)

        @torch.no_grad()
        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            noise = _noise(self._model, self._config, actions.shape[-2], generator)
            return self._plan_value(root, actions, noise)

        return plan_value


class Int8Evaluator:
    """One robot after the other, its candidates shared by as many threads as torch uses.

    Args:
        model: is packed as it is now; on the processor.
        config: of the planner.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
        UsageError: the model has sizes that the kernel does not take.
    """

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._model, self._config = model, config
        self._network = IntegerNetwork(model, config)

    @torch.no_grad()
    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`."""
        self._network.soon()
        # One by one: the values of a robot's plans do not depend on the robots beside it.
        states = (carry.row(e) for e in range(len(carry.h)))
        robots = [self._network.shared(state) for state in states]

        @torch.no_grad()
        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            noise = _noise(self._model, self._config, actions.shape[-2], generator)
            each = zip(robots, actions, strict=True)
            return torch.stack(
                [self._network.plan_value(robot, plans, noise) for robot, plans in each]
            )

        return plan_value


def _noise(
    model: WorldModel, config: PlannerConfig, horizon: int, generator: torch.Generator | None
) -> Tensor | None:
    """Noise (horizon - 1, latent) of the imagined states under ``latent=sample``."""
    if config.latent == "mean":
        return None
    size, device = (model.config.latent,), model.state_mean.device
    drawn = [torch.randn(size, generator=generator, device=device) for _ in range(horizon - 1)]
    return torch.stack(drawn) if drawn else None
