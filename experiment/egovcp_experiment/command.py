"""`egovcp-experiment NAME --output_dir=... [--NAME=VALUE ...]`: run one of the experiments."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import draccus

from egovcp.artifact import load_artifact
from egovcp.cli import report_error, run_command
from egovcp.data import DatasetConfig, DatasetReader
from egovcp.errors import EgovcpError, UsageError, suggest
from egovcp.hub import is_local_path
from egovcp.packages import require_packages
from egovcp.terminal import echo
from egovcp_experiment.cell import Cell, in_order
from egovcp_experiment.config import SCALES, ExperimentConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.local_runner import LocalRunner
from egovcp_experiment.ray_runner import RayRunner
from egovcp_experiment.report import publish
from egovcp_experiment.scheduler import CellScheduler
from egovcp_experiment.store import CellStore

PROG: Final = "egovcp-experiment"
_EPILOG: Final = (
    "Writes NAME.json, NAME.md and NAME.html beside cells/ (results), work/ (datasets, models) and "
    "logs/. Ctrl-C stops all cells cleanly; the same command goes on."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        echo(_help())
        return 0 if args else UsageError.exit_code
    name, *flags = args
    if name not in EXPERIMENTS:
        unknown = f"unknown experiment {name!r}{suggest(name, EXPERIMENTS)}"
        return report_error(PROG, UsageError(unknown))
    run = partial(execute, name=name, command=shlex.join([PROG, *args]))
    prog = f"{PROG} {name}"
    return run_command(ExperimentConfig, run, flags, prog=prog, epilog=_EPILOG, defaults=scale_of)


def scale_of(argv: Sequence[str]) -> Mapping[str, Any]:
    """Defaults of all options: the configuration of the scale in ``argv``.

    Raises:
        UsageError: the scale is unknown, or a config file would override it.
    """
    given = dict(a.removeprefix("--").split("=", 1) for a in argv if "=" in a)
    if "config_path" in given:
        raise UsageError("--config_path would hide the scale; give single options as flags")
    name = given.get("scale", ExperimentConfig().scale)
    known = {str(scale): make for scale, make in SCALES.items()}
    if name not in known:
        raise UsageError(f"unknown value --scale={name}{suggest(name, known)}")
    encoded: dict[str, Any] = draccus.encode(known[name]())
    return encoded


def execute(config: ExperimentConfig, name: str, command: str) -> None:
    """Run the missing cells and write the report, also after an interruption.

    Raises:
        UsageError: an option is invalid, or results of other settings are stored.
        EnvironmentFailure: a package is missing, cells failed, or the folder cannot be used.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.check()
    require_given(config)
    experiment = EXPERIMENTS[name]
    cells = in_order(experiment.cells(config))
    store = CellStore(Path(config.output_dir))
    with store.locked(), closing(_runner(config)) as runner:
        scheduler = CellScheduler(cells, store, config.jobs, echo, runner)
        records = scheduler.records
        if config.backend == "local":
            _require_packages([cell for cell in cells if cell.name not in records])
        echo(f"{PROG} {name}: {len(cells)} cells, {len(records)} complete")
        try:
            scheduler.run()
        finally:
            complete = {c.name: records[c.name] for c in cells if c.name in records}
            missing = [cell.name for cell in cells if cell.name not in records]
            report = experiment.report(config, complete)
            encoded = draccus.encode(config)
            publish(store.folder, name, report, complete, missing, encoded, command)
    for line in report.shows:
        echo(f"- {line}")
    echo(f"report: {store.folder / name}.html, .md, .json")


def require_given(config: ExperimentConfig) -> None:
    """Refuse unusable `data.roots` and `train.policies` before any cell runs.

    Policies on the Hub are checked by their cells.

    Raises:
        UsageError: a folder is not named.
        DataError: a dataset is missing or damaged.
        ArtifactError: a policy is missing or damaged.
    """
    for task, root in config.data.roots.items():
        with _naming(f"--data.roots: {task}"):
            if not root:
                raise UsageError("expected the folder of a dataset")
            DatasetReader.open(DatasetConfig(root=root))
    for task, path in config.train.policies.items():
        with _naming(f"--train.policies: {task}"):
            if is_local_path(path):
                load_artifact(path)


@contextmanager
def _naming(option: str) -> Iterator[None]:
    """Prefix errors with the option."""
    try:
        yield
    except EgovcpError as error:
        raise type(error)(f"{option}: {error}") from error


def _require_packages(cells: Sequence[Cell]) -> None:
    """Raise `EnvironmentFailure` if a command lacks an optional package."""
    for command in dict.fromkeys(cell.command for cell in cells):
        require_packages("egovcp-experiment", command.shell_name, *command.packages)


def _runner(config: ExperimentConfig) -> RayRunner | LocalRunner:
    return RayRunner(config.ray, echo) if config.backend == "ray" else LocalRunner(config.jobs)


def _help() -> str:
    width = max(map(len, EXPERIMENTS))
    listed = "\n".join(f"  {name:{width}}  {e.SUMMARY}" for name, e in EXPERIMENTS.items())
    return (
        f"usage: {PROG} NAME --output_dir=... [--scale=smoke|small|paper] [--NAME=VALUE ...]\n\n"
        f"Run one of the paper's experiments, cell by cell, and write its report.\n\n{listed}\n\n"
        f"`{PROG} NAME --help` explains the options."
    )


if __name__ == "__main__":
    sys.exit(main())
