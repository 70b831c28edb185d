"""Values of options: parsed from text, checked against the type of the option, built.

An option has one of these types: text, int, float, bool, `Literal`, tuple, list, dict with text as
keys, dataclass, or any of them or None. A collection is written in YAML, in which ``(1, 2)`` stands
for ``[1, 2]``. Numbers may be text, as on a command line; `egovcp.decode` reads JSON that somebody
else wrote, and converts nothing.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from draccus import cfgparsing

from egovcp.bounds import OutOfBounds, as_flag_value
from egovcp.errors import UsageError, did_you_mean
from egovcp.removed_options import refuse_removed_flag

_BOOLEANS: Final[Mapping[str, bool]] = {
    **dict.fromkeys(("true", "yes", "on"), True),
    **dict.fromkeys(("false", "no", "off"), False),
}
_NULL: Final = ("null", "none", "~")
_INT: Final = re.compile(r"[+-]?[0-9]{1,19}")
_YAML_FLOATS: Final[Mapping[Any, str]] = {".inf": "inf", "-.inf": "-inf", ".nan": "nan"}
_INT_LIMIT: Final = 2**63
_MAIN_OPTIONS: Final = ("root", "path", "type")
"""Of a group such as ``--dataset``: what its name alone is likely to stand for."""
_SHOWN_OPTIONS: Final = 6
_NESTING_LIMIT: Final = 32


class WrongValue(UsageError):
    """A value that is not of the type of its option."""

    @classmethod
    def of(cls, name: str, value: object, kind: Any, hint: str = "") -> WrongValue:
        """``name=value: expected type``."""
        return cls(f"{name}={as_flag_value(value)}: expected {type_name(kind)}{hint}")


def type_name(kind: Any) -> str:
    """A type as its values are written on a command line: ``[float, float]``, ``int or null``."""
    origin, args = get_origin(kind), get_args(kind)
    if is_dataclass_type(kind):
        return "{NAME: VALUE, ...}"
    if origin is dict:
        return f"{{NAME: {type_name(args[1])}, ...}}"
    if origin is list:
        return f"[{type_name(args[0])}, ...]"
    if origin is tuple:
        return f"[{', '.join(type_name(part) for part in args)}]"
    if origin is Literal:
        return " or ".join(map(str, args))
    if args:
        return " or ".join(type_name(part) for part in args)
    names = {str: "text", NoneType: "null", Ellipsis: "..."}
    return names.get(kind) or str(kind.__name__)


@cache
def option_types(config_class: type) -> Mapping[str, Any]:
    """Option -> type, of a dataclass."""
    return get_type_hints(config_class)


def is_dataclass_type(kind: Any) -> bool:
    """Whether options of this type have options of their own."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def is_collection(kind: Any) -> bool:
    """Whether a value of this type is written in YAML: a list, a mapping, or either or null."""
    if get_origin(kind) in (Union, UnionType):
        return any(is_collection(part) for part in get_args(kind))
    return get_origin(kind) in (tuple, list, dict) or is_dataclass_type(kind)


def parse_collection(text: str) -> Any:
    """The value of a text in YAML, in which a list may be written in parentheses.

    Raises:
        ValueError: it is not YAML.
    """
    try:
        return cfgparsing.parse_string(_with_brackets(text))
    except Exception as error:
        raise ValueError(" ".join(str(error).split())) from error


def build[C](
    config_class: type[C], values: Mapping[str, Any], prefix: str, default: C | None = None
) -> C:
    """An instance of a dataclass.

    Args:
        config_class: the dataclass.
        values: option -> value; may lack options.
        prefix: what precedes the name of an option in messages, ``--env.``.
        default: has the options that are lacking; None: the defaults of the class.

    Raises:
        WrongValue: an option is unknown, lacking without a default, or not of its type.
        EgovcpError: what the dataclass itself raises; bounds name the flag.
    """
    kinds = option_types(config_class)  # type: ignore[arg-type]
    options = {field.name: field for field in dataclasses.fields(config_class)}  # type: ignore[arg-type]
    for key in values:
        if key not in options:
            refuse_removed_flag(f"{prefix}{key}")
            near = did_you_mean(f"{prefix}{key}", [f"{prefix}{name}" for name in options])
            raise WrongValue(f"unknown option {prefix}{as_flag_value(key)}{near}")
    found: dict[str, Any] = {}
    for key, field in options.items():
        base = default_of(field) if default is None else getattr(default, key)
        found[key] = (
            convert(kinds[key], values[key], f"{prefix}{key}", base) if key in values else base
        )
        if found[key] is dataclasses.MISSING:
            raise WrongValue(f"option {prefix}{key} is missing")
    try:
        return config_class(**found)
    except OutOfBounds as error:
        raise error.under(prefix) from None


