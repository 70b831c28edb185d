"""Optimisers of plans: cross-entropy method, iCEM, MPPI and random shooting."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from egovcp.plan.backends import library
from egovcp.plan.config import OptimiserName, PlannerConfig
from egovcp.plan.search import Optimiser, SearchState


def draw(mean: Tensor, std: Tensor, noise: Tensor) -> Tensor:
    """(E, M, P, 7) deltas around a mean, from noise (1, M, P, 7).

    The first candidate is the mean itself, the second is zero.
    """
    deltas = mean[:, None] + std[:, None] * noise
    deltas[:, 0] = mean
    if deltas.shape[1] > 1:
        deltas[:, 1] = 0.0
    return deltas.clamp_(-1.0, 1.0)


def white(mean: Tensor, samples: int, generator: torch.Generator) -> Tensor:
    """Noise (1, M, P, 7) that all robots share."""
    return torch.randn((1, samples, *mean.shape[1:]), generator=generator, device=mean.device)


def best_of(deltas: Tensor, values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The ``count`` best of (E, M, P, 7) by their values (E, M), best first."""
    top, index = values.topk(count, dim=1)
    rows = deltas.flatten(2)
    best = rows.gather(1, index[:, :, None].expand(-1, -1, rows.shape[2]))
    return best.view(*index.shape, *deltas.shape[2:]), top


