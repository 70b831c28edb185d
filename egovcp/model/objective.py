"""The training objective: equation 6, the sum of its terms, and its gradient.

What filtered states are asked for and what is foreseen from them share nothing but these states,
and take about as long. So the gradient is found in three pieces: of either with respect to the
states and the weights it uses, the two side by side where the processor has threads for both; and
of the filter, back from the sum of the two.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from egovcp.model import losses
from egovcp.model.latent_state import Carry, Gaussian
from egovcp.model.losses import Batch, Rollout
from egovcp.model.multistep import (
    autoregressive_losses,
    autoregressive_ticks,
    first_row,
    multistep_losses,
)
from egovcp.model.networks import SplitMlp
from egovcp.model.parallel import SINGLE_PROCESS, current_rank, run_parallel
from egovcp.model.value_losses import value_and_termination_losses
from egovcp.model.world_model import WorldModel

type Terms = dict[str, Tensor]
type Part = Callable[[], Terms]


class StepNoise(NamedTuple):
    """What a step leaves to chance."""

    noise: Tensor  # (T, B, Z) with which z is sampled
    image: int  # the first that is decoded
    multistep: int  # the first row from which is imagined
    autoregressive: int  # the same of autoregressive training; 0 without it


def sample_step_noise(
    model: WorldModel, batch: Batch, generator: torch.Generator | None = None
) -> StepNoise:
    """For a batch of this shape; ``generator``: None is torch's own."""
    config = model.config.loss
    noise = losses.latent_noise(model, batch, generator)
    multistep = first_row(config, config.multistep_horizons, batch, generator)
    image = losses.first_image(config.decode_every, batch, generator)
    if model.config.dynamics == "joint":
        return StepNoise(noise, image, multistep, 0)
    return StepNoise(
        noise, image, multistep, first_row(config, autoregressive_ticks(config), batch, generator)
    )


def world_model_loss(
    model: WorldModel,
    batch: Batch,
    chance: StepNoise | torch.Generator | None = None,
    head: SplitMlp | None = None,
) -> tuple[Tensor, Terms]:
    """Total loss of equation 6 and its terms (scalars, detached).

    Args:
        model: the world model.
        batch: windows.
        chance: what is drawn, or what draws it; None: torch's own generator.
        head: of Q, for its TD target (`egovcp.model.value_losses`); None: the model's own.
    """
    draws = chance if isinstance(chance, StepNoise) else sample_step_noise(model, batch, chance)
    rollout = losses.filter_sequence(model, batch, noise=draws.noise)
    told, foreseen = _parts(model, rollout, batch, draws, head)
    terms = told() | foreseen()
    return _sum(terms), _named(terms)


def world_model_gradients(
    model: WorldModel,
    batch: Batch,
    draws: StepNoise,
    head: SplitMlp | None = None,
    precision: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> tuple[Tensor, Terms]:
    """`world_model_loss`, detached, and its gradient in the ``grad`` of the model's parameters, in
    the place of what was there. On a GPU nothing in it waits for what is computed there.

    Args:
        model: the world model.
        batch: windows.
        draws: what is left to chance.
        head: as there.
        precision: a context in which the losses, not their gradients, are computed.
    """
    parameters = [p for p in model.parameters() if p.requires_grad]
    with precision():  # all of it: who leaves the last one takes casts of weights from the others
        rollout = losses.filter_sequence(model, batch, noise=draws.noise)
        cut, outer, states = _cut(rollout)

        def with_gradient(part: Part) -> tuple[Terms, list[Tensor | None]]:
            with precision():
                terms = part()
                total = _sum(terms)
            inputs = [*states, *parameters]
            if not terms:
                return terms, [None] * len(inputs)
            with torch.autocast(batch.state.device.type, enabled=False):
                return terms, list(torch.autograd.grad(total, inputs, allow_unused=True))

        told, foreseen = _parts(model, cut, batch, draws, head)
        first, second = partial(with_gradient, told), partial(with_gradient, foreseen)
        # Processes that share a batch meet at every mean, and so in one order.
        if batch.state.device.type == "cpu" and current_rank() is SINGLE_PROCESS:
            (terms, gradients), (more, others) = run_parallel(first, second)
        else:
            (terms, gradients), (more, others) = first(), second()
    for parameter in parameters:
        parameter.grad = None
    ends = [*outer, *parameters]
    known = [(x, g) for x, g in zip(2 * ends, gradients + others, strict=True) if g is not None]
    torch.autograd.backward([x for x, _ in known], [g for _, g in known])  # adds up each end's
    terms |= more
    return _sum(terms).detach(), _named(terms)


def _parts(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    draws: StepNoise,
    head: SplitMlp | None,
) -> tuple[Part, Part]:
    """What filtered states are asked for, and what is foreseen from them."""
    config = model.config.loss
    weight = losses.pixel_weights(rollout.near, batch, model)

    def told() -> Terms:
        every = config.decode_every
        depth = losses.depth_loss(model, rollout, batch.valid, weight, every, draws.image)
        terms = {
            "depth": config.depth * depth,
            "state": config.state * losses.state_loss(model, rollout, batch),
        }
        if model.config.dynamics == "joint":
            terms |= losses.kl_losses(rollout, batch.valid, config)
        else:
            terms |= autoregressive_losses(model, rollout, batch, weight, draws.autoregressive)
        return terms | value_and_termination_losses(model, rollout, batch, config, head)

    def foreseen() -> Terms:
        return multistep_losses(model, rollout, batch, weight, draws.multistep)

    return told, foreseen


def _cut(rollout: Rollout) -> tuple[Rollout, list[Tensor], list[Tensor]]:
    """A rollout whose gradient ends there; what its gradient goes on from, and where it ends."""
    outer: list[Tensor] = []
    inner: list[Tensor] = []

    def ending(x: Tensor) -> Tensor:
        if not x.requires_grad:
            return x
        outer.append(x)
        inner.append(x.detach().requires_grad_())
        return inner[-1]

    cut = rollout._replace(
        carry=Carry.map(rollout.carry, ending),
        posterior=Gaussian(*map(ending, rollout.posterior)),
        prior=Gaussian(*map(ending, rollout.prior)),
    )
    return cut, outer, inner


def _sum(terms: Terms) -> Tensor:
    return torch.stack(list(terms.values())).sum() if terms else torch.zeros(())


def _named(terms: Terms) -> Terms:
    return {f"loss/{name}": term.detach() for name, term in terms.items()}
