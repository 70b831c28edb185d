"""Command-line flags of a configuration dataclass: ``--group.option=value``.

A dataclass may limit its flags with a class attribute ``cli_options``, which maps a group, such as
``"policy.loss"``, to the names of its options that are flags. Only a configuration file or Python
can set the other options of the group.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from draccus.utils import CONFIG_ARG

from egovcp.errors import UsageError, did_you_mean
from egovcp.files import UnsafeFileError, read_text, user_path
from egovcp.values import (
    WrongValue,
    collection_or_text,
    convert,
    is_collection,
    is_dataclass_type,
    option_types,
    parse_collection,
)

CONFIG_FILE: Final = f"--{CONFIG_ARG}"
HELP: Final = ("-h", "--help")
#: Replaces the type of a flag: an option that only a configuration file or Python can set.
NOT_A_FLAG: Final = object()
#: Other names of options, most of them LeRobot's.
OTHER_NAMES: Final[Mapping[str, str]] = {
    "env.task": "task",
    "eval.n_episodes": "episodes",
    "eval.batch_size": "num_envs",
    "policy.device": "device",
    "eval_steps": "eval_freq",
    "env_eval_freq": "eval_freq",
    "reward.weights": "returns.weights",
}
_FILE_LIMIT_BYTES: Final = 64 << 10  # YAML is parsed at about 50 kB/s


def flags_of(config_class: type) -> dict[str, Any]:
    """Flag -> type, of all options and groups of options of a dataclass."""
    found = options_of(config_class)
    return {flag: kind for flag, kind in found.items() if kind is not NOT_A_FLAG}


def options_of(config_class: type) -> dict[str, Any]:
    """As `flags_of`, and `NOT_A_FLAG` for each option that is not one of ``cli_options``."""
    limits: Mapping[str, Sequence[str]] = getattr(config_class, "cli_options", {})
    return {CONFIG_FILE: str, **dict(_flags(config_class, "", limits))}


def _flags(
    config_class: type, group: str, limits: Mapping[str, Sequence[str]], hidden: bool = False
) -> Iterator[tuple[str, Any]]:
    kinds = option_types(config_class)
    for field in dataclasses.fields(config_class):
        kind, name = kinds[field.name], f"{group}.{field.name}".removeprefix(".")
        hides = hidden or field.name not in limits.get(group, (field.name,))
        yield f"--{name}", NOT_A_FLAG if hides else kind
        if is_dataclass_type(kind):
            yield from _flags(kind, name, limits, hides)


def split_flags(argv: Sequence[str], config_class: type) -> list[str]:
    """The arguments as ``--name=value`` each: ``--a b`` is ``--a=b``, a switch alone is true.

    Raises:
        UsageError: a flag is unknown or without its value, or an argument is no flag.
    """
    joined: list[str] = []
    for arg in argv:
        takes_value = bool(joined) and joined[-1].startswith("--") and "=" not in joined[-1]
        if takes_value and not arg.startswith("--") and joined[-1] not in HELP:
            joined[-1] += f"={arg}"
        else:
            joined.append(arg)
    flags = options_of(config_class)
    return [_checked(arg, flags) for arg in joined]


def _checked(arg: str, flags: Mapping[str, Any]) -> str:
    flag, equals, value = arg.partition("=")
    if flag in HELP:
        return arg
    own = f"--{OTHER_NAMES.get(flag.removeprefix('--'))}"
    if flag not in flags and own in flags:
        flag, arg = own, f"{own}{equals}{value}"
    if not flag.startswith("-"):
        raise UsageError(f"unexpected argument {arg!r}; options are written --name=value")
    if flag not in flags:
        known = [name for name, kind in flags.items() if kind is not NOT_A_FLAG]
        raise WrongValue(f"unknown option {flag}{did_you_mean(flag, known)}")
    if flags[flag] is NOT_A_FLAG:
        raise _not_a_flag(flag)
    if not equals and flags[flag] is not bool:
        raise WrongValue(f"option {flag} needs a value, {flag}=...")
    return arg if equals else f"{arg}=true"


def _not_a_flag(option: str) -> UsageError:
    return UsageError(
        f"option {option} is not a flag: it is a constant of --preset; set it in a file, "
        "--config_path, or in Python"
    )


def flag_values(args: Sequence[str], config_class: type) -> dict[str, Any]:
    """The values of all flags and of the config file, nested by group; the last flag decides.

    ``args`` are those that `split_flags` returns.

    Raises:
        UsageError: a value has the wrong type, or the file cannot be read.
    """
    flags = options_of(config_class)
    given: dict[str, Any] = {}
    file = ""
    for arg in args:
        flag, _, text = arg.partition("=")
        if flag == CONFIG_FILE:
            file = convert(str, text, flag)
            if not file:
                raise WrongValue(f"option {CONFIG_FILE} needs a file, {CONFIG_FILE}=...")
        else:
            value: Any = _value(flag, text, flags[flag])
            _refuse_preset_options(flag, value, flags)
            for part in reversed(flag.removeprefix("--").split(".")):
                value = {part: value}
            given = merged(given, value)
    return merged(config_file(file), given) if file else given


def _value(flag: str, text: str, kind: Any) -> Any:
    """The checked value of a flag; a group stays a mapping, to be merged with other flags."""
    value: Any = text
    if is_collection(kind) and text:
        try:
            value = collection_or_text(text)
        except WrongValue as error:
            raise WrongValue.of(flag, text, kind, f"; {error}") from error
    if is_dataclass_type(kind) and isinstance(value, Mapping):
        return value
    convert(kind, value, flag)
    return value


def _refuse_preset_options(flag: str, value: Any, flags: Mapping[str, Any]) -> None:
    """Refuse an option within the value of a group that is not a flag itself."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if flags.get(f"{flag}.{key}") is NOT_A_FLAG:
                raise _not_a_flag(f"{flag}.{key}")
            _refuse_preset_options(f"{flag}.{key}", item, flags)


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Both mappings merged recursively; ``above`` wins."""
    out = {**below}
    for key, value in above.items():
        old = out.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        out[key] = value
    return out


def config_file(file: str) -> dict[str, Any]:
    """The options in the file of ``--config_path``, nested by group.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        return read_config(user_path(file))
    except OSError as error:
        raise UsageError(f"{CONFIG_FILE}: cannot read {file}: {error.strerror}") from error
    except UnsafeFileError as error:
        raise UsageError(f"{CONFIG_FILE}: cannot read {file}: {error}") from error
    except ValueError as error:
        raise UsageError(f"{CONFIG_FILE}: {file} {error}") from error


def read_config(path: Path) -> dict[str, Any]:
    """The options in a YAML, JSON or TOML file, nested by group.

    Raises:
        UnsafeFileError: it is not a regular file, too large, or not UTF-8.
        ValueError: it holds no options.
        OSError: it is missing, or cannot be read.
    """
    text = read_text(path, _FILE_LIMIT_BYTES)
    try:
        found: Any = tomllib.loads(text) if path.suffix == ".toml" else parse_collection(text)
    except (ValueError, RecursionError, WrongValue) as error:
        raise ValueError(f"holds no options: {error}") from error
    if not isinstance(found or {}, dict):
        raise ValueError(f"holds a {type(found).__name__}; expected options, name: value")
    return found or {}
