"""``--help`` of a command: its options in groups, with types, bounds and defaults.

``--help`` shows the options outside groups and those of small groups, each with its first sentence
and "..." if there are more, and lists the other groups. ``--help=GROUP`` shows one group in full,
``--help=all`` every option, and ``--help=flags`` one line per flag with the values to choose from,
for shell completion.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

from egovcp.bounds import as_flag_value, bounds_of
from egovcp.errors import UsageError, did_you_mean
from egovcp.flags import CONFIG_FILE, flags_of
from egovcp.values import choices, default_of, is_dataclass_type, option_types, type_name

ALL: Final = "all"
FLAGS: Final = "flags"
_WIDTH: Final = 110
_COLUMN: Final = 40  # where descriptions start
_SMALL_GROUP: Final = 4
_SYNTAX: Final = (
    "Lists: [a, b] or (a, b). Groups: {name: value}. Quote both for the shell. --debug prints the "
    "traceback of an error, --version the version. '...': shortened, see --help=all."
)


@dataclass(frozen=True)
class _Option:
    flag: str
    kind: str
    text: str
    default: Any
    bounds: str = ""

    def row(self, full: bool) -> tuple[str, str]:
        """Flag with type, and description; only the first sentence unless ``full``."""
        words = [self.text if full else _first_sentence(self.text)]
        if self.bounds and full:
            words.append(f"[{self.bounds}]")
        if self.default is dataclasses.MISSING:
            words.append("(required)")
        elif self.default not in ("", None, (), []):
            words.append(f"(default: {as_flag_value(self.default)})")
        return f"{self.flag} {self.kind}", " ".join(words)


@dataclass(frozen=True)
class _Group:
    name: str
    """Such as ``policy.loss``; empty: the options outside groups."""
    summary: str
    options: tuple[_Option, ...]

    @property
    def is_short(self) -> bool:
        return not self.name or ("." not in self.name and len(self.options) <= _SMALL_GROUP)


def help_text(
    config_class: type,
    prog: str = "",
    epilog: str = "",
    topic: str = "",
    defaults: Mapping[str, Any] | None = None,
) -> str:
    """The help of a command.

    Args:
        topic: a group such as ``policy.loss``, `ALL`, `FLAGS`, or empty for the overview.
        defaults: nested values that replace defaults of the class.

    Raises:
        UsageError: there is no such group.
    """
    flags = flags_of(config_class)
    if topic == FLAGS:
        kinds = {flag: kind for flag, kind in flags.items() if not is_dataclass_type(kind)}
        return "\n".join(" ".join([flag, *choices(kind)]) for flag, kind in kinds.items())
    groups = [
        dataclasses.replace(group, options=tuple(o for o in group.options if o.flag in flags))
        for group in _groups(config_class, defaults or {}, "")
        if not group.name or f"--{group.name}" in flags
    ]
    if not topic:
        lines = [f"{prog}: {_first_paragraph(config_class)}", *_overview(groups), ""]
        return "\n".join(lines + textwrap.wrap(f"{_SYNTAX} {epilog}".strip(), _WIDTH))
    names = {group.name.partition(".")[0] for group in groups} | {g.name for g in groups}
    if topic != ALL and topic not in names - {""}:
        near = did_you_mean(topic, names - {""})
        raise UsageError(f"--help={topic}: no such group{near}; --help lists the groups")
    shown = [g for g in groups if topic == ALL or f"{g.name}.".startswith(f"{topic}.")]
    return "\n".join([line for group in shown for line in _section(group, full=True)][1:])


def _overview(groups: Sequence[_Group]) -> Iterator[str]:
    for group in groups:
        if group.is_short:
            yield from _section(group, full=False)
    rows, shown = [], {group.name for group in groups if group.is_short}
    for group in groups:
        inner = [g for g in groups if f"{g.name}.".startswith(f"{group.name}.")]
        hidden = sum(len(g.options) for g in inner)
        if hidden and not group.is_short and group.name.rpartition(".")[0] in shown:
            count = f"{hidden} option{'s' if hidden > 1 else ''}"
            rows.append((f"{group.name} ({count})", _first_sentence(group.summary)))
    if rows:
        yield from ("", "More options, shown by --help=GROUP or --help=all:")
        yield from _table(rows)


def _section(group: _Group, full: bool) -> Iterator[str]:
    yield ""
    yield f"{group.name}: {group.summary}" if group.name else "Options:"
    rows = [option.row(full) for option in group.options]
    if full and group.name:
        several = f"Several of the options --{group.name}.NAME at once."
        rows.insert(0, (f"--{group.name} {{NAME: VALUE, ...}}", several))
    yield from _table(rows)


def _table(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    for left, text in rows:
        lines = textwrap.wrap(text, _WIDTH - _COLUMN, break_on_hyphens=False) or [""]
        if len(left) + 4 > _COLUMN:
            lines.insert(0, "")
        yield f"  {left:{_COLUMN - 2}}{lines[0]}".rstrip()
        yield from (" " * _COLUMN + line for line in lines[1:])


def _groups(config_class: Any, defaults: Mapping[str, Any], name: str) -> Iterator[_Group]:
    """The options of a dataclass, then those of the dataclasses in it.

    Args:
        defaults: values that replace defaults of the class, nested or an instance for a group.
    """
    kinds, documents = option_types(config_class), dict(field_docs(config_class))
    prefix = f"{name}." if name else ""
    options, nested = list[_Option](), list[tuple[Any, Any, str]]()
    if not name:
        file = "Read options from this YAML, JSON or TOML file; flags override them."
        options.append(_Option(CONFIG_FILE, "text", file, ""))
    for field in dataclasses.fields(config_class):
        kind, default = kinds[field.name], defaults.get(field.name, default_of(field))
        if is_dataclass_type(kind):
            inner = default if isinstance(default, Mapping) else getattr(default, "__dict__", {})
            nested.append((kind, inner, f"{prefix}{field.name}"))
        else:
            text, bounds = documents.get(field.name, ""), str(bounds_of(field) or "")
            flag = f"--{prefix}{field.name}"
            options.append(_Option(flag, type_name(kind), text, default, bounds))
    yield _Group(name, _first_paragraph(config_class), tuple(options))
    for arguments in nested:
        yield from _groups(*arguments)


def field_docs(config_class: type) -> Iterator[tuple[str, str]]:
    """(option, the string literal below it) of a dataclass and its bases."""
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


def _first_sentence(text: str) -> str:
    first, _, rest = text.partition(". ")
    return f"{first} ..." if rest else text


def _first_paragraph(config_class: type) -> str:
    text = inspect.cleandoc(config_class.__doc__ or "").split("\n\n")[0]
    return " ".join(text.split())
