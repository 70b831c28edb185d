"""`egovcp-mcap`: inspect recorded runs, recover torn ones, convert them to datasets and back."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from egovcp.cli import report_error, run_command
from egovcp.errors import UsageError, suggest
from egovcp.terminal import echo

PROG: Final = "egovcp-mcap"


@dataclass(frozen=True)
class McapSubcommand:
    """One subcommand: its module with ``CONFIG`` and ``run``, and its help."""

    module: str
    usage: str
    summary: str
    names: tuple[str, ...] = ()
    """Options that arguments without a flag stand for, in order."""
    many: str = ""
    """The list option that takes all arguments without a flag; empty: none."""


SUBCOMMANDS: Final[Mapping[str, McapSubcommand]] = MappingProxyType(
    {
        "info": McapSubcommand(
            "egovcp_deploy.mcap.info",
            "info FILE",
            "its content: run, ticks, rates, topics, gaps; complete or torn",
            ("file",),
        ),
        "recover": McapSubcommand(
            "egovcp_deploy.mcap.recover",
            "recover TORN OUT",
            "copy every complete tick of a torn file to a new one with an index",
            ("file", "output"),
        ),
        "to-dataset": McapSubcommand(
            "egovcp_deploy.mcap.to_dataset",
            "to-dataset FILE... --dataset.root=ROOT",
            "convert rollouts to episodes of a new LeRobot dataset for training",
            many="files",
        ),
        "from-dataset": McapSubcommand(
            "egovcp_deploy.mcap.from_dataset",
            "from-dataset ROOT OUT --episode=N",
            "convert an episode of a dataset to a recording",
            ("dataset.root", "output"),
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
        if args[0] not in SUBCOMMANDS:
            raise UsageError(f"unknown subcommand {args[0]!r}{suggest(args[0], SUBCOMMANDS)}")
        entry = SUBCOMMANDS[args[0]]
        flags = _flags(args[1:], entry)
    except UsageError as error:
        return report_error(PROG, error)
    module: Any = importlib.import_module(entry.module)
    return run_command(module.CONFIG, module.run, flags, prog=f"{PROG} {args[0]}")


def _help() -> str:
    width = max(len(entry.usage) for entry in SUBCOMMANDS.values())
    lines = [f"  {entry.usage:{width}}  {entry.summary}" for entry in SUBCOMMANDS.values()]
    return "\n".join(
        [
            f"usage: {PROG} SUBCOMMAND [FILES] [--NAME=VALUE ...]",
            "",
            "Inspect recorded runs (MCAP), recover torn ones, convert them to datasets and back.",
            "",
            *lines,
            "",
            f"`{PROG} SUBCOMMAND --help` lists the options of one.",
        ]
    )


def _flags(args: Sequence[str], entry: McapSubcommand) -> list[str]:
    """Turn the arguments without a flag into flags."""
    flags = [arg for arg in args if arg.startswith("-")]
    places = [arg for arg in args if not arg.startswith("-")]
    if entry.many:
        return [*([f"--{entry.many}={json.dumps(places)}"] if places else []), *flags]
    if len(places) > len(entry.names):
        raise UsageError(
            f"unexpected argument {places[len(entry.names)]!r}; expected {PROG} {entry.usage}; "
            "the value of an option is written --name=value"
        )
    named = zip(entry.names, places, strict=False)
    return [*(f"--{name}={place}" for name, place in named), *flags]


if __name__ == "__main__":
    raise SystemExit(main())
