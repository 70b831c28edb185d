"""Runs a command: parses flags into a dataclass, reports errors, returns exit codes.

A command is a dataclass of options and a function::

    def main(argv: Sequence[str] | None = None) -> int:
        return run_command(CollectConfig, collect, argv, prog="egovcp-collect")

Exit codes: see `egovcp.errors`; 130 after an interrupt; 141 if the reader of the output closed it;
1 after a bug, with a traceback. For errors that a user caused ``--debug`` prints it, too.
"""

from __future__ import annotations

import errno
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import draccus

from egovcp.bounds import check_bounds, check_cores
from egovcp.entry_point import INTERRUPTED, raise_on_sigint
from egovcp.errors import EgovcpError, EnvironmentFailure, UsageError
from egovcp.files import write_text
from egovcp.flags import HELP, config_file, flag_values, merged, split_flags
from egovcp.help_text import help_text
from egovcp.outputs import check_output_files
from egovcp.terminal import echo, one_line, without_token
from egovcp.values import WrongValue, build, convert

_DEBUG: Final = "--debug"

type Defaults = Callable[[Sequence[str]], Mapping[str, Any]]
"""Flags, each as ``--name=value`` -> nested default values."""


def parse_config[C](
    config_class: type[C],
    argv: Sequence[str],
    prog: str,
    epilog: str = "",
    defaults: Defaults | None = None,
) -> C:
    """Parse dotted flags into ``config_class``.

    A flag without a value is true (``--resume`` is ``--resume=true``). A list is written
    ``[a, b]`` or ``(a, b)``. Flags and the config file override ``defaults``, which is called with
    the flags, also for the help. The help ends with ``epilog``.

    Raises:
        EgovcpError: a value is invalid; the message names the flag.
        SystemExit: after ``--help``.
    """
    try:
        args = split_flags(argv, config_class)
        topics = [arg.partition("=")[2] for arg in args if arg.partition("=")[0] in HELP]
        default_values: Mapping[str, Any] = {}
        with suppress(*[EgovcpError] if topics else []):  # help is always possible
            default_values = defaults(args) if defaults else {}
        if topics:
            echo(help_text(config_class, prog, epilog, topics[-1], default_values))
            raise SystemExit(0)
        config = build(config_class, merged(default_values, flag_values(args, config_class)), "--")
    except WrongValue as error:
        raise UsageError(f"{error}; see {prog} --help") from None
    check_bounds(config, "--")
    check_cores(config, "--")
    check_output_files(config, "--")
    return config


def run_command[C](
    config_class: type[C],
    run: Callable[[C], object],
    argv: Sequence[str] | None = None,
    *,
    prog: str,
    epilog: str = "",
    defaults: Defaults | None = None,
) -> int:
    """Parse ``argv``, call ``run`` and return the exit code; errors are printed as one line.

    `EntryPoint` handles missing packages and closed pipes.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    debug = False
    raise_on_sigint()
    try:
        debug, others = _split_debug(args)
        config = parse_config(config_class, others, prog, epilog, defaults)
        run(config)
    except KeyboardInterrupt:
        echo(f"{prog}: interrupted", error=True)
        return INTERRUPTED
    except EgovcpError as error:
        return report_error(prog, error, debug)
    except BrokenPipeError:
        raise
    except (OSError, UnicodeEncodeError) as error:
        failure = _user_error(error)
        if failure is None:
            raise
        return report_error(prog, failure, debug)
    return 0


def _split_debug(args: Sequence[str]) -> tuple[bool, list[str]]:
    """The value of ``--debug``, and the other arguments."""
    debug, others = "false", list[str]()
    for previous, arg in pairwise(["", *args]):
        flag, equals, value = arg.partition("=")
        if flag == _DEBUG:
            debug = value if equals else "true"
        elif previous == _DEBUG and not arg.startswith("-"):
            debug = arg
        else:
            others.append(arg)
    return convert(bool, debug, _DEBUG), others


def given_options(argv: Sequence[str]) -> dict[str, str]:
    """Name -> value of the flags ``--name=value``."""
    return dict(a.removeprefix("--").split("=", 1) for a in argv if "=" in a)


def preset_defaults(
    presets: Mapping[str, Callable[[], object]], argv: Sequence[str], option: str = "preset"
) -> dict[str, Any]:
    """The options of the preset that ``option``, as a flag or in the config file, names; empty
    without a known one.

    Raises:
        UsageError: both are given, or the file cannot be read.
    """
    given = given_options(argv)
    if option in given and "config_path" in given:
        raise UsageError(
            f"--{option}={given[option]} and --config_path={given['config_path']} both set "
            f"options; give one of them, and single options as flags; a file may name a {option}"
        )
    file = config_file(given["config_path"]) if given.get("config_path") else {}
    name = given.get(option) or str(file.get(option, ""))
    return dict(draccus.encode(presets[name]())) if name in presets else {}


_MESSAGE_LIMIT: Final = 2000
#: Errors of a path on the command line.
_PATH_ERRNOS: Final = {
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.ENOENT),
    *(errno.EEXIST, errno.ENOTEMPTY, errno.ENXIO, errno.ENODEV, errno.ESPIPE),
}
#: Errors of the system, with or without a file.
_ENVIRONMENT_ERRNOS: Final = {
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EADDRINUSE),
    *(errno.EMFILE, errno.ENFILE, errno.EIO, errno.EBUSY, errno.EFBIG, errno.ESTALE),
    *(errno.ENOTCONN, errno.ENOMEM, errno.EXDEV, errno.EADDRNOTAVAIL, errno.ETXTBSY),
}


def _user_error(error: OSError | UnicodeEncodeError) -> EgovcpError | None:
    """The error as an `EgovcpError`; None: a bug."""
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
    """Print the error as one line, after its traceback if ``debug``; return its exit code."""
    if debug:
        echo(without_token(traceback.format_exc()), end="", error=True)
    message = one_line(error)
    if len(message) > _MESSAGE_LIMIT:
        message = f"{message[:_MESSAGE_LIMIT]}..."
    echo(f"{prog}: error: {message}", error=True)
    return error.exit_code


def save_config(config: Any, path: str) -> None:
    """Write the config as YAML, for ``--config_path``."""
    write_text(Path(path), str(draccus.dump(config)))