def convert(kind: Any, value: Any, name: str, default: Any = None) -> Any:
    """The value as one of a type.

    Args:
        kind: the type.
        value: a Python value, or text that a user wrote.
        name: of the option, for messages.
        default: of a dataclass: has the options that ``value`` lacks.

    Raises:
        WrongValue: it is not of the type; the message names the option, or the one within it.
    """
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        null = value is None or (isinstance(value, str) and value.lower() in _NULL)
        if null and NoneType in args:
            return None
        return _convert_union(kind, value, name)
    if is_dataclass_type(kind):
        if not isinstance(value, Mapping):
            raise WrongValue.of(name, value, kind, _options_of(kind, value, name))
        base = default if isinstance(default, kind) else None
        return build(kind, value, f"{name}.", base)
    if origin in (tuple, list):
        return origin(_items(kind, value, name))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise WrongValue.of(name, value, kind)
        keys = [_text(key, name) for key in value]
        return {key: convert(args[1], value[key], f"{name}.{key}") for key in keys}
    if kind is str:
        return _text(value, name)
    found = _scalar(kind, value)
    if found is None:
        near = did_you_mean(value, args) if origin is Literal and isinstance(value, str) else ""
        raise WrongValue.of(name, value, kind, near)
    return found


def _convert_union(kind: Any, value: Any, name: str) -> Any:
    for part in get_args(kind):
        if part is not NoneType:
            try:
                return convert(part, value, name)
            except WrongValue:
                continue
    raise WrongValue.of(name, value, kind)


def _items(kind: Any, value: Any, name: str) -> Iterator[Any]:
    """The items of a tuple or a list, converted."""
    args = get_args(kind)
    if isinstance(value, str) and value.strip().startswith(("(", "[")):
        value = _collection_or(value)  # a tuple in a config file
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise WrongValue.of(name, value, kind)
    variadic = get_origin(kind) is list or args[-1] is Ellipsis
    kinds = [args[0]] * len(value) if variadic else list(args)
    if len(kinds) != len(value):
        raise WrongValue.of(name, value, kind)
    for index, (part, item) in enumerate(zip(kinds, value, strict=True)):
        if is_dataclass_type(part):
            yield convert(part, item, f"{name}[{index}]")
            continue
        try:
            yield convert(part, item, name)
        except WrongValue:
            raise WrongValue.of(name, value, kind) from None


def _collection_or(text: str) -> Any:
    try:
        return parse_collection(text)
    except ValueError:
        return text


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise WrongValue.of(name, value, str, f'; write "{as_flag_value(value)}"')
    if "\0" in value:
        raise WrongValue.of(name, value, str, " without a NUL character")
    if not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError:
            raise WrongValue.of(name, value, str, " in UTF-8") from None
    return value


def _scalar(kind: Any, value: Any) -> Any:
    """A number, a boolean or one of several values; None: the value is not of the type."""
    if get_origin(kind) is Literal:
        return next((v for v in get_args(kind) if v == value and type(v) is type(value)), None)
    if kind is bool:
        return _BOOLEANS.get(value.lower()) if isinstance(value, str) else _if_is(bool, value)
    if isinstance(value, bool):
        return None
    if kind is int:
        if isinstance(value, str) and _INT.fullmatch(value):
            value = int(value)
        return value if isinstance(value, int) and abs(value) < _INT_LIMIT else None
    if kind is float and isinstance(value, int | float | str):
        try:
            return float(_YAML_FLOATS.get(value, value))
        except (ValueError, OverflowError):
            return None
    return None


def _if_is(kind: type, value: Any) -> Any:
    return value if isinstance(value, kind) else None


def _options_of(config_class: Any, value: Any, name: str) -> str:
    """What a group has for options, and which of them may have been meant."""
    names = [field.name for field in dataclasses.fields(config_class)]
    meant = [key for key in _MAIN_OPTIONS if key in names and isinstance(value, str)]
    if meant:
        return f"; did you mean {name}.{meant[0]}={as_flag_value(value)}?"
    prefix = "" if name.endswith("]") else f"{name}."  # of an item in a list: no flag
    listed = ", ".join(f"{prefix}{key}" for key in names[:_SHOWN_OPTIONS])
    return f"; its options are {listed}{', ...' if len(names) > _SHOWN_OPTIONS else ''}"


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Of the class; `MISSING`: the option is required."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _with_brackets(text: str) -> str:
    """The text with the parentheses of lists replaced by brackets; others are left alone.

    Raises:
        ValueError: it is nested too deeply, for which a parser would take long.
    """
    out: list[str] = []
    opened: list[str] = []
    quote, before = "", ""  # the quote that is open; the last character that is not a space
    for character in text:
        starts = before in "[{(,:"  # a value may start here
        written = character
        if quote:
            quote = "" if character == quote else quote
        elif starts and character in "'\"":
            quote = character
        elif character in "[{" or (starts and character == "(" and (opened or not before)):
            opened.append(character)
            if len(opened) > _NESTING_LIMIT:
                raise ValueError(f"nested more than {_NESTING_LIMIT} deep")
            written = "[" if character == "(" else character
        elif opened and character == {"[": "]", "{": "}", "(": ")"}[opened[-1]]:
            written = "]" if opened.pop() == "(" else character
        out.append(written)
        before = before if character.isspace() else character
    return "".join(out)
