"""Scalars and pictures of a run to TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


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

    def close(self) -> None:
        """Flush to disk."""
        if self._writer is not None:
            self._writer.close()
