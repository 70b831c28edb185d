"""Options of commands that play a policy."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Final

from egovcp.artifact import Artifact, load_artifact
from egovcp.bounds import OutOfBounds
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

_PLANNER_FIELDS: Final = {option.name: option for option in fields(PlannerConfig)}


def _planner_override(option: str) -> Any:
    """A field that is None by default, with the bounds of this option of the planner."""
    return field(default=None, metadata=_PLANNER_FIELDS[option].metadata)


@dataclass(frozen=True)
class PolicyOptions:
    """A local folder, a Hub id, or the name of a shipped policy."""

    path: str = ""
    """Folder of the artifact, its Hub id `user/name`, or `contact`, which ships with egovcp (a
    folder of that name: `./contact`)."""
    revision: str = ""
    """Branch, tag or commit SHA on the Hub; empty: the latest."""

    def require(self, alternative: str = "") -> None:
        """Raise `UsageError` unless a path is given; the message also names ``alternative``."""
        if not self.path:
            suffix = f", or {alternative}" if alternative else ""
            raise UsageError(f"--policy.path is missing; name the artifact{suffix}")


@dataclass(frozen=True)
class PlannerOptions:
    """Changes to the policy's planner."""

    samples: int | None = _planner_override("samples")
    """M, candidate plans per iteration."""
    horizon: int | None = _planner_override("horizon")
    """N, planning horizon, planner steps (of 40 ms for the G1)."""
    objective: Objective | None = None
    """V of a plan: value (mean of Q), reward (sum of predicted rewards), td (the same and Q at the
    end). The last two need a model trained with loss.reward."""
    iterations: int | None = _planner_override("iterations")
    """Iterations of the search."""
    elites: int | None = _planner_override("elites")
    """Best candidates that the next iteration is fitted to."""
    min_std: float | None = _planner_override("min_std")
    """Smallest sampling standard deviation, in units of eta."""
    action_rate_cost: float | None = _planner_override("action_rate_cost")
    """Coefficient of mean(((a_t - a_{t-1}) / 0.32)^2) in the cost of a step."""
    pose_cost: float | None = _planner_override("pose_cost")
    """Coefficient of mean(a_t^2) in the cost of a step."""
    action_parameterization: ActionParameterization | None = None
    """How a sample becomes actions: target (move towards one target, then hold it), or random_walk
    (an independent change at every step)."""
    termination_rule: TerminationRule | None = None
    """Value of a failed candidate: paper (0), shift (the 0.1 % quantile of the returns in the
    data), or survival (weighted by the probability of survival)."""
    latent: Latent | None = None
    """z of imagined states: mean or sample of the prior."""
    optimiser: OptimiserName | None = None
    """Optimiser: cem, icem, mppi or shooting."""
    mirror: bool | None = None
    """Average V with that of the mirrored plan in the mirrored scene, if the robot is symmetric."""
    backend: BackendName | None = None
    """Implementation of the networks: eager (the world model itself), float32 (packed networks),
    int8 (8-bit integers, on CPUs only), or auto (int8 on CPUs where it is fast, else float32)."""

    def apply(self, planner: PlannerConfig) -> PlannerConfig:
        """``planner`` with these changes.

        Raises:
            UsageError: a number is out of bounds, or numbers contradict each other.
        """
        try:
            return replace(planner, **{k: v for k, v in asdict(self).items() if v is not None})
        except OutOfBounds as error:
            raise error.with_prefix("--planner.") from error


def load_policy(policy: PolicyOptions | str, planner: PlannerOptions | None = None) -> Artifact:
    """The artifact with the planner options applied.

    Args:
        policy: the options, or only the path: `load_policy("contact")`.
        planner: changes to the artifact's planner.

    Raises:
        ArtifactError: missing, changed, or made for another feature spec.
        EnvironmentFailure: the Hub cannot be reached.
        UsageError: contradicting numbers, a plan that takes too much time or memory, or a head that
            the model does not have.
    """
    if isinstance(policy, str):
        policy = PolicyOptions(policy)
    artifact = load_artifact(policy.path, policy.revision)
    if planner is None:
        return artifact
    changed = planner.apply(artifact.planner)
    require_compatible(artifact.world_model.config, changed)
    require_affordable(artifact.world_model.config, changed)
    return replace(artifact, planner=changed)
