"""Parses values of options and builds configuration dataclasses.

Types of options: str, int, float, bool, `Literal`, tuple, list, dict with str keys, dataclass, and
unions with None. Collections are written in YAML; a list may be ``(1, 2)``.
Numbers may be text, as on a command line; with ``strict``, for JSON, they may not.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from egovcp.bounds import OutOfBounds, as_flag_value
from egovcp.errors import UsageError, did_you_mean
from egovcp.files import check_depth

_BOOLEANS: Final[Mapping[str, bool]] = {
    **dict.fromkeys(("true", "yes", "on"), True),
    **dict.fromkeys(("false", "no", "off"), False),
}
_NULL: Final = ("null", "none", "~")
_INTEGER: Final = re.compile(r"[+-]?[0-9]+")
_YAML_FLOATS: Final[Mapping[Any, str]] = {".inf": "inf", "-.inf": "-inf", ".nan": "nan"}
_INT_LIMIT: Final = 2**63
_INT_DIGITS: Final = 19  # of a number below 2^63
_MAIN_OPTIONS: Final = ("root", "path", "type")
"""The option that is probably meant by the name of a group such as ``--dataset``."""
_SHOWN_OPTIONS: Final = 6


class _YamlLoader(yaml.SafeLoader):  # type: ignore[misc]
    """Refuses keys that are not text, and keys that are given twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[str, Any]:
        keys: set[str] = set()
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if not isinstance(key.value, str):
                raise WrongValue(f"a key in line {line} is a collection; expected text")
            text = as_flag_value(key.value)
            if not key.tag.endswith((":str", ":merge", ":value")):
                raise WrongValue(f'key {text} in line {line} is not text; write "{text}"')
            if key.value in keys:
                raise WrongValue(f"key {text} is given a second time in line {line}")
            keys.add(key.value)
        found: dict[str, Any] = super().construct_mapping(node, deep)
        return found


class WrongValue(UsageError):
    """A value that does not have the type of its option."""

    @classmethod
    def of(cls, name: str, value: object, kind: Any, hint: str = "") -> WrongValue:
        """``name=value: expected type``."""
        return cls(f"{name}={as_flag_value(value)}: expected {type_name(kind)}{hint}")


def type_name(kind: Any) -> str:
    """A type in command-line syntax: ``[float, float]``, ``int or null``."""
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
    names = {str: "text", bool: "true or false", NoneType: "null", Ellipsis: "..."}
    return names.get(kind) or str(kind.__name__)


def choices(kind: Any) -> tuple[str, ...]:
    """The values of a boolean or a literal, also in a union; empty for other types."""
    if kind is bool:
        return ("true", "false")
    parts = get_args(kind)
    if get_origin(kind) is Literal:
        return tuple(map(str, parts))
    is_union = get_origin(kind) in (Union, UnionType)
    return tuple(name for part in parts for name in choices(part)) if is_union else ()


@cache
def option_types(config_class: type) -> Mapping[str, Any]:
    """Option -> type of a dataclass."""
    return get_type_hints(config_class)


