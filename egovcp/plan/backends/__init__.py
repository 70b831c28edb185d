"""Backends of the plan evaluation, with packed networks; `objective` has the reference."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from egovcp.cuda_graphs import GraphedFunction
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel
from egovcp.plan.backends import library
from egovcp.plan.backends.float_network import PlanningNetwork, SharedPrefix, shared_prefix
from egovcp.plan.backends.integer_network import IntegerNetwork
from egovcp.plan.config import PlannerConfig, require_compatible
from egovcp.plan.objective import PlanEvaluator, PlanValue, ReferenceEvaluator

__all__ = ["FloatEvaluator", "Int8Evaluator", "make_evaluator"]


def make_evaluator(model: WorldModel, config: PlannerConfig) -> PlanEvaluator[Carry]:
    """The evaluator that ``config.backend`` names, made from the model's weights as they are now.

    If ``auto`` cannot use int8 on a CPU that is fast at it, a warning on stderr gives the reason.
    Under ``auto``, subclasses of the world model, which may override its methods, are evaluated by
    the reference.

    Raises:
        UsageError: the model lacks a head that the planner needs; or with int8, it is not on the
            CPU, or has sizes that the kernel does not support.
        EnvironmentFailure: with int8, the kernel cannot be built.
    """
    require_compatible(model.config, config)
    backend = config.backend
    if backend == "eager" or (backend == "auto" and type(model) is not WorldModel):
        return ReferenceEvaluator(model, config)
    if backend == "int8":
        return Int8Evaluator(model, config)
    if backend == "auto" and model.state_mean.device.type == "cpu" and library.processor_is_fast():
        try:
            if library.load_kernel_if_possible() is not None:
                return Int8Evaluator(model, config)
        except UsageError as error:
            library.warn_float32(str(error))
    return FloatEvaluator(model, config)


class FloatEvaluator:
    """Evaluates all candidates of all robots at once, on any device; on a GPU by CUDA graphs.

    Later changes of the model's weights are not seen.
    """

    backend = "float32"

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        self._model, self._config = model, config
        self._prefix: Callable[[Carry], SharedPrefix] = partial(shared_prefix, model)
        self._plan_value: Callable[[SharedPrefix, Tensor, Tensor | None], Tensor]
        self._plan_value = PlanningNetwork(model, config).plan_value
        if model.state_mean.device.type == "cuda":
            self._prefix = GraphedFunction(self._prefix)
            self._plan_value = GraphedFunction(self._plan_value)

    @torch.no_grad()
    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`."""
        prefix = self._prefix(carry)

        @torch.no_grad()
        def plan_value(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            noise = _noise(self._model, self._config, actions.shape[-2], generator)
            return self._plan_value(prefix, actions, noise)

        return plan_value


class Int8Evaluator:
    """Evaluates one robot after the other in 8-bit integers, with as many threads as torch uses.

    Later changes of the model's weights are not seen.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
        UsageError: the model is not on the CPU, or has sizes that the kernel does not take.
    """

    backend = "int8"

    def __init__(self, model: WorldModel, config: PlannerConfig) -> None:
        device = model.state_mean.device
        if device.type != "cpu":
            raise UsageError(f"backend=int8 runs on the CPU, the model is on {device}")
        self._model, self._config = model, config
        self._network = IntegerNetwork(model, config)

    @torch.no_grad()
    def at(self, carry: Carry) -> PlanValue:
        """See `PlanEvaluator`."""
        self._network.wake()
        # separately, so that a robot's values do not depend on the other robots
        states = (carry.row(e) for e in range(len(carry.h)))
        robots = [self._network.shared_prefix(state) for state in states]

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
