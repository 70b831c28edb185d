"""Loggers of a run: scalars, images and the policy, to TensorBoard, Weights & Biases, Trackio."""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import draccus
import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure

if TYPE_CHECKING:
    from egovcp_train.config import TrainConfig

RUN_ID: Final = "wandb/run_id.txt"
RUN_NAME: Final = "trackio/run_name.txt"


@dataclass(frozen=True)
class WandbConfig:
    """Weights & Biases logging, in addition to TensorBoard."""

    enable: bool = False
    """Enable it; needs the package wandb."""
    project: str = "egovcp"
    """Project of the run."""
    entity: str = ""
    """User or team; empty: your default."""
    notes: str = ""
    """Description of the run."""
    run_id: str = ""
    """Id of the run; empty: a new one, or that of the run that is resumed."""
    mode: Literal["online", "offline", "disabled"] = "online"
    """offline: keep the logs below OUTPUT_DIR/wandb for `wandb sync`."""
    disable_artifact: bool = False
    """Do not upload the finished policy."""


class Logger(ABC):
    """Destination of scalars, images and the policy of a run."""

    @abstractmethod
    def log_scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Log one value per name at ``step``."""

    @abstractmethod
    def log_image(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Log an image (height, width, 3) at ``step``."""

    def log_policy(self, step: int, folder: Path) -> None:  # noqa: B027 - optional
        """Upload the finished policy; by default it stays in the output folder."""

    @abstractmethod
    def close(self) -> None:
        """Write or send what remains."""


class TensorBoardLogger(Logger):
    """Writes below OUTPUT_DIR/tensorboard."""

    def __init__(self, output: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # takes a second

        self._writer = SummaryWriter(str(output / "tensorboard"))

    def log_scalars(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def log_image(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        self._writer.add_image(name, pixels, step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


class _RunLogger(Logger):
    """Logs to a run of ``package``, which has a wandb-compatible API."""

    def __init__(self, package: Any, run: Any) -> None:
        self._package, self._run = package, run

    def log_scalars(self, step: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def log_image(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        self._run.log({name: self._package.Image(pixels)}, step=step)

    def close(self) -> None:
        self._run.finish()


class TrackioLogger(_RunLogger):
    """Logs to one run of Trackio on this machine; a resumed training continues it.

    Trackio continues the newest run of a name, so the name, which is stored in ``output``, is that
    of this folder and a random suffix.
    """

    def __init__(self, output: Path, project: str, options: Mapping[str, Any]) -> None:
        import trackio  # an optional package

        name = _stored(output / RUN_NAME) or f"{output.name}-{secrets.token_hex(4)}"
        run = trackio.init(project, name, config=dict(options), resume="allow")
        super().__init__(trackio, run)
        _store(output / RUN_NAME, name)


class WandbLogger(_RunLogger):
    """Logs to one run of Weights & Biases; a resumed training continues it."""

    def __init__(self, output: Path, config: WandbConfig, options: Mapping[str, Any]) -> None:
        """Start or continue the run, whose id is stored in ``output``.

        Raises:
            EnvironmentFailure: the user is not logged in, or the server cannot be reached.
        """
        import wandb  # an optional package

        try:
            run = wandb.init(
                id=config.run_id or _stored(output / RUN_ID),
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
        super().__init__(wandb, run)
        self._upload = not config.disable_artifact
        _store(output / RUN_ID, run.id)

    def log_policy(self, step: int, folder: Path) -> None:
        if self._upload:
            artifact = self._package.Artifact(f"egovcp-{self._run.id}-{step:06d}", type="model")
            artifact.add_dir(str(folder))
            self._run.log_artifact(artifact)


def _stored(path: Path) -> str | None:
    return path.read_text("utf-8") if path.is_file() else None


def _store(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def make_loggers(config: TrainConfig, output: Path) -> list[Logger]:
    """The loggers that the options of a run select."""
    found: list[Logger] = []
    if config.tensorboard:
        found.append(TensorBoardLogger(output))
    if config.wandb.enable:
        found.append(WandbLogger(output, config.wandb, draccus.encode(config)))
    if config.trackio:
        found.append(TrackioLogger(output, config.trackio, draccus.encode(config)))
    return found
