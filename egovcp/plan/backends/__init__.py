"""Implementations of the plan evaluation behind one switch; `objective` is the reference."""

from __future__ import annotations

from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel
from egovcp.plan.backends import library
from egovcp.plan.backends.evaluators import FloatEvaluator, Int8Evaluator
from egovcp.plan.choices import require_answers
from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import PlanEvaluator, ReferenceEvaluator

__all__ = ["make_evaluator"]


def make_evaluator(model: WorldModel, config: PlannerConfig) -> PlanEvaluator[Carry]:
    """The evaluator that ``config.backend`` names, made from the model's weights as they are now.

    If ``auto`` cannot use int8 on a processor that is fast at it, a line on stderr says why.
    A subclass of the world model may override its methods: under ``auto`` it is evaluated step by
    step.

    Raises:
        UsageError: the model does not know what the planner asks; int8 is asked for and the model
            is not on the processor, or has odd sizes.
        EnvironmentFailure: int8 is asked for and the kernel cannot be built.
    """
    require_answers(model.config, config)
    backend = config.backend
    if backend == "eager" or (backend == "auto" and type(model) is not WorldModel):
        return ReferenceEvaluator(model, config)
    if backend == "int8":
        return _integers(model, config)
    if backend == "auto" and model.state_mean.device.type == "cpu" and library.processor_is_fast():
        try:
            if library.library_if_possible() is not None:
                return _integers(model, config)
        except UsageError as error:
            library.warn_float32(str(error))
    return FloatEvaluator(model, config)


def _integers(model: WorldModel, config: PlannerConfig) -> Int8Evaluator:
    device = model.state_mean.device
    if device.type != "cpu":
        raise UsageError(f"backend=int8 runs on the processor, the model is on {device}")
    return Int8Evaluator(model, config)
