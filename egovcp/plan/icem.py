"""iCEM (Pinneri et al., CoRL 2020): the cross-entropy method for few samples.

Noise is coloured along the plan, for steps that cancel each other explore little; some elites are
candidates again; later rounds, which know more, draw fewer samples; the answer is the best plan
seen, not a mean that nobody judged.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from egovcp.plan.cem import refit
from egovcp.plan.config import PlannerConfig
from egovcp.plan.search import SearchState, best_of, draw


@dataclass(frozen=True)
class ImprovedCrossEntropy:
    """``mean`` of the state is the best plan so far; draws are made around the elites' mean."""

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """See `Optimiser`. From iteration 1 on, the best elites so far come first."""
        c = self.config
        samples = max(round(c.samples * c.sample_decay**-iteration), c.elites)
        noise = coloured(state.mean, samples, c.noise_exponent, generator)
        if iteration == 0:
            return draw(state.mean, state.std, noise)
        usable = state.values.isfinite()
        centre, _ = refit(state.elites, usable, state)
        kept = max(1, round(c.kept_elites * c.elites))
        return torch.cat([state.elites[:, :kept], draw(centre, state.std, noise)], 1)

    def learn(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """See `Optimiser`."""
        elites, top = best_of(deltas, values, self.config.elites)
        _, std = refit(elites, top.isfinite(), state)
        return keep_best(state._replace(std=std.clamp_min(self.config.min_std)), elites, top)


def keep_best(state: SearchState, elites: Tensor, top: Tensor) -> SearchState:
    """The state with these elites, whose first is the answer if it beats the one before."""
    better = top[:, 0] > state.value
    mean = torch.where(better[:, None, None], elites[:, 0], state.mean)
    value = torch.where(better, top[:, 0], state.value)
    return state._replace(mean=mean, elites=elites, values=top, value=value)


def coloured(mean: Tensor, samples: int, exponent: float, generator: torch.Generator) -> Tensor:
    """Noise (1, M, N, 7) of unit variance whose power falls as f^-exponent along the plan."""
    horizon, actions = mean.shape[1:]
    length = max(2 * horizon, 2)  # twice as long: a plan does not return to where it began
    power = torch.fft.rfftfreq(length, device=mean.device).clamp_min(1.0 / length) ** -exponent
    size = (1, samples, actions, len(power), 2)
    parts = torch.randn(size, generator=generator, device=mean.device)
    spectrum = torch.view_as_complex(parts) * power.sqrt()
    noise = torch.fft.irfft(spectrum, length)[..., :horizon]
    # The variance of the inverse transform: middle frequencies count twice, half of each part.
    share = torch.full_like(power, 4.0)
    share[0] = share[-1] = 1.0
    deviation = (share * power).sum().sqrt() / length
    unit: Tensor = (noise / deviation).transpose(2, 3)
    return unit