@dataclass(frozen=True)
class CrossEntropy:
    """Cross-entropy method: mean and deviation are fitted to the elites; returns their mean."""

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        noise = white(state.mean, self.config.samples, generator)
        return draw(state.mean, state.std, noise)

    def update(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        elites, top = best_of(deltas, values, self.config.elites)
        usable = top.isfinite()
        mean, std = refit(elites, usable, state)
        value = mean_value(top, usable)
        return SearchState(mean, std.clamp_min(self.config.min_std), elites, top, value)


def refit(elites: Tensor, usable: Tensor, state: SearchState) -> tuple[Tensor, Tensor]:
    """Mean and deviation (E, P, 7) of the usable elites (E, elites, P, 7); without any, the old."""
    weight = usable[:, :, None, None].to(elites.dtype)
    count = weight.sum(1)
    fitted = (elites * weight).sum(1) / count.clamp_min(1.0)
    squares = (elites - fitted[:, None]).square() * weight
    spread = (squares.sum(1) / count.clamp_min(1.0)).sqrt()
    mean = torch.where(count > 0, fitted, state.mean)
    return mean, torch.where(count > 0, spread, state.std)


def mean_value(top: Tensor, usable: Tensor) -> Tensor:
    """Mean (E,) of the usable ones of (E, elites); -inf without any."""
    value = top.masked_fill(~usable, 0.0).sum(1) / usable.sum(1).clamp_min(1)
    return value.masked_fill(~usable.any(1), -torch.inf)


class KernelCrossEntropy:
    """`CrossEntropy` by the C kernel, for float32 tensors on the CPU; equal but for rounding.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
    """

    def __init__(self, config: PlannerConfig) -> None:
        self.config = config
        self._kernel = library.load_kernel()

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        mean, std = state.mean.contiguous(), state.std.contiguous()
        robots, horizon, actions = mean.shape
        noise = white(mean, self.config.samples, generator)
        deltas = torch.empty(robots, self.config.samples, horizon, actions)
        parts = (mean, std, noise, deltas)
        sizes = (robots, self.config.samples, horizon * actions)
        self._kernel.draw(*sizes, *(x.data_ptr() for x in parts))
        return deltas

    def random_walk(self, start: Tensor, deltas: Tensor, eta: float) -> Tensor:
        start, deltas = start.contiguous(), deltas.contiguous()
        actions = torch.empty_like(deltas)
        parts = (start, deltas, actions)
        self._kernel.walk(*deltas.shape, eta, *(x.data_ptr() for x in parts))
        return actions

    def update(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        count, (robots, samples, horizon, actions) = self.config.elites, deltas.shape
        deltas, values = deltas.contiguous(), values.contiguous()
        elites = torch.empty(robots, count, horizon, actions)
        top, value = torch.empty(robots, count), torch.empty(robots)
        mean, std = state.mean.clone(), state.std.clamp_min(self.config.min_std)
        parts = (deltas, values, elites, top, value, mean, std)
        sizes = (robots, samples, horizon * actions, count)
        self._kernel.update(*sizes, self.config.min_std, *(x.data_ptr() for x in parts))
        return SearchState(mean, std, elites, top, value)


@dataclass(frozen=True)
class ImprovedCrossEntropy:
    """iCEM (Pinneri et al., CoRL 2020): the cross-entropy method for few samples.

    Noise is coloured along the plan, some elites are candidates again, later iterations have fewer
    samples, and the result is the best plan so far: ``mean`` of the state. Samples are drawn around
    the mean of the elites.
    """

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        c = self.config
        samples = max(round(c.samples * c.sample_decay**-iteration), c.elites)
        noise = coloured(state.mean, samples, c.noise_exponent, generator)
        if iteration == 0:
            return draw(state.mean, state.std, noise)
        usable = state.values.isfinite()
        centre, _ = refit(state.elites, usable, state)
        kept = max(1, round(c.kept_elites * c.elites))
        return torch.cat([state.elites[:, :kept], draw(centre, state.std, noise)], 1)

    def update(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        elites, top = best_of(deltas, values, self.config.elites)
        _, std = refit(elites, top.isfinite(), state)
        return keep_best(state._replace(std=std.clamp_min(self.config.min_std)), elites, top)


def keep_best(state: SearchState, elites: Tensor, top: Tensor) -> SearchState:
    """The state with these elites; its result is the first of them if that is the best so far."""
    better = top[:, 0] > state.value
    mean = torch.where(better[:, None, None], elites[:, 0], state.mean)
    value = torch.where(better, top[:, 0], state.value)
    return state._replace(mean=mean, elites=elites, values=top, value=value)


def coloured(mean: Tensor, samples: int, exponent: float, generator: torch.Generator) -> Tensor:
    """Noise (1, M, P, 7) of unit variance whose power falls as f^-exponent along the plan."""
    horizon, actions = mean.shape[1:]
    length = max(2 * horizon, 2)  # twice as long, so that the noise is not periodic
    power = torch.fft.rfftfreq(length, device=mean.device).clamp_min(1.0 / length) ** -exponent
    size = (1, samples, actions, len(power), 2)
    parts = torch.randn(size, generator=generator, device=mean.device)
    spectrum = torch.view_as_complex(parts) * power.sqrt()
    noise = torch.fft.irfft(spectrum, length)[..., :horizon]
    # variance of the inverse transform: middle frequencies count twice, each part with 1/2
    share = torch.full_like(power, 4.0)
    share[0] = share[-1] = 1.0
    deviation = (share * power).sum().sqrt() / length
    unit: Tensor = (noise / deviation).transpose(2, 3)
    return unit


@dataclass(frozen=True)
class PathIntegral(CrossEntropy):
    """MPPI (Williams et al., 2017): weights candidates by the exponential of their values.

    The temperature is in standard deviations of the values.
    """

    def update(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        elites, top = best_of(deltas, values, self.config.elites)
        usable = values.isfinite()
        weight = weights(values, self.config.temperature)  # (E, M)
        any_usable = usable.any(1)
        mean = (weight[:, :, None, None] * deltas).sum(1)
        mean = torch.where(any_usable[:, None, None], mean, state.mean)
        value = (weight * values.masked_fill(~usable, 0.0)).sum(1)
        value = value.masked_fill(~any_usable, -torch.inf)
        _, std = refit(elites, top.isfinite(), state)
        return SearchState(mean, std.clamp_min(self.config.min_std), elites, top, value)


def weights(values: Tensor, temperature: float) -> Tensor:
    """(E, M) values -> weights that add up to 1; 0 where a value is -inf."""
    usable = values.isfinite()
    known = values.masked_fill(~usable, 0.0)
    count = usable.sum(1, keepdim=True).clamp_min(1)
    mean = known.sum(1, keepdim=True) / count
    spread = ((known - mean).square() * usable).sum(1, keepdim=True).div(count).sqrt()
    best = values.amax(1, keepdim=True)
    below = torch.where(
        usable, (known - best) / (temperature * spread).clamp_min(1e-12), -torch.inf
    )
    weight = below.exp()
    return weight / weight.sum(1, keepdim=True).clamp_min(1e-12)


@dataclass(frozen=True)
class Shooting:
    """Random shooting: uniform deltas, as in the data; the result is the best plan so far."""

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        mean = state.mean
        size = (1, self.config.samples, *mean.shape[1:])
        uniform = 2 * torch.rand(size, generator=generator, device=mean.device) - 1
        deltas = uniform.repeat(mean.shape[0], 1, 1, 1)
        deltas[:, 0] = mean
        if self.config.samples > 1:
            deltas[:, 1] = 0.0
        return deltas.clamp_(-1.0, 1.0)

    def update(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        return keep_best(state, *best_of(deltas, values, self.config.elites))


OPTIMISERS: Final[Mapping[OptimiserName, Callable[[PlannerConfig], Optimiser]]] = {
    "cem": CrossEntropy,
    "icem": ImprovedCrossEntropy,
    "mppi": PathIntegral,
    "shooting": Shooting,
}


def optimiser_of(config: PlannerConfig, device: torch.device | str = "cpu") -> Optimiser:
    """The optimiser that ``config.optimiser`` names.

    On a CPU, if the backend may be int8, cem is computed by the kernel.
    """
    wants_kernel = config.optimiser == "cem" and config.backend in ("auto", "int8")
    if wants_kernel and torch.device(device).type == "cpu" and _kernel_is_available():
        return KernelCrossEntropy(config)
    return OPTIMISERS[config.optimiser](config)


def _kernel_is_available() -> bool:
    return library.processor_is_fast() and library.load_kernel_if_possible() is not None
