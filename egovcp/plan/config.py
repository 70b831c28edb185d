"""Configuration of the planner, and the checks of what it needs of a world model and a machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from egovcp import spec
from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError
from egovcp.model import WorldModelConfig
from egovcp.model.value import width

Latent = Literal["mean", "sample"]
Objective = Literal["value", "reward", "td"]
ActionParameterization = Literal["random_walk", "target"]
TerminationRule = Literal["paper", "shift", "survival"]
OptimiserName = Literal["cem", "icem", "mppi", "shooting"]
BackendName = Literal["auto", "eager", "float32", "int8"]

MAX_SECONDS: Final = 10.0
"""Largest estimate of the time of a plan for one robot."""
MAX_BYTES: Final = 256 << 20
"""Largest estimate of the memory of a plan for one robot."""

_PRODUCTS_PER_S: Final = 4e10  # multiply-adds of one processor core, float32
_FLOATS_PER_S: Final = 2e9  # element-wise operations
_CALL_S: Final = 5e-4  # overhead of the operations of one step
_ACTION_COPIES: Final = 8  # noise, deltas, actions, and copies in the optimisers
_BYTES: Final = 4


@dataclass(frozen=True)
class PlannerConfig:
    """Sampling-based model predictive control; --preset=paper sets the paper's values."""

    samples: int = bounded(64, least=1, most=2**20)
    """M, candidates per iteration."""
    horizon: int = bounded(4, least=1, most=1000)
    """N, planning horizon, steps."""
    objective: Objective = "value"
    """V of a candidate. value: mean of Q over the horizon (equation 15); reward: discounted sum of
    predicted rewards (Rew-MPC); td: the same plus gamma^N Q at the end (TD-MPC). The last two need
    a model trained with loss.reward."""
    iterations: int = bounded(3, least=1, most=10_000)
    """Iterations of the search; fewer if a deadline comes first."""
    elites: int = bounded(4, least=1, most=2**20)
    """Best candidates that the next iteration is fitted to."""
    min_std: float = bounded(0.1, least=0, most=10)
    """Smallest sampling standard deviation, in units of eta."""
    eta: float = bounded(spec.ACTION_ETA, least=1e-4, most=2)
    """Largest action change per step, normalised action units ([-1, 1])."""
    action_rate_cost: float = bounded(spec.ACTION_RATE_COST, least=0, most=1e6)
    """Coefficient of mean(((a_t - a_{t-1}) / 0.32)^2) in the cost of a step; default: the
    reward's."""
    pose_cost: float = bounded(spec.POSE_COST, least=0, most=1e6)
    """Coefficient of mean(a_t^2) in the cost of a step; default: the reward's."""
    action_parameterization: ActionParameterization = "target"
    """How a sample becomes actions. target: move towards one target at rate eta, then hold it, like
    the default data of egovcp-collect; random_walk: an independent change at every step."""
    termination_threshold: float = bounded(0.9, least=0, most=1)
    """A candidate is considered failed where its termination probability exceeds this."""
    termination_rule: TerminationRule = "shift"
    """Value of a failed candidate. paper: zero from then on; shift: the 0.1 % quantile of the
    returns in the data; survival: values above that are weighted by the probability of survival."""
    latent: Latent = "mean"
    """z of imagined states. mean: the mean of the prior; sample: a sample of it, with the same
    noise for all candidates."""
    optimiser: OptimiserName = "cem"
    """cem (fitted to the elites), icem (coloured noise, elites are kept, fewer samples per
    iteration), mppi (weighted by value), shooting (uniform)."""
    temperature: float = bounded(0.3, least=1e-6, most=1e6)
    """mppi: temperature, in standard deviations of the values."""
    noise_exponent: float = bounded(2.0, least=0, most=10)
    """icem: exponent of the noise spectrum, f^-x; 0: white."""
    kept_elites: float = bounded(0.3, least=0, most=1)
    """icem: share of the elites that are candidates again in the next iteration."""
    sample_decay: float = bounded(1.25, least=1, most=1000)
    """icem: factor by which the number of samples shrinks per iteration."""
    mirror: bool = True
    """If the robot is symmetric, average V with that of the mirrored plan in the mirrored scene."""
    backend: BackendName = "auto"
    """eager: the world model itself; float32: packed networks; int8: 8-bit integers, by a library
    compiled on first use (CPU only); auto: int8 on CPUs where it is fast, else float32."""

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.elites > self.samples:
            raise UsageError(
                f"planner.elites={self.elites} exceeds planner.samples={self.samples}; lower it"
            )

    @property
    def actions(self) -> int:
        """P, actions of a candidate: N, and under ``objective=td`` one more, for Q at the end."""
        return self.horizon + (self.objective == "td")


#: The paper's planner: 1024 random walks, 64 elites, no action costs, value 0 after a termination,
#: no mirrored plans.
PAPER_PLANNER = PlannerConfig(
    samples=1024,
    elites=64,
    pose_cost=0.0,
    action_rate_cost=0.0,
    action_parameterization="random_walk",
    termination_rule="paper",
    mirror=False,
)


def require_compatible(model: WorldModelConfig, planner: PlannerConfig) -> None:
    """Raise `UsageError` if the planner needs predictions that the world model does not make."""
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


def require_affordable(model: WorldModelConfig, planner: PlannerConfig) -> None:
    """Raise `UsageError` if a plan for one robot, on one core, takes too much time or memory."""
    samples = planner.samples * (1 + planner.mirror)
    iterations, actions = planner.iterations, planner.actions
    floats = _floats_per_step(model)
    per_step = _products_per_step(model) / _PRODUCTS_PER_S + floats / _FLOATS_PER_S
    seconds = samples * actions * iterations * per_step + actions * iterations * _CALL_S
    memory = _BYTES * samples * (actions * spec.ACTION_DIM * _ACTION_COPIES + floats)
    if seconds > MAX_SECONDS or memory > MAX_BYTES:
        raise UsageError(
            f"planner.samples={planner.samples}, planner.horizon={planner.horizon} and "
            f"planner.iterations={iterations} take about {seconds:,.1f} s on one core and "
            f"{memory / 1e6:,.0f} MB for each plan of one robot with these networks; expected at "
            f"most {MAX_SECONDS:.0f} s and {MAX_BYTES / 1e6:.0f} MB: lower them"
        )


def _products_per_step(c: WorldModelConfig) -> int:
    """Multiply-adds of one step of one candidate."""
    state = c.hidden + c.latent
    transition = (c.latent + spec.ACTION_DIM) * c.units + (c.units + c.hidden) * 3 * c.hidden
    prior = c.hidden * c.units + c.units * 2 * c.latent
    value = (state + spec.ACTION_DIM + c.units + width(c.value_loss)) * c.units
    termination = (state + 1) * c.units
    return transition + prior + value + termination


def _floats_per_step(c: WorldModelConfig) -> int:
    """Intermediate results of one step of one candidate."""
    return 8 * c.hidden + 9 * c.units + 4 * c.latent + width(c.value_loss)
