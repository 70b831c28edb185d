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
import errno
import json
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import draccus
from draccus.argparsing import ArgumentParser
from draccus.utils import DraccusException

from egovcp.errors import EgovcpError, EnvironmentFailure, UsageError, suggest


@dataclass(frozen=True)
class DatasetConfig:
    """Which LeRobot dataset: on the Hub, or on disk."""

    repo_id: str = ""
    """Dataset id, `user/name`; looked up on the Hub unless root holds it."""
    root: str = ""
    """Folder of the dataset on disk; empty: the Hub's local cache."""
    revision: str = ""
    """Branch, tag or commit SHA on the Hub; empty: the latest."""


class _Parser(ArgumentParser[Any]):
    """draccus' parser that raises `UsageError` instead of ending the process."""

    def known_flags(self) -> list[str]:
        return [o for a in self.parser._actions for o in a.option_strings if o.startswith("--")]


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

    A flag without a value is true (``--resume`` is ``--resume=true``). ``defaults`` maps
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
    known = parser.known_flags()
    args = _bare_flags_are_true(argv)
    for arg in args:
        flag = arg.split("=", 1)[0]
        if not flag.startswith("-"):
            raise UsageError(f"unexpected argument {arg!r}; options are written --name=value")
        if flag not in known and flag != "-h":
            near = suggest(flag, known).split(" choose from")[0].rstrip(";")
            raise UsageError(f"unknown option {flag}{near}; see {prog} --help")
    try:
        with _defaults_file(defaults(args) if defaults else {}) as path:
            parser.config_path = path
            config: C = parser.parse_args(args)
    except (DraccusException, argparse.ArgumentError, ValueError, TypeError) as error:
        raise UsageError(f"{' '.join(str(error).split())}; see {prog} --help") from error
    except OSError as error:
        raise UsageError(f"cannot read {error.filename}: {error.strerror}") from error
    return config


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


def _bare_flags_are_true(argv: Sequence[str]) -> list[str]:
    """Join ``--a b`` to ``--a=b`` and turn a lone ``--a`` into ``--a=true``."""
    out: list[str] = []
    for arg in argv:
        takes_value = bool(out) and out[-1].startswith("--") and "=" not in out[-1]
        if takes_value and not arg.startswith("--"):
            out[-1] += f"={arg}"
        else:
            out.append(arg)
    return [
        f"{a}=true" if a.startswith("--") and "=" not in a and a != "--help" else a for a in out
    ]


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
    debug = "--debug" in args
    epilog = (epilog + "\n" if epilog else "") + "--debug prints the traceback of an error."
    try:
        plain = [a for a in args if a != "--debug"]
        config = parse_config(config_class, plain, prog, epilog, defaults)
        run(config)
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        if error.errno not in _ENVIRONMENT_ERRNOS:
            raise
        failure = EnvironmentFailure(f"{error.strerror}: {error.filename or ''}".rstrip(": "))
        return _report(prog, failure, debug)
    except EgovcpError as error:
        return _report(prog, error, debug)
    return 0


_ENVIRONMENT_ERRNOS = {
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EADDRINUSE,
}


def _report(prog: str, error: EgovcpError, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"{prog}: error: {error}", file=sys.stderr)
    return error.exit_code


def save_config(config: Any, path: str) -> None:
    """Write the resolved config as YAML, so that a run can be repeated with ``--config_path``."""
    with open(path, "w", encoding="utf-8") as file:
        draccus.dump(config, file)
