"""Scalars, pictures and the artifact of a run to Weights & Biases, if asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.packages import require_packages

RUN_ID: Final = "wandb/run_id.txt"


@dataclass(frozen=True)
class WandbConfig:
    """Records to Weights & Biases, beside TensorBoard."""

    enable: bool = False
    """Record there; needs the package wandb."""
    project: str = "egovcp"
    """Project of the run."""
    entity: str = ""
    """User or team; empty: your default."""
    notes: str = ""
    """Description of the run."""
    run_id: str = ""
    """Id of the run; empty: a new one, or that of the run that is resumed."""
    mode: Literal["online", "offline", "disabled"] = "online"
    """offline: keep the records below OUTPUT_DIR/wandb for `wandb sync`."""
    disable_artifact: bool = False
    """Do not upload the finished policy."""


def require_wandb(config: WandbConfig) -> None:
    """Raise `MissingPackage` where it is asked for and not installed."""
    if config.enable:
        require_packages("egovcp-train", "--wandb.enable", "wandb")


class WandbRecorder:
    """One run there; a resumed training goes on with the same one."""

    def __init__(self, output: Path, config: WandbConfig, options: Mapping[str, Any]) -> None:
        """Start or continue the run.

        Args:
            output: folder of the training; remembers the id of the run.
            config: where.
            options: those of the training, for the record.

        Raises:
            EnvironmentFailure: nobody is logged in, or the server cannot be reached.
        """
        import wandb  # the package is optional

        known = output / RUN_ID
        try:
            self._run = wandb.init(
                id=config.run_id or (known.read_text("utf-8") if known.is_file() else None),
                project=config.project,
                entity=config.entity or None,
                notes=config.notes or None,
                name=output.name,
                dir=str(output),
                config=dict(options),
                job_type="train",
                resume="allow",
                mode=config.mode,
            )
        except wandb.Error as error:
            raise EnvironmentFailure(
                f"wandb: {' '.join(str(error).split())[:200]}; see `wandb login`, or choose "
                "--wandb.mode=offline"
            ) from error
        self._wandb, self._config = wandb, config
        known.parent.mkdir(parents=True, exist_ok=True)
        known.write_text(self._run.id, encoding="utf-8")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        self._run.log(dict(values), step=step)

    def picture(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record a picture (height, width, 3) at ``step``."""
        self._run.log({name: self._wandb.Image(pixels)}, step=step)

    def artifact(self, step: int, folder: Path) -> None:
        """Upload the finished policy, unless that is switched off."""
        if self._config.disable_artifact:
            return
        artifact = self._wandb.Artifact(f"egovcp-{self._run.id}-{step:06d}", type="model")
        artifact.add_dir(str(folder))
        self._run.log_artifact(artifact)

    def close(self) -> None:
        """Send what is left."""
        self._run.finish()
