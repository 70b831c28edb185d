"""`egovcp-dataset SUBCOMMAND [ROOT] [--NAME=VALUE ...]`: inspect, check, repair and share datasets.

The subcommand NAME is the function ``run_NAME`` of a module, which is imported when it is called.
It takes a frozen dataclass of options, whose first field is ``dataset: DatasetConfig``, prints the
result, and raises an `EgovcpError` on failure.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from types import MappingProxyType
from typing import Any, Final, get_type_hints

from egovcp.cli import report_error, run_command
from egovcp.errors import UsageError, suggest
from egovcp.hub import is_local_path
from egovcp.terminal import echo

PROG: Final = "egovcp-dataset"
#: Subcommand -> its module in this package, and its line in the help.
SUBCOMMANDS: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "info": ("info", "print tasks, episodes, hours and provenance"),
        "check": ("check", "read every file and frame; list all problems"),
        "repair": ("rewrite", "write the readable episodes to a new dataset"),
        "merge": ("rewrite", "join datasets of the same controller"),
        "audit": ("audit", "simulate episodes again and compare them bit for bit"),
        "coverage": ("coverage", "report events, returns, actions; assess it for training"),
        "card": ("card", "write its dataset card, README.md, with plots"),
        "viz": ("viz", "show an episode in Rerun: depth, robot, actions, rewards"),
        "push": ("hub", "publish it on the Hub: data, card and tags in one commit"),
        "pull": ("hub", "download one commit from the Hub to a new folder and check it"),
    }
)
_EPILOG: Final = (
    "The dataset may be given without a flag: a folder, or an id of the Hub (user/name) where no "
    "such folder exists."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        echo(_help())
        return 0 if args else UsageError.exit_code
    name = args[0]
    try:
        if name not in SUBCOMMANDS:
            raise UsageError(f"unknown subcommand {name!r}{suggest(name, SUBCOMMANDS)}")
        module = importlib.import_module(f"{__package__}.{SUBCOMMANDS[name][0]}")
        run = getattr(module, f"run_{name}")
        config_class = get_type_hints(run)["config"]
        flags = _flags(args[1:], config_class)
    except UsageError as error:
        return report_error(PROG, error)
    return run_command(config_class, run, flags, prog=f"{PROG} {name}", epilog=_EPILOG)


def _help() -> str:
    width = max(map(len, SUBCOMMANDS))
    return "\n".join(
        [
            f"usage: {PROG} SUBCOMMAND [ROOT] [--NAME=VALUE ...]",
            "",
            "Inspect, check, repair, join and share datasets in LeRobot's format.",
            "",
            *(f"  {name:{width}}  {summary}" for name, (_, summary) in SUBCOMMANDS.items()),
            "",
            "ROOT is the folder of a dataset, or its id on the Hub (user/name).",
            f"`{PROG} SUBCOMMAND --help` lists the options of a subcommand.",
        ]
    )


def _flags(args: Sequence[str], config_class: type[Any]) -> list[str]:
    """Turn positional arguments into ``--dataset.*``, and further ones into ``--others``."""
    hints = get_type_hints(config_class)
    names = [option.name for option in fields(config_class)]
    switches = {"-h", "--help", "--debug", *(f"--{n}" for n in names if hints[n] is bool)}
    flags: list[str] = []
    folders: list[str] = []
    for arg in args:
        needs_value = bool(flags) and "=" not in flags[-1] and flags[-1] not in switches
        if arg.startswith("-"):
            flags.append(arg)
        elif needs_value:
            flags[-1] += f"={arg}"
        else:
            folders.append(arg)
    if len(folders) > 1:
        if "others" not in names:
            raise UsageError(
                f"one dataset is expected, found {len(folders)}: {', '.join(folders)}; write the "
                "value of an option as --name=value"
            )
        flags.insert(0, f"--others={json.dumps(folders[1:])}")
    if folders:
        option = "root" if is_local_path(folders[0]) else "repo_id"
        flags.insert(0, f"--dataset.{option}={folders[0]}")
    return flags


if __name__ == "__main__":
    raise SystemExit(main())
