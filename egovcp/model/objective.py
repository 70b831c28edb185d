"""The training objective: equation 6, the sum of its terms, and its gradient.

The terms of filtered states and those of states imagined several steps ahead share nothing but the
filtered states, and cost about the same. So the gradient is computed in three parts: of either
group of terms with respect to the states and the weights, in parallel on a CPU with several
threads; then of the filter, from the sum of the two.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from egovcp.model import losses
from egovcp.model.latent_state import Carry, Gaussian
from egovcp.model.losses import Batch, Rollout
from egovcp.model.multistep import (
    autoregressive_horizons,
    autoregressive_losses,
    first_row,
    multistep_losses,
)
from egovcp.model.privileged_value import sample_actions
from egovcp.model.value_losses import value_and_termination_losses
from egovcp.model.world_model import WorldModel

type Terms = dict[str, Tensor]
type TermGroup = Callable[[], Terms]


class StepNoise(NamedTuple):
    """Random numbers of one training step."""

    latent: Tensor  # (T, B, Z), noise of z
    image: int  # index of the first image that is decoded
    multistep: int  # first row from which `multistep_losses` imagines
    autoregressive: int  # the same for `autoregressive_losses`; 0 if unused
    actions: Tensor  # (B, T, K, 7), for q_target=privileged; else K = 0


def sample_step_noise(
    model: WorldModel, batch: Batch, generator: torch.Generator | None = None
) -> StepNoise:
    """Sample for a batch of this shape; generator None: torch's default generator."""
    config = model.config.loss
    latent = losses.latent_noise(model, batch, generator)
    multistep = first_row(config, config.multistep_horizons, batch, generator)
    image = losses.first_image(config.decode_every, batch, generator)
    autoregressive = 0
    if model.config.dynamics == "autoregressive":
        autoregressive = first_row(config, autoregressive_horizons(config), batch, generator)
    count = config.sampled_actions if config.q_target == "privileged" else 0
    actions = sample_actions(batch.prev_action, count, generator)
    return StepNoise(latent, image, multistep, autoregressive, actions)


def world_model_loss(
    model: WorldModel,
    batch: Batch,
    noise: StepNoise | torch.Generator | None = None,
    critic: nn.Module | None = None,
) -> tuple[Tensor, Terms]:
    """Total loss of equation 6 and its terms (scalars, detached).

    Args:
        noise: random numbers, or the generator that samples them; None: torch's default generator.
        critic: the network that predicts the target of Q (`egovcp.model.value_losses`).
    """
    if not isinstance(noise, StepNoise):
        noise = sample_step_noise(model, batch, noise)
    rollout = losses.filter_sequence(model, batch, noise.latent)
    filtered, imagined = _term_groups(model, rollout, batch, noise, critic)
    terms = filtered() | imagined()
    return _sum(terms), _named(terms)


