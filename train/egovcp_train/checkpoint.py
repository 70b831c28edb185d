"""Checkpoints in LeRobot's layout, complete or absent, never half-written.

checkpoints/000500/pretrained_model/   the policy artifact (averaged weights)
checkpoints/000500/training_state/     raw weights, optimiser, random streams, data position, and
                                       their SHA-256
checkpoints/last -> 000500
"""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final

import torch

from egovcp.atomic import removed_on_error
from egovcp.data.files import sync, sync_tree
from egovcp.errors import ArtifactError
from egovcp.model.weights import MAX_WEIGHT_BYTES
from egovcp.safe_files import UnsafeFileError, open_regular, read_text, sha256

STATE_FILE = "state.pt"
DIGEST_FILE = f"{STATE_FILE}.sha256"
"""As ``sha256sum`` writes it; checkpoints of earlier versions have none."""
_LIMIT_BYTES: Final = 5 * MAX_WEIGHT_BYTES + (1 << 30)  # weights, averages and moments; positions


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
    (folder / DIGEST_FILE).write_text(f"{sha256(folder / STATE_FILE)}  {STATE_FILE}\n")
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
        ArtifactError: there is none, or it cannot be read.
    """
    path = output_dir / "checkpoints" / "last" / "training_state" / STATE_FILE
    if not os.path.lexists(path):
        raise ArtifactError(
            f"{output_dir}: no checkpoint to resume from (expected "
            f"{path.relative_to(output_dir)}); start without --resume in a new folder"
        )
    try:
        _require_digest(path)
        with open_regular(path, _LIMIT_BYTES) as file:
            state: dict[str, Any] = _load(file)
        return state
    except (OSError, UnsafeFileError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ArtifactError(
            f"{path}: cannot be read ({reason}); point {output_dir}/checkpoints/last at an older "
            "checkpoint, or start again"
        ) from error


@contextmanager
def restoring(output_dir: Path) -> Iterator[None]:
    """Around the code that takes a training state.

    Raises:
        ArtifactError: the state is not that of the options.
    """
    try:
        yield
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ArtifactError(
            f"{output_dir}: its checkpoint does not fit the options given ({reason}); resume "
            "without them, or start a new run"
        ) from error


def _require_digest(path: Path) -> None:
    """Raise unless the SHA-256 of the state is the one beside it."""
    beside = path.with_name(DIGEST_FILE)
    if not os.path.lexists(beside):
        return
    expected = read_text(beside, 1024).split(" ")[0]
    found = sha256(path, _LIMIT_BYTES)
    if found != expected:
        raise UnsafeFileError(f"its SHA-256 is not the one in {DIGEST_FILE}; it is damaged")


def _load(file: IO[bytes]) -> dict[str, Any]:
    try:
        with warnings.catch_warnings(action="ignore"):
            state = torch.load(file, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # the unpickler raises whatever the bytes make it do
        raise UnsafeFileError("not a training state") from error
    if not isinstance(state, dict):
        raise UnsafeFileError("not a training state")
    return state
