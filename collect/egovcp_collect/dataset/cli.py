"""`egovcp-dataset SUBCOMMAND [ROOT] [--NAME=VALUE ...]`: work with a finished dataset.

A subcommand is a module with

    CONFIG          frozen dataclass of its options; `dataset: DatasetConfig` comes first
    run(config)     does the work, prints the result, raises an `EgovcpError` on failure
    MORE            optional: the list option that takes the folders after the first

and one line in `SUBCOMMANDS`. It is imported only when it is asked for.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Final, get_type_hints

from egovcp.cli import report_error, run_command
from egovcp.errors import UsageError, suggest
from egovcp.hub import is_local_path
from egovcp.terminal import echo

PROG: Final = "egovcp-dataset"


@dataclass(frozen=True)
class Subcommand:
    """Where a subcommand lives, and what `egovcp-dataset --help` says of it."""

    module: str
    summary: str


SUBCOMMANDS: Final[Mapping[str, Subcommand]] = MappingProxyType(
    {
        "info": Subcommand(
            "egovcp_collect.dataset.info", "what is in it: tasks, episodes, hours, provenance"
        ),
        "check": Subcommand(
            "egovcp_collect.dataset.check", "read every file and frame; name whatever is wrong"
        ),
        "repair": Subcommand(
            "egovcp_collect.dataset.repair", "write a sound copy of whatever can still be read"
        ),
        "merge": Subcommand(
            "egovcp_collect.dataset.merge", "one dataset out of several of the same controller"
        ),
        "audit": Subcommand(
            "egovcp_collect.dataset.audit",
            "simulate episodes again: are they the same bit for bit?",
        ),
        "coverage": Subcommand(
            "egovcp_collect.dataset.coverage", "is it worth training on? events, returns, actions"
        ),
        "card": Subcommand(
            "egovcp_collect.dataset.card", "write its dataset card, README.md, with pictures"
        ),
        "viz": Subcommand(
            "egovcp_collect.dataset.viz", "an episode in Rerun: depth, robot, actions, rewards"
        ),
        "push": Subcommand(
            "egovcp_collect.dataset.push",
            "publish it on the Hub: data, card and tags in one commit",
        ),
        "pull": Subcommand(
            "egovcp_collect.dataset.pull", "download one commit of the Hub to a new folder, checked"
        ),
    }
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        echo(_help())
        return 0 if args else UsageError.exit_code
    try:
        name = _known(args[0])
        module = importlib.import_module(SUBCOMMANDS[name].module)
        flags = _flags(args[1:], module)
    except UsageError as error:
        return report_error(PROG, error)
    return run_command(module.CONFIG, module.run, flags, prog=f"{PROG} {name}", epilog=_EPILOG)


_EPILOG = (
    "The dataset may be given without a flag, before the options: a folder, or an id of the Hub "
    "(user/name) where no such folder exists."
)


def _help() -> str:
    width = max(map(len, SUBCOMMANDS))
    lines = [f"  {name:{width}}  {entry.summary}" for name, entry in SUBCOMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROG} SUBCOMMAND [ROOT] [--NAME=VALUE ...]",
            "",
            "Look at, check, mend, join and share datasets in LeRobot's format.",
            "",
            *lines,
            "",
            "ROOT is the folder of a dataset, or its id on the Hub (user/name).",
            f"`{PROG} SUBCOMMAND --help` explains the options of one.",
        ]
    )


def _known(name: str) -> str:
    if name not in SUBCOMMANDS:
        raise UsageError(f"unknown subcommand {name!r}{suggest(name, SUBCOMMANDS)}")
    return name


def _flags(args: Sequence[str], module: Any) -> list[str]:
    """The arguments with those that have no flag turned into ``--dataset.root=`` or the like."""
    switches = {"-h", "--help", "--debug", *_switches(module.CONFIG)}
    flags: list[str] = []
    folders: list[str] = []
    for arg in args:
        pending = bool(flags) and "=" not in flags[-1] and flags[-1] not in switches
        if arg.startswith("-"):
            flags.append(arg)
        elif pending:
            flags[-1] += f"={arg}"
        else:
            folders.append(arg)
    more = getattr(module, "MORE", "")
    if len(folders) > 1 and not more:
        raise UsageError(
            f"one dataset is expected, found {len(folders)}: {', '.join(folders)}; write the "
            "value of an option as --name=value"
        )
    first = [_dataset_flag(folder) for folder in folders[:1]]
    rest = [f"--{more}={json.dumps(folders[1:])}"] if folders[1:] else []
    return [*first, *rest, *flags]


def _switches(config_class: type[Any]) -> set[str]:
    """Options that need no value, and so take no argument that follows them."""
    hints = get_type_hints(config_class)
    return {f"--{field.name}" for field in fields(config_class) if hints[field.name] is bool}


def _dataset_flag(argument: str) -> str:
    option = "root" if is_local_path(argument) else "repo_id"
    return f"--dataset.{option}={argument}"


if __name__ == "__main__":
    raise SystemExit(main())
