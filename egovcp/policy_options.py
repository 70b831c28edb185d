"""Options that name a policy artifact and change its planner, for every command that plays."""

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
        """Raise `UsageError`, which offers to do ``otherwise``, unless an artifact is named."""
        if not self.path:
            offer = f", or {otherwise}" if otherwise else ""
            raise UsageError(f"--policy.path is missing; name the artifact{offer}")


@dataclass(frozen=True)
class PlannerOptions:
    """Changes to the artifact's own planner; what is not given stays as it is there."""

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
    """Floor of the deviation that candidates are drawn with, in steps of the action process."""
    hands_cost: float | None = bounded(None, least=0)
    """What hands away from the neutral pose cost a plan: so much return times their mean squared
    action (docs/planner.md)."""
    step_cost: float | None = bounded(None, least=0)
    """What moving costs a plan: so much return times its mean squared step."""
    action_parameterization: ActionParameterization | None = None
    """What candidates are made of: walk (a step in every tick), or ramp (to a place to rest at, as
    in data of a longer `egovcp-collect --step_ticks`)."""
    termination_rule: TerminationRule | None = None
    """What a failed plan's later values are: paper (0), shift (the data's worst return), survival
    (weighted with the probability of being alive)."""
    latent: Latent | None = None
    """z of imagined states: mean of the prior, or a sample."""
    optimiser: OptimiserName | None = None
    """The search: cem, icem, mppi or shooting (docs/planner.md)."""
    backend: BackendName | None = None
    """Implementation of the planner's networks: auto, eager, float32 or int8 (docs/planner.md)."""

    def apply(self, planner: PlannerConfig) -> PlannerConfig:
        """``planner`` with these changes.

        Raises:
            UsageError: a number is out of bounds, or the numbers do not go together.
        """
        try:
            return replace(planner, **{k: v for k, v in asdict(self).items() if v is not None})
        except OutOfBounds as error:
            raise error.under("--planner.") from error


def load_policy(policy: PolicyOptions, planner: PlannerOptions) -> Artifact:
    """The artifact, whose planner is changed as the options say.

    Raises:
        ArtifactError: missing, tampered with, or made for another feature spec.
        EnvironmentFailure: the Hub cannot be reached.
        UsageError: the planner's numbers do not go together, a plan would take too long or too
            much memory, or it asks what the model never learned.
    """
    artifact = load_artifact(policy.path, policy.revision)
    changed = planner.apply(artifact.planner)
    require_compatible(artifact.world_model.config, changed)
    require_affordable(artifact.world_model.config, changed)
    return replace(artifact, planner=changed)
