"""What every command shares: dotted flags from a dataclass, clear errors, exit codes.

A command is a dataclass of its options and a function that takes it::

    def main(argv: Sequence[str] | None = None) -> int:
        return run_command(CollectConfig, collect, argv, prog="egovcp-collect")

Exit codes: 0 done, 2 usage, 3 data, 4 artefact, 5 environment, 6 safety stop; 130
after an interrupt. A traceback is printed only with ``--debug``.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import errno
import json
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, Final, Literal, get_args, get_origin, get_type_hints

import draccus
from draccus.argparsing import ArgumentParser
from draccus.cfgparsing import load_config
from draccus.utils import CONFIG_ARG, DecodingError, DraccusException

from egovcp.bounds import Bounds, OutOfBounds, bounded, bounds_of, check_bounds
from egovcp.errors import EgovcpError, EnvironmentFailure, UsageError, suggest
from egovcp.interrupts import EXIT_CODE as INTERRUPTED
from egovcp.interrupts import raise_on_sigint
from egovcp.packages import missing_package
from egovcp.terminal import echo, one_line


@dataclass(frozen=True)
class DatasetConfig:
    """Which LeRobot dataset: on the Hub, or on disk."""

    repo_id: str = ""
    """Dataset id, `user/name`; looked up on the Hub unless root holds it."""
    root: str = ""
    """Folder of the dataset on disk; empty: the Hub's local cache."""
    revision: str = ""
    """Branch, tag or commit SHA on the Hub; empty: the latest."""


@dataclass(frozen=True)
class SelectedDatasetConfig(DatasetConfig):
    """Some episodes of a dataset."""

    episodes: str = ""
    """Only these episodes: numbers, `[0, 5, 7]`, a range whose end is excluded, `0:1334`, or both,
    `[0:100, 250]`; empty: all."""


@dataclass(frozen=True)
class WeightedDatasetConfig(SelectedDatasetConfig):
    """One of several datasets to mix."""

    weight: float | None = bounded(None, least=0)
    """Share of the windows, relative to the other datasets; null, and then for all: in proportion
    to the frames."""
    return_steps: int | None = bounded(None, least=1)
    """Horizon K of the returns of its rows, planner ticks; null: --returns.steps."""


type Kind = Literal["switch", "text", "value"]


class _Parser(ArgumentParser[Any]):
    """draccus' parser that raises `UsageError` instead of ending the process."""

    def tidy_groups(self) -> None:
        """One flag for each nested dataclass. draccus registers it twice, lists both, and one of
        a deeper dataclass (``--ball`` beside ``--env.ball``) under a name that it then refuses."""
        known = self.parser._option_string_actions
        groups = {flag.rpartition(".")[0] for flag in known}
        listed = self.parser._optionals._group_actions
        for action in [a for a in listed if a.dest not in ("help", CONFIG_ARG)]:
            flag = action.option_strings[-1]
            if known.get(flag) is action and flag in groups:
                action.metavar = "{NAME: VALUE, ...}"
                action.help = f"several of the options {flag}.NAME at once"
                action.default = argparse.SUPPRESS  # there is none to show
                continue
            listed.remove(action)
            if known.get(flag) is action:
                self.parser._actions.remove(action)
                del known[flag]

    def tell_bounds(self, config_class: type) -> None:
        """Say in the help of each flag what numbers it takes."""
        told = dict(_bounds(config_class, "--"))
        for action in self.parser._actions:
            bounds = told.get(action.option_strings[-1])
            if bounds and action.help:
                action.help += f" [{bounds}]"

    def flag_kinds(self) -> dict[str, Kind]:
        """What each flag takes: "switch", "text" (used as it is written) or "value" (YAML)."""
        actions = [a for a in self.parser._actions if a.option_strings[-1].startswith("--")]
        names = [a.option_strings[-1] for a in actions]
        kinds: dict[str, Kind] = {}
        for name, action in zip(names, actions, strict=True):
            group = any(other.startswith(f"{name}.") for other in names)
            if action.type is bool or action.nargs == 0:
                kinds[name] = "switch"
            else:
                text = action.type is str and not action.choices and not group
                kinds[name] = "text" if text else "value"
        return kinds

    def flag_types(self) -> dict[str, str]:
        """Flag -> what its value must be, in `_spoken` words; text and groups are left out."""
        actions = [a for a in self.parser._actions if a.type not in (None, str)]
        return {a.option_strings[-1]: _spoken(a.type) for a in actions}


def _bounds(config_class: type, prefix: str) -> Iterator[tuple[str, Bounds]]:
    """Flag -> bounds, of a dataclass and those within it."""
    kinds = get_type_hints(config_class)
    for option in dataclasses.fields(config_class):
        flag, kind = f"{prefix}{option.name}", kinds[option.name]
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from _bounds(kind, f"{flag}.")
        elif bounds := bounds_of(option):
            yield flag, bounds


