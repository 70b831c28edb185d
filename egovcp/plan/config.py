"""What can be chosen about a planner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from egovcp import spec
from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError
from egovcp.plan.choices import Latent

Objective = Literal["value", "reward", "td"]
Process = Literal["walk", "ramp"]
TerminationRule = Literal["paper", "shift", "survival"]
OptimiserName = Literal["cem", "icem", "mppi", "shooting"]
BackendName = Literal["auto", "eager", "float32", "int8"]


@dataclass(frozen=True)
class PlannerConfig:
    """The sampling MPC; the defaults are the paper's, 25 Hz."""

    samples: int = bounded(1024, least=1, most=2**20)
    """M, candidate plans per iteration."""
    horizon: int = bounded(4, least=1, most=1000)
    """N, planner ticks."""
    objective: Objective = "value"
    """J of a candidate. value: the mean of Q over its N ticks, the paper's; reward: the sum of the
    N predicted rewards, discounted (Rew-MPC); td: the same and gamma^N Q after them, of one more
    action (TD-MPC). The last two need a model trained with loss.reward."""
    iterations: int = bounded(3, least=1, most=10_000)
    """Rounds of the search; fewer where a deadline comes first."""
    elites: int = bounded(64, least=1, most=2**20)
    """Best candidates that the next round is fitted to."""
    min_std: float = bounded(0.1, least=0, most=10)
    """Floor of the sampling deviation, in units of delta."""
    eta: float = bounded(spec.ACTION_ETA, least=1e-4, most=2)
    """Step of the action process, box units per tick."""
    hands_cost: float = bounded(0.0, least=0, most=1e6)
    """What hands away from the neutral pose cost a candidate, in units of return: times their mean
    squared action. Q knows the price of a pose, but not as exactly as it would have to."""
    step_cost: float = bounded(0.0, least=0, most=1e6)
    """What moving costs a candidate, in units of return: times its mean squared step, of which 1 is
    the largest. Where Q has nothing to say, whoever pays for steps stays where it is."""
    process: Process = "walk"
    """What candidates are made of. walk: a step of its own in every tick, as the paper's data;
    ramp: the steps drawn add up to one place, to which it goes by eta a tick and where it rests, as
    data of a longer `egovcp-collect --step_ticks`. Its first action is found with fewer
    candidates."""
    termination_threshold: float = bounded(0.9, least=0, most=1)
    """A candidate whose termination probability exceeds this loses its later values."""
    termination_rule: TerminationRule = "shift"
    """paper: later values are 0; shift: they are the data's worst return; survival: each
    value above the worst return is weighted with the probability of being alive. Rewards likewise,
    in the place of the worst return those that add up to it."""
    latent: Latent = "mean"
    """z of imagined states. mean: the prior's; sample: drawn from the prior, anew in each
    iteration, with the same noise for all candidates."""
    optimiser: OptimiserName = "cem"
    """How candidates are drawn: cem (fitted to the elites), icem (with coloured noise, elites kept
    and fewer samples each round), mppi (all weighted by their value), shooting (uniform)."""
    temperature: float = bounded(0.3, least=1e-6, most=1e6)
    """mppi: a value this many deviations of all values below the best weighs 1/e of it."""
    noise_exponent: float = bounded(2.0, least=0, most=10)
    """icem: power of the noise over frequency, f^-x; 0: white, larger: steadier plans."""
    kept_elites: float = bounded(0.3, least=0, most=1)
    """icem: share of the elites that are candidates again in the next round."""
    sample_decay: float = bounded(1.25, least=1, most=1000)
    """icem: each round draws this many times fewer samples than the one before."""
    backend: BackendName = "auto"
    """Implementation of the planner's networks. eager: the world model itself; float32: its layers
    packed for planning; int8: 8-bit integers, in a C library compiled on first use (CPU only);
    auto: int8 on CPUs with AVX2 or AVX-512 VNNI, else float32."""

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.elites > self.samples:
            raise UsageError(f"elites ({self.elites}) exceed samples ({self.samples})")

    @property
    def actions(self) -> int:
        """Actions of a candidate: N, and under ``objective=td`` that which Q is asked about."""
        return self.horizon + (self.objective == "td")
