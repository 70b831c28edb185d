"""Commands with subcommands, such as ``egovcp-dataset check ROOT --max_problems=3``.

    COMMANDS = CommandGroup(
        "egovcp-dataset",
        "Inspect and share datasets.",
        {"check": Subcommand("egovcp_collect.dataset.check:run_check", "find problems")},
    )
    main = COMMANDS.main

Options, help, errors and exit codes of a subcommand are those of `egovcp.cli.run_command`.
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, get_type_hints

from egovcp.cli import Defaults, report_error, run_command
from egovcp.errors import UsageError, suggest
from egovcp.flags import HELP, flags_of
from egovcp.help_text import ALL, FLAGS, help_text
from egovcp.terminal import echo


@dataclass(frozen=True)
class Subcommand:
    """A function of a module that is imported when the subcommand is called."""

    function: str
    """``module:function``; its parameter ``config`` is a dataclass of options."""
    summary: str
    """Its line in the help."""
    arguments: tuple[str, ...] = ()
    """Options that arguments without a flag stand for, in order. ``dataset`` stands for
    ``dataset.root`` or ``dataset.repo_id``."""
    more: str = ""
    """The list option that takes further arguments without a flag; empty: none."""
    defaults: Defaults | None = None
    """See `egovcp.cli.parse_config`."""
    takes_argv: bool = False
    """Whether the function has a second parameter for the command line, ``[prog, name, ...]``."""

    def load(self) -> tuple[Callable[..., object], type[Any]]:
        """The function and its dataclass of options."""
        module, _, name = self.function.partition(":")
        function = getattr(import_module(module), name)
        return function, get_type_hints(function)["config"]


@dataclass(frozen=True)
class CommandGroup:
    """A command that consists of subcommands."""

    prog: str
    summary: str
    """One sentence."""
    subcommands: Mapping[str, Subcommand]
    epilog: str = ""
    """End of the help of the command and of each subcommand."""
    noun: str = "subcommand"

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run a subcommand and return its exit code."""
        args = list(sys.argv[1:] if argv is None else argv)
        name, rest = (args[0], args[1:]) if args else ("", [])
        help_flag, _, topic = name.partition("=")
        if not name or (help_flag in HELP and topic in ("", ALL, FLAGS)):
            echo(self._help(topic))
            return 0 if name else UsageError.exit_code
        try:
            if name not in self.subcommands:
                known = suggest(name, self.subcommands)
                raise UsageError(f"unknown {self.noun} {name!r}{known}")
            entry = self.subcommands[name]
            function, config_class = entry.load()
            flags = self._flags(name, rest, config_class)
        except UsageError as error:
            return report_error(self.prog, error)
        run = partial(function, argv=[self.prog, *args]) if entry.takes_argv else function
        return run_command(
            config_class,
            run,
            flags,
            prog=f"{self.prog} {name}",
            epilog=self.epilog,
            defaults=entry.defaults,
        )

    def _help(self, topic: str) -> str:
        """The subcommands; for `ALL` also every option of each; for `FLAGS` only their flags."""
        configs = {n: entry.load()[1] for n, entry in self.subcommands.items() if topic}
        if topic == FLAGS:
            texts = {name: help_text(c, topic=topic) for name, c in configs.items()}
            return "\n".join(
                f"{n} {line}" for n, text in texts.items() for line in text.split("\n")
            )
        rows = {self._usage(name): entry.summary for name, entry in self.subcommands.items()}
        width = max(map(len, rows))
        lines = [
            f"usage: {self.prog} {self.noun.upper()} ... [--NAME=VALUE ...]",
            f"\n{self.summary}\n",
            *(f"  {usage:{width}}  {summary}" for usage, summary in rows.items()),
            "",
            *textwrap.wrap(self.epilog, 110),
            f"`{self.prog} {self.noun.upper()} --help` explains the options of one.",
        ]
        for config_class in dict.fromkeys(configs.values()):
            names = [name for name, other in configs.items() if other is config_class]
            lines += ["", f"{self.prog} {', '.join(names)}", help_text(config_class, topic=topic)]
        return "\n".join(lines)

    def _usage(self, name: str) -> str:
        entry = self.subcommands[name]
        words = [option.upper() for option in entry.arguments]
        return " ".join([name, *words, *([f"{entry.more.upper()}..."] if entry.more else [])])

    def _flags(self, name: str, args: Sequence[str], config_class: type[Any]) -> list[str]:
        """The arguments with a flag for each one that has none."""
        entry, flags, places = self.subcommands[name], list[str](), list[str]()
        switches = {flag for flag, kind in flags_of(config_class).items() if kind is bool}
        switches |= {"--debug", *HELP}
        for arg in args:
            takes_value = flags and "=" not in flags[-1] and flags[-1] not in switches
            if takes_value and not arg.startswith("--"):
                flags[-1] += f"={arg}"
            elif arg.startswith("-"):
                flags.append(arg)
            else:
                places.append(arg)
        named = [
            f"--{_option(option, place)}={place}"
            for option, place in zip(entry.arguments, places, strict=False)
        ]
        further = places[len(entry.arguments) :]
        if further and not entry.more:
            raise UsageError(
                f"unexpected argument {further[0]!r}; usage: {self.prog} {self._usage(name)} "
                "[--NAME=VALUE ...]"
            )
        return [*named, *([f"--{entry.more}={json.dumps(further)}"] if further else []), *flags]


def _option(name: str, value: str) -> str:
    """The option that an argument stands for."""
    if name != "dataset":
        return name
    from egovcp.hub import is_local_path  # a slow import

    return "dataset.root" if is_local_path(value) else "dataset.repo_id"
