"""Every console command with its options, found from the installed entry points."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any, get_type_hints
from unittest import mock


@dataclass(frozen=True)
class ListedCommand:
    """A command, or one subcommand of it."""

    prog: str
    main: Callable[[Sequence[str]], int]
    arguments: tuple[str, ...]
    """The name of the subcommand, if it is one."""
    config_class: type[Any]
    defaults: Callable[[Sequence[str]], Mapping[str, Any]] | None


@dataclass(frozen=True)
class Option:
    """An option of a dataclass, which may be a group of several commands."""

    config_class: type[Any]
    name: str
    kind: Any

    def __str__(self) -> str:
        return f"{self.config_class.__name__}.{self.name}"


class _ParsedError(Exception):
    """Instead of parsing."""


@cache
def all_commands() -> tuple[ListedCommand, ...]:
    """Every command; of the experiments, which have the same options, the first."""
    return tuple(_commands())


def _commands() -> Iterator[ListedCommand]:
    for entry in metadata.entry_points(group="console_scripts"):
        if not entry.name.startswith("egovcp-"):
            continue
        module = importlib.import_module(entry.load().module)
        group = getattr(module, "COMMANDS", None)
        names = [""] if group is None else list(group.subcommands)
        for name in names[:1] if entry.name == "egovcp-experiment" else names:
            arguments = (name,) if name else ()
            with mock.patch("egovcp.cli.parse_config", side_effect=_ParsedError) as parse:
                try:
                    module.main(list(arguments))
                except _ParsedError:
                    config_class, _, prog, _, defaults = parse.call_args.args
                    yield ListedCommand(prog, module.main, arguments, config_class, defaults)


def options_of(config_class: type[Any], prefix: str = "--") -> Iterator[tuple[str, Option]]:
    """Flag -> option, of a dataclass and those within it; groups are left out."""
    kinds = get_type_hints(config_class)
    for field in dataclasses.fields(config_class):
        flag, kind = f"{prefix}{field.name}", kinds[field.name]
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from options_of(kind, f"{flag}.")
        else:
            yield flag, Option(config_class, field.name, kind)


def all_options() -> dict[str, Option]:
    """Every option of every command, once each although several commands have it."""
    found = (option for command in all_commands() for _, option in options_of(command.config_class))
    return {str(option): option for option in found}


def required_flags(config_class: type[Any]) -> list[str]:
    """A value for each option that has no default."""
    return [
        f"--{field.name}=x"
        for field in dataclasses.fields(config_class)
        if field.default is field.default_factory is dataclasses.MISSING
    ]
