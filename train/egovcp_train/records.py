"""Scalars and pictures of a run to TensorBoard, and to whatever else is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Records(Protocol):
    """Where the course of a training is kept."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        ...

    def picture(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record a picture (height, width, 3) at ``step``."""
        ...

    def artifact(self, step: int, folder: Path) -> None:
        """Take the finished policy."""
        ...

    def close(self) -> None:
        """Everything is written."""
        ...


class Recorder:
    """Writes below OUTPUT_DIR/tensorboard; does nothing where disabled."""

    def __init__(self, output: Path, *, enabled: bool) -> None:
        self._writer = None
        if enabled:
            # Imported here: it takes a second that --help and refused input should not.
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(output / "tensorboard"))

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

    def picture(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record a picture (height, width, 3) at ``step``."""
        if self._writer is not None:
            self._writer.add_image(name, pixels, step, dataformats="HWC")

    def artifact(self, step: int, folder: Path) -> None:
        """TensorBoard keeps no files."""

    def close(self) -> None:
        """Flush to disk."""
        if self._writer is not None:
            self._writer.close()


class Everywhere:
    """To all of several records; to none, where there are none."""

    def __init__(self, records: Sequence[Records]) -> None:
        self._records = tuple(records)

    def __len__(self) -> int:
        return len(self._records)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record one value per name at ``step``."""
        for records in self._records:
            records.scalars(step, values)

    def picture(self, step: int, name: str, pixels: NDArray[np.uint8]) -> None:
        """Record a picture (height, width, 3) at ``step``."""
        for records in self._records:
            records.picture(step, name, pixels)

    def artifact(self, step: int, folder: Path) -> None:
        """Hand on the finished policy."""
        for records in self._records:
            records.artifact(step, folder)

    def close(self) -> None:
        """Everything is written."""
        for records in self._records:
            records.close()
