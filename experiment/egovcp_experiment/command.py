"""`egovcp-experiment EXPERIMENT --output_dir=... [--NAME=VALUE ...]`: run an experiment."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Final

import draccus

from egovcp.artifact import load_artifact, shipped_policies
from egovcp.cli import parse_config, preset_defaults
from egovcp.data import DatasetConfig, DatasetReader
from egovcp.errors import EgovcpError, UsageError
from egovcp.files import user_path
from egovcp.packages import is_installed, require_packages
from egovcp.subcommands import CommandGroup, Subcommand
from egovcp.terminal import echo
from egovcp_experiment.cell import COLLECT, PLAY, TRAIN, TRAIN_PPO, CellCommand
from egovcp_experiment.config import SCALES, ExperimentConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.report import ExperimentReport, publish
from egovcp_experiment.scheduler import CellScheduler
from egovcp_experiment.store import CellStore

#: Option of `ExperimentConfig.command_flags` -> the command that gets its flags.
_COMMANDS: Final[Mapping[str, CellCommand]] = {
    "scenes": COLLECT,
    "data.flags": COLLECT,
    "train.flags": TRAIN,
    "play.flags": PLAY,
    "ppo.flags": TRAIN_PPO,
}


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
    require_flags(config)
    given = with_local_policies(config)
    prog, name = argv[:2]
    experiment = EXPERIMENTS[name]
    cells = experiment.cells(given)
    store = CellStore(user_path(config.output_dir))
    with store.locked():
        scheduler = CellScheduler(cells, store, config.jobs, echo)
        records = scheduler.records
        commands = dict.fromkeys(c.command for c in cells if c.name not in records)
        for command in commands:
            require_packages("egovcp-train", command.prog, *command.packages)
        echo(f"{prog} {name}: {len(cells)} cells, {len(records)} complete; {scheduler.outlook}")

        def write_report() -> ExperimentReport:
            complete = {c.name: records[c.name] for c in cells if c.name in records}
            missing = [cell.name for cell in cells if cell.name not in records]
            report = experiment.report(given, complete)
            encoded = draccus.encode(config)
            publish(store.folder, name, report, complete, missing, encoded, shlex.join(argv))
            return report

        written = f"report: {store.folder / name}.html, .md, .json"
        try:
            scheduler.run()
        except BaseException:
            try:
                write_report()
                echo(written)
            except Exception as error:  # noqa: BLE001 - the cause of the end is raised
                echo(f"warning: the report could not be written: {error!r}", error=True)
            raise
        report = write_report()
    for line in (*report.lead, *report.findings):
        echo(f"- {line}")
    echo(written)


def with_local_policies(config: ExperimentConfig) -> ExperimentConfig:
    """Refuse unusable `data.roots` and `train.policies` before any cell runs; policies become
    folders, those on the Hub of a download, so that all cells use the same commit. Shipped ones
    keep their names.

    Raises:
        UsageError: a folder is not named, or a dataset is of another task or robot.
        DataError: a dataset is missing or damaged.
        ArtifactError: a policy is missing or damaged.
        EnvironmentFailure: the Hub cannot be reached.
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
    policies = {}
    for task, path in config.train.policies.items():
        with _naming(f"--train.policies: {task}"):
            folder = load_artifact(path).path
            policies[task] = path if path in shipped_policies() else str(folder)
    return replace(config, train=replace(config.train, policies=policies))


def require_flags(config: ExperimentConfig) -> None:
    """Refuse unusable flags for the commands of cells before any cell runs; those of a command
    that is not installed are not checked.

    Raises:
        UsageError: a flag is unknown, or its value is invalid.
    """
    for option, flags in config.command_flags.items():
        command = _COMMANDS[option]
        if flags and all(map(is_installed, command.packages)):
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