def _spoken(kind: object) -> str:
    """A type as it is written on a command line: ``[float, float]``, ``int or null``."""
    parts = [_spoken(part) for part in get_args(kind)]
    if get_origin(kind) is tuple:
        return f"[{', '.join(parts)}]"
    if kind is Ellipsis:
        return "..."
    name = "null" if kind is NoneType else getattr(kind, "__name__", str(kind))
    return " or ".join(parts) or str(name)


class _TeachingHelp(argparse.ArgumentDefaultsHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=44, width=110)


def parse_config[C](
    config_class: type[C],
    argv: Sequence[str],
    prog: str,
    epilog: str = "",
    defaults: Callable[[Sequence[str]], Mapping[str, Any]] | None = None,
) -> C:
    """Parse dotted flags into ``config_class``; raise `UsageError` naming the flag at fault.

    A switch without a value is true (``--resume`` is ``--resume=true``). ``defaults`` maps
    the flags to nested values that stand where no flag and no config file says otherwise.
    """
    parser = _Parser(
        config_class,
        formatter_class=_TeachingHelp,
        prog=prog,
        description=(config_class.__doc__ or "").strip(),
        epilog=epilog,
        exit_on_error=False,
    )
    parser.tidy_groups()
    parser.tell_bounds(config_class)
    kinds, types = parser.flag_kinds(), parser.flag_types()
    args = [_checked(arg, kinds, prog) for arg in _joined(argv)]
    try:
        beneath = _merged(_own_defaults(config_class), defaults(args) if defaults else {})
        flags, given = _without_config_file([_verbatim(arg, kinds) for arg in args])
        with _defaults_file(_merged(beneath, given)) as path:
            parser.config_path = path
            config: C = parser.parse_args(flags)
    except EgovcpError as error:
        raise _with_flag(error, ()) from None
    except (DraccusException, argparse.ArgumentError, ValueError, TypeError) as error:
        if own := _own_error(error):
            keys = error.key_path if isinstance(error, DecodingError) else ()
            raise _with_flag(own, keys) from None
        words = _wrong_value(error, args, types) or " ".join(str(error).split())
        raise UsageError(f"{words}; see {prog} --help") from error
    except OSError as error:
        raise UsageError(f"cannot read {error.filename}: {error.strerror}") from error
    check_bounds(config, "--")
    return config


def _own_error(error: BaseException) -> EgovcpError | None:
    """What a config said itself against its values, below what draccus wrapped around it."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, EgovcpError):
        cause = cause.__cause__
    return cause


def _with_flag(error: EgovcpError, keys: Sequence[str]) -> EgovcpError:
    """The error of the config at ``keys``, an option that is out of bounds named as its flag."""
    if not isinstance(error, OutOfBounds):
        return error
    return error.under(f"--{''.join(f'{key}.' for key in keys)}")


def _wrong_value(error: Exception, args: Sequence[str], types: Mapping[str, str]) -> str:
    """``--count=many: expected int``; empty where no single flag is at fault."""
    flag = f"--{'.'.join(error.key_path)}" if isinstance(error, DecodingError) else ""
    given = [arg for arg in args if arg.partition("=")[0] == flag]
    return f"{given[-1]}: expected {types[flag]}" if given and flag in types else ""


def _own_defaults(config_class: type) -> dict[str, Any]:
    """What a config has in its nested dataclasses that is not their own default, encoded.

    Of a nested dataclass of which a flag or a file names one value, draccus takes all others from
    that dataclass, and forgets what the config that holds it says.
    """

    defaults = {field.name: _default(field) for field in dataclasses.fields(config_class)}
    nested = {k: _differing(v) for k, v in defaults.items() if dataclasses.is_dataclass(v)}
    return {name: values for name, values in nested.items() if values}


def _differing(config: Any) -> dict[str, Any]:
    """The values of a config that are not its class's own defaults."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            if inner := _differing(value):
                found[field.name] = inner
        elif value != _default(field):
            found[field.name] = draccus.encode(value)
    return found


def _default(field: dataclasses.Field[Any]) -> object:
    """What stands where nothing is given; `MISSING` if something must be."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Both, groups within groups; ``above`` has the last word."""
    merged = {**below}
    for key, value in above.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = _merged(old, value)
        merged[key] = value
    return merged


