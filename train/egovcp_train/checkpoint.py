"""The output folder of a run: its options, and checkpoints that are complete or absent.

train_config.yaml                      the options of the run
checkpoints/000500/pretrained_model/   the policy (moving average of weights), in LeRobot's layout
checkpoints/000500/training_state/     weights, optimiser, random streams, data position, and
                                       their SHA-256
checkpoints/last -> 000500
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final

import torch

from egovcp.artifact import load_artifact, require_same_returns
from egovcp.cli import given_options
from egovcp.data import ReturnConfig
from egovcp.data.dataset_files import sync, sync_tree
from egovcp.errors import ArtifactError, UsageError
from egovcp.files import (
    UnsafeFileError,
    open_regular,
    read_text,
    removed_on_error,
    sha256,
    user_path,
)
from egovcp.flags import read_config
from egovcp.model import WorldModel
from egovcp.model.weights import MAX_WEIGHT_BYTES
from egovcp.outputs import require_writable
from egovcp.values import build, convert
from egovcp_train.device import is_full_memory

CONFIG_FILE: Final = "train_config.yaml"
STATE_FILE: Final = "state.pt"
DIGEST_FILE: Final = f"{STATE_FILE}.sha256"
"""In the format of ``sha256sum``."""
_LIMIT_BYTES: Final = 5 * MAX_WEIGHT_BYTES + (1 << 30)  # weights, averages and moments; positions
_REMEDY: Final = "restore this file, or remove it and give all options of the run as flags"


# --- options -------------------------------------------------------------------------
def resumed_options(config_class: type, argv: Sequence[str]) -> dict[str, Any]:
    """The stored options of the run that is resumed; empty without ``--resume``, or if there are
    none.

    Args:
        config_class: dataclass of the command's options.
        argv: its flags, ``--name=value`` each.

    Raises:
        UsageError: ``--resume`` is not a boolean, or a config file or another preset is given.
        ArtifactError: the stored options cannot be read, or are not those of ``config_class``.
    """
    given = given_options(argv)
    if not convert(bool, given.get("resume", "false"), "--resume"):
        return {}
    if "config_path" in given:
        raise UsageError(
            f"--resume uses the options stored in --output_dir, and "
            f"--config_path={given['config_path']} gives others; drop it, and give changes as flags"
        )
    saved = user_path(given.get("output_dir", "")) / CONFIG_FILE
    if not os.path.lexists(saved):
        return {}
    try:
        options = read_config(saved)
        build(config_class, options, "--")
    except OSError as error:
        raise ArtifactError(f"{saved}: cannot be read: {error.strerror}; {_REMEDY}") from error
    except (UsageError, ValueError) as error:
        raise ArtifactError(f"{saved}: {error}; {_REMEDY}") from error
    preset, stored = given.get("preset"), options.get("preset")
    if preset not in (None, stored):
        raise UsageError(
            f"--resume uses the options stored in --output_dir, which are of preset {stored}, and "
            f"--preset={preset} would change nothing; drop it, or start a new run"
        )
    return options


def prepare_output(output_dir: str, resume: bool, resumable: bool = True) -> Path:
    """Check the output folder before any work starts.

    Args:
        output_dir: the folder, which need not exist.
        resume: continue the run in it.
        resumable: whether the command has the option ``--resume``.

    Raises:
        ArtifactError: there is nothing to resume.
        UsageError: the folder exists and is not empty.
        EnvironmentFailure: it is not writable.
    """
    output = user_path(output_dir)
    if resume:
        with _open_training_state(output):  # loaded later
            return output
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        remedy = ", or continue the run in it with --resume" if resumable else ""
        raise UsageError(f"output folder {output} exists and is not empty; choose another{remedy}")
    require_writable(output)
    return output


# --- checkpoints ---------------------------------------------------------------------
def checkpoint_dir(output_dir: Path, step: int) -> Path:
    return output_dir / "checkpoints" / f"{step:06d}"


@contextmanager
def new_checkpoint(output_dir: Path, step: int, state: dict[str, Any]) -> Iterator[Path]:
    """Write a checkpoint: the block fills ``pretrained_model``, an empty folder.

    Then the training ``state`` is added and the checkpoint gets its name, ``step``. If anything
    fails, nothing is left, and ``last`` is the previous checkpoint.
    """
    with removed_on_error(checkpoint_dir(output_dir, step).with_suffix(".partial")) as partial:
        for leftover in partial.parent.glob("*.partial"):  # of a killed run
            shutil.rmtree(leftover, ignore_errors=True)
        model = partial / "pretrained_model"
        model.mkdir(parents=True)
        yield model
        folder = partial / "training_state"
        folder.mkdir(parents=True)
        with (folder / STATE_FILE).open("wb") as file:
            torch.save(state, file)
        (folder / DIGEST_FILE).write_text(f"{sha256(folder / STATE_FILE)}  {STATE_FILE}\n")
        _publish(partial)


def _publish(partial: Path) -> None:
    """Rename NNNNNN.partial and point ``last`` at it."""
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
    with _open_training_state(output_dir) as file:
        return _load(file)


@contextmanager
def _open_training_state(output_dir: Path) -> Iterator[IO[bytes]]:
    """The file of the last training state, whose SHA-256 is the stored one; raises as
    `load_training_state`."""
    path = output_dir / "checkpoints" / "last" / "training_state" / STATE_FILE
    if not os.path.lexists(path):
        raise ArtifactError(
            f"{output_dir}: no checkpoint to resume from (expected "
            f"{path.relative_to(output_dir)}); start without --resume in a new folder"
        )
    try:
        expected = read_text(path.with_name(DIGEST_FILE), 1024).split(" ")[0]
        if sha256(path, _LIMIT_BYTES) != expected:
            raise UnsafeFileError(f"its SHA-256 is not the one in {DIGEST_FILE}; it is damaged")
        with open_regular(path, _LIMIT_BYTES) as file:
            yield file
    except (OSError, UnsafeFileError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ArtifactError(
            f"{path}: cannot be read ({reason}); point {output_dir}/checkpoints/last at an older "
            "checkpoint, or start again"
        ) from error


@contextmanager
def restoring(output_dir: Path) -> Iterator[None]:
    """Around the code that restores a training state.

    Raises:
        ArtifactError: the state does not fit the options.
    """
    try:
        yield
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        if is_full_memory(error):
            raise
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise ArtifactError(
            f"{output_dir}: its checkpoint does not fit the options given, or is of another "
            f"version ({reason}); resume without them, or start a new run"
        ) from error


def _load(file: IO[bytes]) -> dict[str, Any]:
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # the unpickler raises any exception on bytes of another program
        raise UnsafeFileError("not a training state") from error
    if not isinstance(state, dict):
        raise UnsafeFileError("not a training state")
    return state


def pretrained_weights(
    model: WorldModel, path: str, returns: ReturnConfig
) -> dict[str, torch.Tensor]:
    """State of ``model`` with the weights, the normalisation and the discount of a saved policy.

    A policy has no decoder of the object's state; that of ``model`` stays.

    Raises:
        ArtifactError: the policy cannot be loaded.
        UsageError: its networks are not those of ``model``, or its Q has another discount or scale
            than ``returns``.
    """
    own, found = model.state_dict(), load_artifact(path).world_model.state_dict()
    missing = {name for name in own.keys() - found.keys() if not name.startswith("object_head.")}
    differing = missing | (found.keys() - own.keys())
    differing |= {name for name, x in found.items() if name in own and own[name].shape != x.shape}
    if differing:
        raise UsageError(
            f"--policy.pretrained_path={path}: its networks are not those of --policy "
            f"({', '.join(sorted(differing)[:3])}); give the options that it was trained with"
        )
    require_same_returns(found, returns, f"--policy.pretrained_path={path}")
    return own | found
