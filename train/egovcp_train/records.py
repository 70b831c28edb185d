"""Scalars, images and the policy of a run, recorded to TensorBoard, Weights & Biases, Trackio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure

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


class TensorBoardRecorder:
    """Writes below OUTPUT_DIR/tensorboard."""

    def __init__(self, output: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes a second

        self._writer = SummaryWriter(str(output / "tensorboard"))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def image(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record an image (height, width, 3) at ``step``."""
        self._writer.add_image(name, pixels, step, dataformats="HWC")

    def policy(self, step: int, folder: Path) -> None:
        """Nothing: TensorBoard keeps no files."""

    def close(self) -> None:
        """Flush to disk."""
        self._writer.close()


class TrackioRecorder:
    """Records to a run of the local Trackio, whose package has the functions of wandb."""

    def __init__(self, output: Path, project: str, options: Mapping[str, Any]) -> None:
        """Start the run, or continue that of the same folder name; see `WandbRecorder`."""
        import trackio  # an optional package

        self._package = trackio
        resume = "allow" if options["resume"] else "never"
        self._run = trackio.init(project, output.name, config=dict(options), resume=resume)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        self._run.log(dict(values), step=step)

    def image(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record an image (height, width, 3) at ``step``."""
        self._run.log({name: self._package.Image(pixels)}, step=step)

    def policy(self, step: int, folder: Path) -> None:
        """Nothing: the policy stays in the output folder."""

    def close(self) -> None:
        """Send the remaining records."""
        self._run.finish()


class WandbRecorder(TrackioRecorder):
    """Records to one run of Weights & Biases; a resumed training continues it."""

    def __init__(self, output: Path, config: WandbConfig, options: Mapping[str, Any]) -> None:
        """Start or continue the run.

        Args:
            output: folder of the training, which stores the id of the run.
            config: project and user.
            options: those of the training, to be recorded.

        Raises:
            EnvironmentFailure: the user is not logged in, or the server cannot be reached.
        """
        import wandb  # an optional package

        stored = output / RUN_ID
        try:
            self._run = wandb.init(
                id=config.run_id or (stored.read_text("utf-8") if stored.is_file() else None),
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
        self._package, self._config = wandb, config
        stored.parent.mkdir(parents=True, exist_ok=True)
        stored.write_text(self._run.id, encoding="utf-8")

    def policy(self, step: int, folder: Path) -> None:
        """Upload the finished policy, unless that is disabled."""
        if self._config.disable_artifact:
            return
        artifact = self._package.Artifact(f"egovcp-{self._run.id}-{step:06d}", type="model")
        artifact.add_dir(str(folder))
        self._run.log_artifact(artifact)


class Records:
    """All recorders of a run."""

    def __init__(self, recorders: Sequence[TensorBoardRecorder | TrackioRecorder]) -> None:
        self._recorders = tuple(recorders)

    def __bool__(self) -> bool:
        return bool(self._recorders)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        for recorder in self._recorders:
            recorder.scalars(step, values)

    def image(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record an image (height, width, 3) at ``step``."""
        for recorder in self._recorders:
            recorder.image(step, name, pixels)

    def policy(self, step: int, folder: Path) -> None:
        """Record the finished policy."""
        for recorder in self._recorders:
            recorder.policy(step, folder)

    def close(self) -> None:
        """Finish all records."""
        for recorder in self._recorders:
            recorder.close()