def _without_config_file(args: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """The flags but for ``--config_path``, and what the file holds that it names last."""
    own = f"--{CONFIG_ARG}="
    files = [json.loads(a.removeprefix(own)) for a in args if a.startswith(own)]
    flags = [a for a in args if not a.startswith(own)]
    return flags, _read_config(files[-1]) if files else {}


def _read_config(file: str) -> dict[str, Any]:
    with open(file, encoding="utf-8") as stream:
        found = load_config(stream, file=file) or {}
    if not isinstance(found, dict):
        raise UsageError(f"{file} holds a {type(found).__name__}; expected options, name: value")
    return found


@contextlib.contextmanager
def _defaults_file(values: Mapping[str, Any]) -> Iterator[str | None]:
    """The values as a file that draccus reads below the flags: it takes partial configs no
    other way."""
    if not values:
        yield None
        return
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        json.dump(values, file)  # JSON is YAML
        file.flush()
        yield file.name


def _joined(argv: Sequence[str]) -> list[str]:
    """``--a b`` as ``--a=b``."""
    out: list[str] = []
    for arg in argv:
        takes_value = bool(out) and out[-1].startswith("--") and "=" not in out[-1]
        if takes_value and not arg.startswith("--"):
            out[-1] += f"={arg}"
        else:
            out.append(arg)
    return out


def _checked(arg: str, kinds: Mapping[str, Kind], prog: str) -> str:
    """The argument, a lone ``--a`` as ``--a=true``; raise `UsageError` for what is none."""
    flag, equals, _ = arg.partition("=")
    if arg in ("-h", "--help"):
        return arg
    if not flag.startswith("-"):
        raise UsageError(f"unexpected argument {arg!r}; options are written --name=value")
    if flag not in kinds:
        near = suggest(flag, kinds).split(" choose from")[0].rstrip(";")
        raise UsageError(f"unknown option {flag}{near}; see {prog} --help")
    if not equals and kinds[flag] != "switch":
        raise UsageError(f"option {flag} needs a value, {flag}=...; see {prog} --help")
    return arg if equals else f"{arg}=true"


def _verbatim(arg: str, kinds: Mapping[str, Kind]) -> str:
    """Quote text, which draccus would read as YAML: a folder 007 is not the number 7."""
    flag, equals, value = arg.partition("=")
    if not equals or kinds[flag] != "text":
        return arg
    return f"{flag}={json.dumps(value, ensure_ascii=False)}"


def run_command[C](
    config_class: type[C],
    run: Callable[[C], object],
    argv: Sequence[str] | None = None,
    *,
    prog: str,
    epilog: str = "",
    defaults: Callable[[Sequence[str]], Mapping[str, Any]] | None = None,
) -> int:
    """Parse ``argv``, call ``run`` and return the exit code; one line on an error."""
    args = list(sys.argv[1:] if argv is None else argv)
    switch = ("--debug", "--debug=true")
    debug = any(a in switch for a in args)
    epilog = (epilog + "\n" if epilog else "") + "--debug prints the traceback of an error."
    raise_on_sigint()
    try:
        plain = [a for a in args if a not in switch]
        config = parse_config(config_class, plain, prog, epilog, defaults)
        run(config)
    except KeyboardInterrupt:
        echo(f"{prog}: interrupted", error=True)
        return INTERRUPTED
    except EgovcpError as error:
        return report_error(prog, error, debug)
    except ModuleNotFoundError as error:
        missing = missing_package(error, config_class.__module__, prog)
        if missing is None:
            raise
        return report_error(prog, missing, debug)
    except BrokenPipeError:
        raise  # the reader of the output has gone: `EntryPoint` ends the process
    except (OSError, UnicodeEncodeError) as error:
        failure = _user_error(error)
        if failure is None:
            raise
        return report_error(prog, failure, debug)
    return 0


#: What a path on the command line can be wrong in.
_PATH_ERRNOS: Final = {
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.ENOENT),
    *(errno.EEXIST, errno.ENOTEMPTY, errno.ENXIO, errno.ENODEV, errno.ESPIPE),
}
#: What the system refuses, whether it names a file or not.
_ENVIRONMENT_ERRNOS: Final = {
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EADDRINUSE),
    *(errno.EMFILE, errno.ENFILE, errno.EIO, errno.EBUSY, errno.EFBIG, errno.ESTALE),
    *(errno.ENOTCONN, errno.ENOMEM, errno.EXDEV, errno.EADDRNOTAVAIL, errno.ETXTBSY),
}


def _user_error(error: OSError | UnicodeEncodeError) -> EgovcpError | None:
    """The error as one that a user can cause; None: a bug."""
    if isinstance(error, UnicodeEncodeError):
        if error.reason != "surrogates not allowed":
            return None
        return UsageError(f"{error.object!r} is not valid UTF-8; rename the file or folder")
    reason = f"{error.strerror}: {error.filename or ''}".rstrip(": ")
    if error.errno in _ENVIRONMENT_ERRNOS:
        return EnvironmentFailure(reason)
    if error.errno in _PATH_ERRNOS and error.filename is not None:
        return UsageError(f"{reason}; check the path")
    return None


def report_error(prog: str, error: EgovcpError, debug: bool = False) -> int:
    """Print the error as one line, with ``debug`` after its traceback; return its exit code."""
    if debug:
        echo(_without_token(traceback.format_exc()), end="", error=True)
    echo(f"{prog}: error: {one_line(error)}", error=True)
    return error.exit_code


def _without_token(text: str) -> str:
    """The text without the user's token for the Hub, which a server may have repeated."""
    if "huggingface_hub" not in sys.modules:
        return text
    from huggingface_hub import get_token

    token = get_token()
    return text.replace(token, "<token>") if token else text


def save_config(config: Any, path: str) -> None:
    """Write the resolved config as YAML, so that a run can be repeated with ``--config_path``."""
    with open(path, "w", encoding="utf-8") as file:
        draccus.dump(config, file)
