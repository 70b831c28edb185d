"""What the planner asks of a model under options that not every model can answer."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from egovcp.errors import UsageError

Latent = Literal["mean", "sample"]
Ensemble = Literal["mean", "min"]


@runtime_checkable
class Draws(Protocol):
    """A model whose next state is uncertain."""

    def imagine_sample(
        self, carry: Any, action: Tensor, generator: torch.Generator | None = None
    ) -> Any:
        """Advance by one tick under action (E, M, 7); one noise for all of them."""
        ...


@runtime_checkable
class Doubts(Protocol):
    """A model that judges more than once."""

    def lowest_value(self, carry: Any, action: Tensor) -> Tensor:
        """The least that it thinks of action (E, M, 7), (E, M)."""
        ...


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
    if not isinstance(model, Draws):
        raise UsageError(
            f"latent=sample: {type(model).__name__} has no imagine_sample; plan with latent=mean"
        )
    return partial(model.imagine_sample, generator=generator)


def judge_of[L](
    model: object, value: Callable[[L, Tensor], Tensor], ensemble: Ensemble
) -> Callable[[L, Tensor], Tensor]:
    """How an action is judged: ``value``, or the least of several.

    Raises:
        UsageError: the model has no other opinions.
    """
    if ensemble == "mean":
        return value
    if not isinstance(model, Doubts):
        raise UsageError(
            f"ensemble=min: {type(model).__name__} has no lowest_value; plan with ensemble=mean"
        )
    return model.lowest_value