def is_dataclass_type(kind: Any) -> bool:
    """Whether the type is a group of options."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def is_collection(kind: Any) -> bool:
    """Whether values of this type are written in YAML."""
    if get_origin(kind) in (Union, UnionType):
        return any(is_collection(part) for part in get_args(kind))
    return get_origin(kind) in (tuple, list, dict) or is_dataclass_type(kind)


def parse_collection(text: str) -> Any:
    """The value of a YAML text; a list may be in parentheses.

    Raises:
        ValueError: invalid YAML, nested too deeply, or an alias of a collection within itself.
        WrongValue: a key is not text, or is given twice.
    """
    check_depth(text)
    stripped = text.strip()
    if stripped.startswith("(") and stripped.endswith(")"):
        text = f"[{stripped[1:-1]}]"
    try:
        loader = _YamlLoader(text)
        node = loader.get_single_node()
        return None if node is None else loader.construct_object(node, deep=True)
    except WrongValue:
        raise
    except Exception as error:
        raise ValueError(" ".join(str(error).split())) from error


def build[C](
    config_class: type[C],
    values: Mapping[str, Any],
    prefix: str,
    default: C | None = None,
    strict: bool = False,
) -> C:
    """An instance of a dataclass.

    Args:
        values: option -> value; options may be missing.
        prefix: prefix of option names in messages, ``--env.``.
        default: an instance with the values of missing options; None: the defaults of the class.
        strict: see `convert`.

    Raises:
        WrongValue: an option is unknown, required and missing, or has another type.
        EgovcpError: raised by the dataclass.
    """
    kinds = option_types(config_class)  # type: ignore[arg-type]
    options = {field.name: field for field in dataclasses.fields(config_class)}  # type: ignore[arg-type]
    for key in values:
        if key not in options:
            near = did_you_mean(f"{prefix}{key}", [f"{prefix}{name}" for name in options])
            raise WrongValue(f"unknown option {prefix}{as_flag_value(key)}{near}")
    found: dict[str, Any] = {}
    for key, field in options.items():
        base = default_of(field) if default is None else getattr(default, key)
        found[key] = base
        if key in values:
            found[key] = convert(kinds[key], values[key], f"{prefix}{key}", base, strict)
        if found[key] is dataclasses.MISSING:
            raise WrongValue(f"option {prefix}{key} is missing")
    try:
        return config_class(**found)
    except OutOfBounds as error:
        raise error.with_prefix(prefix) from None


def convert(kind: Any, value: Any, name: str, default: Any = None, strict: bool = False) -> Any:
    """The value converted to a type.

    Args:
        value: a Python value, or text from a command line.
        name: of the option, for messages.
        default: for a dataclass: an instance with the values of missing options.
        strict: refuse text for other types, and numbers that are not finite.

    Raises:
        WrongValue: the value has another type.
    """
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        is_null = isinstance(value, str) and value.lower() in _NULL and not strict
        if NoneType in args and (value is None or is_null):
            return None
        return _convert_union(kind, value, name, strict)
    if is_dataclass_type(kind):
        if not isinstance(value, Mapping):
            raise WrongValue.of(name, value, kind, _options_of(kind, value, name))
        base = default if isinstance(default, kind) else None
        return build(kind, value, f"{name}.", base, strict)
    if origin in (tuple, list):
        return origin(_items(kind, value, name, strict))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise WrongValue.of(name, value, kind)
        keys = [_text(key, name) for key in value]
        return {k: convert(args[1], value[k], f"{name}.{k}", strict=strict) for k in keys}
    if kind is str:
        return _text(value, name)
    found = _scalar(kind, value, strict)
    if found is None:
        is_text = isinstance(value, str)
        hint = did_you_mean(value, args) if origin is Literal and is_text else ""
        is_integer = _INTEGER.fullmatch(value) if is_text and not strict else type(value) is int
        if kind is int and is_integer:
            hint = " between -2^63 and 2^63"
        raise WrongValue.of(name, value, kind, hint)
    return found


def _convert_union(kind: Any, value: Any, name: str, strict: bool) -> Any:
    for part in get_args(kind):
        if part is not NoneType:
            try:
                return convert(part, value, name, strict=strict)
            except WrongValue:
                continue
    raise WrongValue.of(name, value, kind)


def _items(kind: Any, value: Any, name: str, strict: bool) -> Iterator[Any]:
    """The items of a tuple or a list, converted."""
    args = get_args(kind)
    if isinstance(value, str) and value.strip().startswith(("(", "[")) and not strict:
        value = collection_or_text(value)  # a tuple in YAML
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise WrongValue.of(name, value, kind)
    variadic = get_origin(kind) is list or args[-1] is Ellipsis
    kinds = [args[0]] * len(value) if variadic else list(args)
    if len(kinds) != len(value):
        raise WrongValue.of(name, value, kind)
    for index, (part, item) in enumerate(zip(kinds, value, strict=True)):
        if is_dataclass_type(part):
            yield convert(part, item, f"{name}[{index}]", strict=strict)
            continue
        try:
            yield convert(part, item, name, strict=strict)
        except WrongValue:
            raise WrongValue.of(name, value, kind) from None


def collection_or_text(text: str) -> Any:
    """The collection or string that a YAML text holds; else, as for a number, the text itself."""
    try:
        found = parse_collection(text)
    except ValueError:
        return text
    return found if isinstance(found, dict | list | str) else text


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


def _scalar(kind: Any, value: Any, strict: bool) -> Any:
    """A number, a boolean or a literal; None: the value has another type."""
    if get_origin(kind) is Literal:
        return next((v for v in get_args(kind) if v == value and type(v) is type(value)), None)
    if strict and isinstance(value, str):
        return None
    if kind is bool:
        if isinstance(value, str):
            return _BOOLEANS.get(value.lower())
        return value if isinstance(value, bool) else None
    if isinstance(value, bool):
        return None
    if kind is int:
        if isinstance(value, str) and _INTEGER.fullmatch(value):
            digits = value.lstrip("+-0")
            value = int(value) if len(digits) <= _INT_DIGITS else None
        return value if isinstance(value, int) and abs(value) < _INT_LIMIT else None
    if kind is float and isinstance(value, int | float | str):
        try:
            number = float(_YAML_FLOATS.get(value, value))
        except (ValueError, OverflowError):
            return None
        return None if strict and not math.isfinite(number) else number
    return None


def _options_of(config_class: Any, value: Any, name: str) -> str:
    """The options of a group, and the one that may be meant."""
    names = [field.name for field in dataclasses.fields(config_class)]
    meant = [key for key in _MAIN_OPTIONS if key in names and isinstance(value, str)]
    if meant:
        return f"; did you mean {name}.{meant[0]}={as_flag_value(value)}?"
    prefix = "" if name.endswith("]") else f"{name}."  # an item of a list is no flag
    listed = ", ".join(f"{prefix}{key}" for key in names[:_SHOWN_OPTIONS])
    return f"; its options are {listed}{', ...' if len(names) > _SHOWN_OPTIONS else ''}"


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Dotted name, and both values, of each leaf in which nested options differ; a missing one is
    None."""
    for name in {**before, **now}:
        old, new = before.get(name), now.get(name)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            yield from differences(old, new, f"{prefix}{name}.")
        elif old != new:
            yield f"{prefix}{name}", (old, new)


def default_of(field: dataclasses.Field[Any]) -> Any:
    """The default of a field; `MISSING`: the option is required."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default
