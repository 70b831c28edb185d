"""What the studies share: a policy to look at, and a folder for what was found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egovcp.artefact import Artefact, load_artefact
from egovcp.atomic import write_json
from egovcp.errors import UsageError
from egovcp_experiment.tools import RESULT


@dataclass(frozen=True)
class PolicyConfig:
    """Which policy artefact."""

    path: str = ""
    """Folder of the artefact, or its Hub id `user/name`."""
    revision: str = ""
    """Branch, tag or commit SHA on the Hub; empty: the latest."""

    def load(self) -> Artefact:
        """The artefact.

        Raises:
            UsageError: none is named.
            ArtefactError: it is missing or damaged.
        """
        if not self.path:
            raise UsageError("--policy.path is missing; name the artefact")
        return load_artefact(self.path, self.revision)


@dataclass(frozen=True)
class StudyConfig:
    """Options of every study."""

    output_dir: str = ""
    """New folder for the result."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """The policy to look at."""

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
