"""What the studies share: a policy to look at, and a folder for what was found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from egovcp.artifact import Artifact
from egovcp.errors import UsageError
from egovcp.files import write_json
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp_experiment.tools import RESULT

_AS_IT_IS: Final = PlannerOptions()


@dataclass(frozen=True)
class StudyConfig:
    """Options of every study."""

    output_dir: str = ""
    """New folder for the result."""
    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy to look at."""

    def load(self, planner: PlannerOptions = _AS_IT_IS) -> Artifact:
        """The policy, its planner changed.

        Raises:
            UsageError: none is named, or the changes make no sense.
            ArtifactError: it is missing or damaged.
        """
        self.policy.require()
        return load_policy(self.policy, planner)

    def folder(self) -> Path:
        """Make the folder.

        Raises:
            UsageError: none is named, or it holds a result.
        """
        if not self.output_dir:
            raise UsageError("--output_dir is missing; name a new folder")
        folder = Path(self.output_dir)
        if (folder / RESULT).exists():
            raise UsageError(f"{folder} holds a result already; name a new folder")
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def finish(config: StudyConfig, figures: Mapping[str, Any]) -> None:
    """Write what was found."""
    write_json(config.folder() / RESULT, figures)