def world_model_gradients(
    model: WorldModel,
    batch: Batch,
    noise: StepNoise,
    critic: nn.Module | None = None,
    precision: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> tuple[Tensor, Terms, Carry]:
    """`world_model_loss` and the filtered states (B, T, ...), detached; the gradient replaces the
    ``grad`` of the model's parameters.

    Never synchronises with a GPU.

    Args:
        noise: random numbers of the step.
        critic: the network that predicts the target of Q (`egovcp.model.value_losses`).
        precision: context (autocast) of the losses, not of their gradients.
    """
    parameters = [p for p in model.parameters() if p.requires_grad]
    with precision():  # one outer context: leaving the last one clears autocast's weight cache
        rollout = losses.filter_sequence(model, batch, noise.latent)
        leaves, outer, states = _detach(rollout)

        def with_gradient(group: TermGroup) -> tuple[Terms, list[Tensor | None]]:
            with precision():
                terms = group()
                total = _sum(terms)
            inputs = [*states, *parameters]
            if not terms:
                return terms, [None] * len(inputs)
            with torch.autocast(batch.state.device.type, enabled=False):
                gradients = torch.autograd.grad(total, inputs, allow_unused=True)
                return terms, list(gradients)

        filtered, imagined = _term_groups(model, leaves, batch, noise, critic)
        first, second = partial(with_gradient, filtered), partial(with_gradient, imagined)
        if batch.state.device.type == "cpu":
            (terms, gradients), (more, others) = run_parallel(first, second)
        else:
            (terms, gradients), (more, others) = first(), second()
    for parameter in parameters:
        parameter.grad = None
    ends = [*outer, *parameters]
    known = [(x, g) for x, g in zip(2 * ends, gradients + others, strict=True) if g is not None]
    torch.autograd.backward([x for x, _ in known], [g for _, g in known])  # adds up each end's
    terms |= more
    return _sum(terms).detach(), _named(terms), rollout.carry.map(Tensor.detach)


def run_parallel[A, B](first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """Run two independent computations at once, each with half of torch's threads.

    Small operations gain little from a second thread; two independent computations keep two threads
    busy. With one torch thread they run one after the other.

    ``second`` runs in another thread and does not inherit contexts (autograd, autocast). If both
    fail, the error of ``first`` is raised.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return first(), second()

    def in_thread() -> B:
        torch.set_num_threads(threads // 2)
        return second()

    torch.set_num_threads(threads - threads // 2)
    task = _thread().submit(in_thread)
    try:
        result = first()
    finally:
        wait([task])
        torch.set_num_threads(threads)
    return result, task.result()


@cache
def _thread() -> ThreadPoolExecutor:
    # An outermost autocast context is kept open: leaving it would clear the cast cache of all
    # threads, so that some weights would be cast, and their gradients rounded, twice.
    return ThreadPoolExecutor(1, "run_parallel", torch.autocast_increment_nesting)


def _term_groups(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    noise: StepNoise,
    critic: nn.Module | None,
) -> tuple[TermGroup, TermGroup]:
    """The terms of filtered states, and those of states imagined several steps ahead."""
    config = model.config.loss
    weight = losses.pixel_weights(rollout.near, batch, model)

    def filtered() -> Terms:
        every = config.decode_every
        depth = losses.depth_loss(model, rollout, batch.valid, weight, every, noise.image)
        terms = {
            "depth": config.depth * depth,
            "state": config.state * losses.state_loss(model, rollout, batch),
        }
        if config.object > 0:
            terms["object"] = config.object * losses.object_loss(model, rollout, batch)
        if model.config.dynamics == "joint":
            terms |= losses.kl_losses(rollout, batch.valid, config)
        else:
            terms |= autoregressive_losses(model, rollout, batch, weight, noise.autoregressive)
        return terms | value_and_termination_losses(
            model, rollout, batch, config, critic, noise.actions
        )

    def imagined() -> Terms:
        return multistep_losses(model, rollout, batch, weight, noise.multistep)

    return filtered, imagined


def _detach(rollout: Rollout) -> tuple[Rollout, list[Tensor], list[Tensor]]:
    """A copy of the rollout made of leaf tensors; the original tensors; the leaves."""
    outer: list[Tensor] = []
    inner: list[Tensor] = []

    def leaf(x: Tensor) -> Tensor:
        if not x.requires_grad:
            return x
        outer.append(x)
        inner.append(x.detach().requires_grad_())
        return inner[-1]

    detached = rollout._replace(
        carry=rollout.carry.map(leaf),
        posterior=Gaussian(*map(leaf, rollout.posterior)),
        prior=Gaussian(*map(leaf, rollout.prior)),
    )
    return detached, outer, inner


def _sum(terms: Terms) -> Tensor:
    return torch.stack(list(terms.values())).sum() if terms else torch.zeros(())


def _named(terms: Terms) -> Terms:
    return {f"loss/{name}": term.detach() for name, term in terms.items()}
