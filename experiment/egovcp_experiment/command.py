"""`egovcp-experiment EXPERIMENT --output_dir=... [--NAME=VALUE ...]`: run an experiment."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Final

import draccus

from egovcp.artifact import load_artifact
from egovcp.cli import parse_config, preset_defaults
from egovcp.data import DatasetConfig, DatasetReader
from egovcp.errors import EgovcpError, UsageError
from egovcp.files import user_path
from egovcp.hub import is_local_path
from egovcp.packages import require_packages
from egovcp.subcommands import CommandGroup, Subcommand
from egovcp.terminal import echo
from egovcp_experiment.cell import COLLECT, PLAY, TRAIN, TRAIN_PPO, CellCommand
from egovcp_experiment.config import SCALES, ExperimentConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.report import publish
from egovcp_experiment.scheduler import CellScheduler
from egovcp_experiment.store import CellStore


def execute(config: ExperimentConfig, argv: Sequence[str]) -> None:
    """Run the missing cells and write the report, also after an interruption.

    Args:
        argv: the command line, with the name of the experiment as its second item.

    Raises:
        UsageError: an option is invalid, or results of other settings are stored.
        EnvironmentFailure: a package is missing, cells failed, or the folder cannot be used.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.check()
    require_given(config)
    prog, name = argv[:2]
    experiment = EXPERIMENTS[name]
    cells = experiment.cells(config)
    store = CellStore(user_path(config.output_dir))
    with store.locked():
        scheduler = CellScheduler(cells, store, config.jobs, echo)
        records = scheduler.records
        commands = dict.fromkeys(c.command for c in cells if c.name not in records)
        for command in commands:
            require_packages("egovcp-train", command.prog, *command.packages)
        require_flags(config, commands)
        echo(f"{prog} {name}: {len(cells)} cells, {len(records)} complete; {scheduler.outlook}")
        try:
            scheduler.run()
        finally:
            complete = {c.name: records[c.name] for c in cells if c.name in records}
            missing = [cell.name for cell in cells if cell.name not in records]
            report = experiment.report(config, complete)
            encoded = draccus.encode(config)
            publish(store.folder, name, report, complete, missing, encoded, shlex.join(argv))
    for line in (*report.lead, *report.findings):
        echo(f"- {line}")
    echo(f"report: {store.folder / name}.html, .md, .json")


def require_given(config: ExperimentConfig) -> None:
    """Refuse unusable `data.roots` and `train.policies` before any cell runs.

    Policies on the Hub are checked by their cells.

    Raises:
        UsageError: a folder is not named, or a dataset is of another task or robot.
        DataError: a dataset is missing or damaged.
        ArtifactError: a policy is missing or damaged.
    """
    for task, root in config.data.roots.items():
        with _naming(f"--data.roots: {task}"):
            if not root:
                raise UsageError("expected the folder of a dataset")
            reader = DatasetReader.open(DatasetConfig(root=root))
            tasks = sorted({reader.task(index) for index in range(len(reader))})
            if not reader.robot.is_g1 or tasks != [task]:
                raise UsageError(
                    f"{root} holds {', '.join(tasks)} of robot {reader.robot.robot_type}; expected "
                    f"{task} of the G1"
                )
    for task, path in config.train.policies.items():
        with _naming(f"--train.policies: {task}"):
            if is_local_path(path):
                load_artifact(path)


def require_flags(config: ExperimentConfig, commands: Collection[CellCommand]) -> None:
    """Refuse unusable flags for the commands of cells before any cell runs.

    Raises:
        UsageError: a flag is unknown, or its value is invalid.
    """
    for option, command, flags in (
        ("scenes", COLLECT, config.scenes),
        ("data.flags", COLLECT, config.data.flags),
        ("train.flags", TRAIN, config.train.flags),
        ("play.flags", PLAY, config.play.flags),
        ("ppo.flags", TRAIN_PPO, config.ppo.flags),
    ):
        if flags and command in commands:
            module, _, name = command.options.partition(":")
            argv = [f"--{command.output}=FOLDER", *flags]
            with _naming(f"--{option}"):
                parse_config(getattr(import_module(module), name), argv, command.prog)


@contextmanager
def _naming(option: str) -> Iterator[None]:
    """Prefix errors with the option."""
    try:
        yield
    except EgovcpError as error:
        error.args = (f"{option}: {error}",)
        raise


COMMANDS: Final = CommandGroup(
    "egovcp-experiment",
    "Run one of the paper's experiments, cell by cell, and write its report.",
    {
        name: Subcommand(
            f"{__name__}:execute",
            experiment.summary,
            defaults=partial(preset_defaults, SCALES, option="scale"),
            takes_argv=True,
        )
        for name, experiment in EXPERIMENTS.items()
    },
    "--output_dir is required; --scale sets the defaults of all other options. "
    "Writes EXPERIMENT.json, .md and .html beside cells/ (results), work/ (datasets, models) and "
    "logs/. Ctrl-C stops all cells cleanly; rerun the same command to continue.",
    noun="experiment",
)
main = COMMANDS.main
