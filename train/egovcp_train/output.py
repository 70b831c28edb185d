"""Where a run writes; shared by all training commands."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from draccus import cfgparsing

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp_train.checkpoint import load_training_state

CONFIG_FILE = "train_config.yaml"


def resumed_options(argv: Sequence[str]) -> dict[str, Any]:
    """What stands where no flag says otherwise: the options of the run that is resumed.

    Raises:
        UsageError: a config file, which says everything itself, would hide them.
    """
    given = dict(a.removeprefix("--").split("=", 1) for a in argv if "=" in a)
    saved = Path(given.get("output_dir", "")) / CONFIG_FILE
    resume = "--resume" in argv or given.get("resume", "").lower() == "true"
    if resume and "config_path" in given:
        raise UsageError(
            f"--resume goes on with the options that the run has kept in its --output_dir, and "
            f"--config_path={given['config_path']} says others; drop it, and give what is to "
            "change as flags of their own"
        )
    return saved_options(saved.parent) if resume else {}


def saved_options(output: Path) -> dict[str, Any]:
    """The options that the run in a folder has kept; empty if it has kept none."""
    saved = output / CONFIG_FILE
    if not saved.is_file():
        return {}
    options: dict[str, Any] = cfgparsing.load_config(saved.read_text("utf-8"), file=saved)
    return options


def prepare_output(output_dir: str, resume: bool) -> Path:
    """Refuse a bad destination before any work starts.

    Raises:
        ArtefactError: there is nothing to resume.
        UsageError: the folder exists and is not empty.
        EnvironmentFailure: it cannot be written to.
    """
    output = Path(output_dir)
    if resume:
        load_training_state(output)
        return output
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise UsageError(
            f"output folder {output} exists and is not empty; choose another, or continue the run "
            "in it with --resume"
        )
    require_writable(output)
    return output


def require_writable(folder: Path) -> None:
    """Refuse a folder, existing or to be made, that cannot be written to.

    Raises:
        EnvironmentFailure: no permission, no space, or a file in the way.
    """
    parent = next(p for p in [folder, *folder.absolute().parents] if p.exists())
    try:
        with tempfile.TemporaryFile(dir=parent):
            pass
    except OSError as error:
        raise EnvironmentFailure(f"cannot write to {parent}: {error.strerror}") from error
