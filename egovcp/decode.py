"""Decodes dataclasses from untrusted JSON without type conversions.

Unlike `draccus.decode`, which converts ``true`` and ``"256"`` to integers.
"""

from __future__ import annotations

import json
from typing import Any, Final

from egovcp.errors import UsageError
from egovcp.values import convert

_SHOWN_CHARACTERS: Final = 40


class DecodeError(ValueError):
    """A JSON value does not have the expected type."""


def decode[C](kind: type[C], value: object, name: str) -> C:
    """A JSON value as an instance of ``kind``; missing options get their defaults.

    Args:
        kind: a type of options, see `egovcp.values`, or Any.
        value: as `json.loads` returns it.
        name: of the value, for messages.

    Raises:
        DecodeError: a value has another type or is out of bounds, or an option is unknown or
            missing.
    """
    try:
        decoded: C = convert(kind, value, name, strict=True)
    except UsageError as error:
        raise DecodeError(str(error)) from error
    return decoded


def require_type(value: object, kind: Any, name: str) -> None:
    """Raise `DecodeError` unless a JSON value is of this kind; see `decode`."""
    decode(kind, value, name)


def shown(value: object) -> str:
    """A JSON value as ASCII text of bounded length, for messages."""
    if isinstance(value, (dict, list)):
        return "an object" if isinstance(value, dict) else "a list"
    if isinstance(value, str) and len(value) > _SHOWN_CHARACTERS:
        value = value[: _SHOWN_CHARACTERS - 3] + "..."
    text = json.dumps(value)
    return text if isinstance(value, str) else text[:_SHOWN_CHARACTERS]
