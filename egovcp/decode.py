"""Decodes dataclasses from untrusted JSON without type conversions.

`draccus.decode` converts ``true`` and ``"256"`` to integers and raises TypeError for ``null``. Here
every value must have the type of its option.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from types import NoneType, UnionType
from typing import Any, Final, Literal, TypeAliasType, Union, get_args, get_origin, get_type_hints

from egovcp.bounds import OutOfBounds
from egovcp.errors import UsageError

_SHOWN_CHARACTERS: Final = 40
_JSON_NAMES: Final[Mapping[Any, str]] = {
    bool: "true or false",
    int: "an integer",
    float: "a finite number",
    str: "a string",
    NoneType: "null",
}


class DecodeError(ValueError):
    """A JSON value does not have the expected type."""


def decode[C](kind: type[C], value: object, name: str) -> C:
    """A JSON value as an instance of ``kind``; missing options get their defaults.

    Args:
        kind: a dataclass, number, string, boolean, literal, or a tuple, list, dict or union of
            these. The fields of the dataclass are of the same kinds.
        value: as `json.loads` returns it.
        name: of the value, for messages.

    Raises:
        DecodeError: a value has another type or is out of bounds, or an option is unknown or
            missing.
    """
    decoded: C = _decode(kind, value, name)
    return decoded


def require_type(value: object, kind: Any, name: str) -> None:
    """Raise `DecodeError` unless a JSON value is of this kind; see `decode`."""
    _decode(kind, value, name)


def shown(value: object) -> str:
    """A JSON value as ASCII text of bounded length, for messages."""
    if isinstance(value, (dict, list)):
        return "an object" if isinstance(value, dict) else "a list"
    if isinstance(value, str) and len(value) > _SHOWN_CHARACTERS:
        value = value[: _SHOWN_CHARACTERS - 3] + "..."
    text = json.dumps(value)
    return text if isinstance(value, str) else text[:_SHOWN_CHARACTERS]


def _dataclass(config_class: Any, value: object, name: str) -> Any:
    if not isinstance(value, dict):
        raise DecodeError(f"{name} is {shown(value)}, expected an object")
    hints = get_type_hints(config_class)
    options = {field.name: field for field in dataclasses.fields(config_class) if field.init}
    for key in value:
        if key not in options:
            raise DecodeError(f"{name} has the unknown option {shown(key)}")
    missing = [key for key, field in options.items() if key not in value and _is_required(field)]
    if missing:
        raise DecodeError(f"{name} lacks the option {missing[0]}")
    decoded = {key: _decode(hints[key], item, f"{name}.{key}") for key, item in value.items()}
    try:
        return config_class(**decoded)
    except OutOfBounds as error:
        raise DecodeError(str(error.with_prefix(f"{name}."))) from error
    except UsageError as error:
        raise DecodeError(f"{name}: {error}") from error


def _is_required(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _decode(hint: Any, value: object, name: str) -> Any:
    while isinstance(hint, TypeAliasType):
        hint = hint.__value__
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint):
        return _dataclass(hint, value, name)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return _union(hint, value, name)
    if origin is tuple and isinstance(value, list):
        return _tuple(arguments, value, name)
    if origin is list and isinstance(value, list):
        return [_decode(arguments[0], item, f"{name}[{i}]") for i, item in enumerate(value)]
    if origin is dict and isinstance(value, dict):
        return {k: _decode(arguments[1], v, f"{name}[{shown(k)}]") for k, v in value.items()}
    if origin is Literal and isinstance(value, str) and value in arguments:
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return _number(value, name)
    if isinstance(hint, type) and hint is not float and type(value) is hint:
        return value
    raise DecodeError(f"{name} is {shown(value)}, expected {_described(hint)}")


def _union(hint: Any, value: object, name: str) -> Any:
    for choice in get_args(hint):
        try:
            return _decode(choice, value, name)
        except DecodeError:
            continue
    raise DecodeError(f"{name} is {shown(value)}, expected {_described(hint)}")


def _tuple(kinds: tuple[Any, ...], values: list[Any], name: str) -> tuple[Any, ...]:
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(values)
    if len(kinds) != len(values):
        raise DecodeError(f"{name} is a list of {len(values)}, expected {len(kinds)} values")
    pairs = enumerate(zip(kinds, values, strict=True))
    return tuple(_decode(kind, item, f"{name}[{i}]") for i, (kind, item) in pairs)


def _number(value: float, name: str) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DecodeError(f"{name} is {shown(value)}, expected {_JSON_NAMES[float]}")
    return number


def _described(hint: Any) -> str:
    return " or ".join(dict.fromkeys(_words(hint)))


def _words(hint: Any) -> Iterator[str]:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        for argument in arguments:
            yield from _words(argument)
    elif origin is Literal:
        yield f"one of {', '.join(map(str, arguments))}"
    elif origin in (tuple, list):
        yield "a list"
    elif origin is dict or dataclasses.is_dataclass(hint):
        yield "an object"
    else:
        yield _JSON_NAMES.get(hint, getattr(hint, "__name__", str(hint)))
