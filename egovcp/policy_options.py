"""Options of commands that play a policy artifact."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from egovcp.artifact import Artifact, load_artifact
from egovcp.bounds import OutOfBounds, bounded
from egovcp.errors import UsageError
from egovcp.plan import PlannerConfig, require_compatible
from egovcp.plan.config import (
    ActionParameterization,
    BackendName,
    Latent,
    Objective,
    OptimiserName,
    TerminationRule,
    require_affordable,
)


@dataclass(frozen=True)
class PolicyOptions:
    """Which policy artifact."""

    path: str = ""
    """Folder of the artifact, or its Hub id `user/name`."""
    revision: str = ""
    """Branch, tag or commit SHA on the Hub; empty: the latest."""

    def require(self, otherwise: str = "") -> None:
        """Raise `UsageError` unless a path is given; ``otherwise`` is an alternative to name."""
        if not self.path:
            offer = f", or {otherwise}" if otherwise else ""
            raise UsageError(f"--policy.path is missing; name the artifact{offer}")


@dataclass(frozen=True)
class PlannerOptions:
    """Overrides of the planner options of the artifact."""

    samples: int | None = bounded(None, least=1, most=2**20)
    """M, candidate plans per iteration."""
    horizon: int | None = bounded(None, least=1, most=1000)
    """N, planner ticks of 40 ms."""
    objective: Objective | None = None
    """J of a plan: value (mean of Q), reward (sum of predicted rewards), td (the same and Q at the
    end). The last two need a model trained with loss.reward."""
    iterations: int | None = bounded(None, least=1, most=10_000)
    """Rounds of the search."""
    elites: int | None = bounded(None, least=1, most=2**20)
    """Best candidates that the next round is fitted to."""
    min_std: float | None = bounded(None, least=0)
    """Smallest standard deviation of candidates, in steps of the action parameterization."""
    hands_cost: float | None = bounded(None, least=0)
    """Cost of hands away from the neutral pose: this return times their mean squared action."""
    step_cost: float | None = bounded(None, least=0)
    """Cost of motion: this return times the mean squared step of the plan."""
    action_parameterization: ActionParameterization | None = None
    """Candidates: random_walk (a step in every tick), or target (a ramp to a pose that is held)."""
    termination_rule: TerminationRule | None = None
    """Values after a predicted failure: paper (0), shift (lowest return of the data), survival
    (weighted with the survival probability)."""
    latent: Latent | None = None
    """z of imagined states: mean or sample of the prior."""
    optimiser: OptimiserName | None = None
    """Optimiser: cem, icem, mppi or shooting."""
    backend: BackendName | None = None
    """Implementation of the networks: auto, eager, float32 or int8."""

    def apply(self, planner: PlannerConfig) -> PlannerConfig:
        """``planner`` with these changes.

        Raises:
            UsageError: a number is out of bounds, or numbers contradict each other.
        """
        try:
            return replace(planner, **{k: v for k, v in asdict(self).items() if v is not None})
        except OutOfBounds as error:
            raise error.with_prefix("--planner.") from error


def load_policy(policy: PolicyOptions, planner: PlannerOptions) -> Artifact:
    """The artifact with the planner options applied.

    Raises:
        ArtifactError: missing, changed, or made for another feature spec.
        EnvironmentFailure: the Hub cannot be reached.
        UsageError: contradicting numbers, a plan that takes too much time or memory, or a head that
            the model does not have.
    """
    artifact = load_artifact(policy.path, policy.revision)
    changed = planner.apply(artifact.planner)
    require_compatible(artifact.world_model.config, changed)
    require_affordable(artifact.world_model.config, changed)
    return replace(artifact, planner=changed)
