"""``--help`` of a command: every option with its type, its bounds and its default."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final

from egovcp.bounds import as_flag_value, bounds_of
from egovcp.flags import CONFIG_FILE
from egovcp.terminal import echo
from egovcp.values import default_of, is_dataclass_type, option_types, type_name

_SYNTAX: Final = (
    "A list is written [a, b] or (a, b), a group of options {name: value}; quote both for the "
    "shell. A switch alone is true."
)


def print_help(config_class: type, prog: str, epilog: str) -> None:
    """Print the help and end the process.

    Raises:
        SystemExit: always.
    """
    parser = argparse.ArgumentParser(
        prog,
        f"{prog} [--NAME=VALUE ...]",
        description=_first_paragraph(config_class),
        epilog=f"{_SYNTAX} {epilog}",
        formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=44, width=110),
    )
    config_file = "Read options from this YAML, JSON or TOML file; flags override them."
    parser.add_argument(CONFIG_FILE, metavar="text", help=config_file)
    _add_options(parser, parser, config_class, None, "--")
    echo(parser.format_help(), end="")
    raise SystemExit(0)


def _add_options(
    parser: argparse.ArgumentParser, group: Any, config_class: Any, config: Any, prefix: str
) -> None:
    """Add the options of a dataclass to its group, and those of the dataclasses within it.

    Args:
        config: an instance that has the defaults; None: those of the class.
    """
    kinds, documents = option_types(config_class), dict(_documents(config_class))
    nested: list[tuple[str, Any, Any]] = []
    for field in dataclasses.fields(config_class):
        flag, kind = f"{prefix}{field.name}", kinds[field.name]
        default = default_of(field) if config is None else getattr(config, field.name)
        if is_dataclass_type(kind):
            nested.append((flag, kind, default))
            continue
        words = [documents.get(field.name, "")]
        if bounds := str(bounds_of(field) or ""):
            words.append(f"[{bounds}]")
        if default is dataclasses.MISSING:
            words.append("(required)")
        elif default != "":
            words.append(f"(default: {as_flag_value(default)})")
        group.add_argument(flag, metavar=type_name(kind), help=_escaped(" ".join(words)))
    for flag, kind, default in nested:
        inner = parser.add_argument_group(flag.removeprefix("--"), _first_paragraph(kind))
        several = f"Several of the options {flag}.NAME at once."
        inner.add_argument(flag, metavar=type_name(kind), help=several)
        default = default if isinstance(default, kind) else None
        _add_options(parser, inner, kind, default, f"{flag}.")


def _documents(config_class: type) -> Iterator[tuple[str, str]]:
    """(option, the string literal below it) of a dataclass and those it inherits from."""
    for base in reversed(config_class.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(tree, ast.ClassDef)
        for option, below in pairwise(tree.body):
            match option, below:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    yield name, " ".join(text.split())


def _first_paragraph(config_class: type) -> str:
    text = inspect.cleandoc(config_class.__doc__ or "").split("\n\n")[0]
    return " ".join(text.split())


def _escaped(text: str) -> str:
    """`argparse` formats help texts with the ``%`` operator."""
    return text.replace("%", "%%")
