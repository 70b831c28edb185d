"""Options that the commands of this package share, and what is checked before any work."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Final

from egovcp.artefact import Artefact, load_artefact
from egovcp.errors import EnvironmentFailure, UsageError, suggest
from egovcp.plan import PlannerConfig, require_answers
from egovcp.plan.choices import Ensemble, Latent
from egovcp.plan.config import BackendName, Objective, OptimiserName, TerminationRule

PLANNER: Final = "planner"
REFERENCES: Final = ("hold", "random", "oracle")
_PACKAGES: Final = ("egovcp", "egovcp-deploy", "torch", "numpy")


@dataclass(frozen=True)
class PolicyOptions:
    """Which policy artefact."""

    path: str = ""
    """Folder of the artefact, or its Hub id `user/name`."""
    revision: str = ""
    """Branch, tag or commit SHA on the Hub; empty: the latest."""

    def require(self, otherwise: str) -> None:
        """Raise `UsageError`, which offers to do ``otherwise``, unless an artefact is named."""
        if not self.path:
            raise UsageError(f"--policy.path is missing; name the artefact, or {otherwise}")


@dataclass(frozen=True)
class PlannerOptions:
    """Changes to the artefact's own planner; what is not given stays as it is there."""

    samples: int | None = None
    """M, candidate plans per iteration."""
    horizon: int | None = None
    """N, planner ticks of 40 ms."""
    objective: Objective | None = None
    """J of a plan: value (mean of Q), reward (sum of predicted rewards), td (the same and Q at the
    end). The last two need a model trained with loss.reward, and compute step by step."""
    iterations: int | None = None
    """Rounds of the search."""
    elites: int | None = None
    """Best candidates that the next round is fitted to."""
    termination_rule: TerminationRule | None = None
    """What a failed plan's later values are: paper (0), shift (the data's worst return), survival
    (weighted with the probability of being alive)."""
    latent: Latent | None = None
    """z of imagined states: mean of the prior, or a sample."""
    ensemble: Ensemble | None = None
    """Several heads of Q: mean, or min."""
    optimiser: OptimiserName | None = None
    """The search: cem, icem, mppi or shooting (docs/planner.md)."""
    backend: BackendName | None = None
    """Who computes: auto, eager, float32, bfloat16, int8 or compile (docs/planner.md)."""

    def apply(self, planner: PlannerConfig) -> PlannerConfig:
        """``planner`` with these changes.

        Raises:
            UsageError: the numbers do not go together.
        """
        return replace(planner, **{k: v for k, v in asdict(self).items() if v is not None})


def load_policy(policy: PolicyOptions, planner: PlannerOptions) -> Artefact:
    """The artefact, whose planner is changed as the options say.

    Raises:
        ArtefactError: missing, tampered with, or made for another feature spec.
        EnvironmentFailure: the Hub cannot be reached.
        UsageError: the planner's numbers do not go together, or it asks what the model never
            learned.
    """
    artefact = load_artefact(policy.path, policy.revision)
    changed = planner.apply(artefact.planner)
    require_answers(artefact.world_model.config, changed)
    return replace(artefact, planner=changed)


def check_choice(flag: str, value: str, valid: Iterable[str]) -> None:
    """Raise `UsageError` unless ``value`` is one of ``valid``."""
    choices = tuple(valid)
    if value not in choices:
        raise UsageError(f"unknown value {flag}={value}{suggest(value, choices)}")


def check_positive(flag: str, value: int) -> None:
    """Raise `UsageError` unless ``value`` counts from 1."""
    if value < 1:
        raise UsageError(f"{flag}={value}: expected at least 1")


def check_output_dir(path: str, reusable: tuple[str, ...] = ()) -> Path:
    """The output folder; one that holds anything is refused. Creates nothing.

    Args:
        path: the folder of ``--output_dir``.
        reusable: file names that may be there already.

    Raises:
        UsageError: no folder was named, or it holds other files.
    """
    if not path:
        raise UsageError("--output_dir is missing; name a new folder for the results")
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--output_dir={path} is a file; name a new folder")
    present = [entry.name for entry in folder.iterdir()] if folder.exists() else []
    foreign = sorted(name for name in present if name not in reusable)
    if foreign:
        raise UsageError(
            f"--output_dir={path} holds {foreign[0]} already; results are never overwritten: "
            "name another folder or remove this one"
        )
    return folder


def make_output_dir(path: str, reusable: tuple[str, ...] = ()) -> Path:
    """Create the folder that `check_output_dir` accepts.

    Raises:
        UsageError: as `check_output_dir`.
        EnvironmentFailure: it cannot be created or written to.
    """
    folder = check_output_dir(path, reusable)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentFailure(f"cannot create {path}: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise EnvironmentFailure(f"cannot write to {path}: permission denied")
    return folder


def versions() -> dict[str, str]:
    """Distribution -> version of what shaped the results."""
    return {name: version(name) for name in _PACKAGES}
