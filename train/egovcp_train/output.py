"""Where a run writes; shared by all training commands."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from egovcp.errors import ArtifactError, UsageError
from egovcp.flags import read_config
from egovcp.outputs import require_writable
from egovcp.removed_options import RemovedOptionError, refuse_removed_options
from egovcp.values import build
from egovcp_train.checkpoint import load_training_state

CONFIG_FILE = "train_config.yaml"
_LOST = "restore this file, or remove it and give all options of the run as flags"


def resumed_options(config_class: type, argv: Sequence[str]) -> dict[str, Any]:
    """The options of the run that is resumed, which apply where no flag says otherwise.

    Args:
        config_class: of the command.
        argv: its flags, ``--name=value`` each.

    Raises:
        UsageError: a config file is given as well.
        ArtifactError: the run's own file cannot be read, or holds other options.
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
    return saved_options(config_class, saved.parent) if resume else {}


def saved_options(config_class: type, output: Path) -> dict[str, Any]:
    """The options that a run has stored in its folder; empty if it has stored none.

    Raises:
        ArtifactError: they cannot be read, or are not those of ``config_class``.
    """
    saved = output / CONFIG_FILE
    if not os.path.lexists(saved):
        return {}
    try:
        options = read_config(saved)
        refuse_removed_options(options, str(saved))
        build(config_class, options, "--")
    except OSError as error:
        raise ArtifactError(f"{saved}: cannot be read: {error.strerror}; {_LOST}") from error
    except RemovedOptionError as error:
        raise ArtifactError(
            f"{error}; a run of an older version cannot go on: start a new one"
        ) from error
    except (UsageError, ValueError) as error:
        raise ArtifactError(f"{saved}: {error}; {_LOST}") from error
    return options


def prepare_output(output_dir: str, resume: bool, resumable: bool = True) -> Path:
    """Refuse a bad destination before any work starts.

    Args:
        output_dir: the folder, which need not exist.
        resume: go on with the run in it.
        resumable: whether the command has the option ``--resume``.

    Raises:
        ArtifactError: there is nothing to resume.
        UsageError: the folder exists and is not empty.
        EnvironmentFailure: it cannot be written to.
    """
    output = Path(output_dir)
    if resume:
        load_training_state(output)
        return output
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        remedy = "choose another" + (
            ", or continue the run in it with --resume" if resumable else ""
        )
        raise UsageError(f"output folder {output} exists and is not empty; {remedy}")
    require_writable(output)
    return output
