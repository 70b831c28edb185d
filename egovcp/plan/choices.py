"""What the planner asks of a model under options that not every model can answer."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol, cast, runtime_checkable

import torch
from torch import Tensor

from egovcp.errors import UsageError
from egovcp.model import WorldModelConfig

if TYPE_CHECKING:
    from egovcp.plan.config import PlannerConfig

Latent = Literal["mean", "sample"]


@runtime_checkable
class StochasticModel(Protocol):
    """A model whose next state is uncertain."""

    def imagine_sample(
        self, carry: Any, action: Tensor, generator: torch.Generator | None = None
    ) -> Any:
        """Advance by one tick under action (E, M, 7); one noise for all of them."""
        ...


class RewardModel(Protocol):
    """A model that foresees rewards."""

    @property
    def discount(self) -> Tensor:
        """gamma of its returns, per tick."""
        ...

    def reward(self, carry: Any, action: Tensor) -> Tensor:
        """What action (E, M, 7) earns at once, (E, M)."""
        ...


def reward_model(model: object) -> RewardModel:
    """The model, which must foresee rewards.

    Raises:
        UsageError: it does not.
    """
    if not (hasattr(model, "reward") and hasattr(model, "discount")):
        raise UsageError(
            f"{type(model).__name__} has no reward and discount; plan with objective=value"
        )
    return cast("RewardModel", model)  # isinstance does not see the buffers of a torch module


def require_answers(model: WorldModelConfig, planner: PlannerConfig) -> None:
    """Raise `UsageError` where the planner asks what a world model like this never learned."""
    if planner.objective != "value" and model.loss.reward <= 0:
        raise UsageError(
            f"planner.objective={planner.objective} adds up predicted rewards, and this world "
            "model predicts none: train it with --policy.loss.reward=1, or plan with "
            "objective=value"
        )
    if planner.latent == "sample" and model.dynamics == "autoregressive":
        raise UsageError(
            "planner.latent=sample draws from the prior, and dynamics=autoregressive trains only "
            "its mean: plan with latent=mean"
        )


def step_of[L](
    model: object,
    imagine: Callable[[L, Tensor], L],
    latent: Latent,
    generator: torch.Generator | None,
) -> Callable[[L, Tensor], L]:
    """How a state is imagined: ``imagine``, or a draw.

    Raises:
        UsageError: the model cannot draw.
    """
    if latent == "mean":
        return imagine
    if not isinstance(model, StochasticModel):
        raise UsageError(
            f"latent=sample: {type(model).__name__} has no imagine_sample; plan with latent=mean"
        )
    return partial(model.imagine_sample, generator=generator)
