"""Checkpoints in LeRobot's layout, complete or absent, never half-written.

checkpoints/000500/pretrained_model/   the policy artefact (averaged weights)
checkpoints/000500/training_state/     raw weights, optimiser, random streams, data position
checkpoints/last -> 000500
"""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from egovcp.atomic import removed_on_error
from egovcp.data.files import sync, sync_tree
from egovcp.errors import ArtefactError

STATE_FILE = "state.pt"


def checkpoint_dir(output_dir: Path, step: int) -> Path:
    return output_dir / "checkpoints" / f"{step:06d}"


@contextmanager
def new_checkpoint(output_dir: Path, step: int, state: dict[str, Any]) -> Iterator[Path]:
    """Write a checkpoint: the block fills ``pretrained_model``, an empty folder.

    Then the training state is added, and the checkpoint appears under its name. If anything fails
    nothing is left, and ``last`` is the checkpoint before.

    Args:
        output_dir: folder of the run.
        step: names the checkpoint.
        state: what `load_training_state` will return.
    """
    with removed_on_error(checkpoint_dir(output_dir, step).with_suffix(".partial")) as partial:
        for leftover in partial.parent.glob("*.partial"):  # of a killed run
            shutil.rmtree(leftover, ignore_errors=True)
        model = partial / "pretrained_model"
        model.mkdir(parents=True)
        yield model
        _finish(partial, state)


def _finish(partial: Path, state: dict[str, Any]) -> None:
    """Add the training state to NNNNNN.partial, publish it, point ``last`` at it."""
    folder = partial / "training_state"
    folder.mkdir(parents=True)
    with (folder / STATE_FILE).open("wb") as file:
        torch.save(state, file)
    sync_tree(partial)  # on the disk before it gets its name
    final = partial.with_suffix("")
    shutil.rmtree(final, ignore_errors=True)
    partial.rename(final)
    link = final.parent / "last.new"
    link.unlink(missing_ok=True)
    link.symlink_to(final.name)
    link.replace(final.parent / "last")
    sync(final.parent)


def load_training_state(output_dir: Path) -> dict[str, Any]:
    """Training state of the last complete checkpoint.

    Raises:
        ArtefactError: there is none, or it cannot be read.
    """
    path = output_dir / "checkpoints" / "last" / "training_state" / STATE_FILE
    if not path.is_file():
        raise ArtefactError(
            f"{output_dir}: no checkpoint to resume from (expected "
            f"{path.relative_to(output_dir)}); start without --resume in a new folder"
        )
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (EOFError, OSError, RuntimeError, pickle.UnpicklingError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ArtefactError(
            f"{path}: cannot be read ({reason}); point {output_dir}/checkpoints/last at an older "
            "checkpoint, or start again"
        ) from error
    return state
