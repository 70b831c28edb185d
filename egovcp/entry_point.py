"""Console entry points: signals, streams and environment are prepared before slow imports.

A distribution declares its commands in a module that imports nothing else::

    collect = EntryPoint("egovcp-collect", "egovcp_collect.collect")

and names them in its ``pyproject.toml``: ``egovcp-collect = "egovcp_collect.commands:collect"``.
``--version`` is answered here, before the command is imported.

Exit codes beyond those of `egovcp.errors`: 130 after Ctrl-C, 141 if the reader of the output has
closed it (``| head -1``), 1 with a traceback for a bug.

Several libraries swallow a KeyboardInterrupt during their import, or turn it into an ImportError.
Before the command starts, SIGINT ends the process at once. Afterwards, during an import, it is
delivered when the import is over.
"""

from __future__ import annotations

import errno
import os
import re
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # slow imports
    from collections.abc import Callable, Sequence
    from types import FrameType
    from typing import Any

INTERRUPTED = 130  # 128 + SIGINT, as a shell reports a program which that signal ended
_RETRY_S = 0.05
_IMPORT_MACHINERY = "<frozen importlib._bootstrap>"
BROKEN_PIPE = 141  # 128 + SIGPIPE, as a shell reports a program which that signal ended
#: Errors of writing to a stream.
_WRITE_ERRNOS = (errno.EAGAIN, errno.EBADF, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENOSPC)
#: Integers, without which `huggingface_hub` cannot be imported.
_HUB_VARIABLES = ("HF_HUB_DOWNLOAD_TIMEOUT", "HF_HUB_ETAG_TIMEOUT")
_TASK_FLAGS = tuple(f"--{name}" for name in ("task", "env.task"))  # the second is LeRobot's
_CLASS = re.compile(r"[\w.]+:\w+")  # package.module:Class


class EntryPoint:
    """A command whose module is imported when it is called."""

    def __init__(self, prog: str, module: str, task_argument: int | None = None) -> None:
        """The command ``prog``, which is ``module.main(argv) -> int``; the argument without a flag
        with number ``task_argument`` may name a task, as ``--task`` does."""
        self.prog, self.module, self._task_argument = prog, module, task_argument

    def __call__(self, argv: Sequence[str] | None = None) -> int:
        """Run the command on ``argv``, or on ``sys.argv``, and return its exit code."""
        exit_on_sigint(self.prog)
        prepare_process()
        from egovcp.errors import EnvironmentFailure
        from egovcp.terminal import discard_output, reader_is_gone

        try:
            return self._run(argv)
        except KeyboardInterrupt:
            return INTERRUPTED
        except BrokenPipeError:
            if reader_is_gone():
                discard_output()
                return BROKEN_PIPE
            return _report_bug()
        except OSError as error:
            if error.filename is not None or error.errno not in _WRITE_ERRNOS:
                return _report_bug()
            _print_last(f"{self.prog}: error: cannot write the output: {error}\n")
            return EnvironmentFailure.exit_code
        except Exception:  # noqa: BLE001 - a bug: print the traceback with escaped text
            return _report_bug()
        finally:
            exit_on_sigint(self.prog)  # while the interpreter ends

    def _run(self, argv: Sequence[str] | None) -> int:
        from importlib import import_module

        from egovcp.errors import EgovcpError
        from egovcp.terminal import echo, one_line

        if "--version" in (sys.argv[1:] if argv is None else argv):
            return self._print_version()
        try:
            _check_hub_variables()
            argv = self._with_task(sys.argv[1:] if argv is None else argv)
            main: Callable[[Sequence[str] | None], int] = import_module(self.module).main
            code = main(argv)
        except ModuleNotFoundError as error:
            return self._missing(error)
        except EgovcpError as error:  # of the environment, or of --task=module:Class
            echo(f"{self.prog}: error: {one_line(error)}", error=True)
            return error.exit_code
        except SystemExit as end:  # argparse, after --help
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        return code

    def _with_task(self, argv: Sequence[str]) -> list[str]:
        """The arguments with names of tasks for ``--task=package.module:Class``, or a list of them.

        Tasks are registered before the command is imported, so that it has their options.
        """
        args, task_at = list(argv), self._task_place(argv)
        for i, (previous, arg) in enumerate(zip(["", *args], argv, strict=False)):
            flag, equals, value = arg.partition("=")
            is_task = flag in _TASK_FLAGS
            if not equals:
                value, is_task = arg, previous in _TASK_FLAGS or i == task_at
            if ":" in value and is_task:
                from egovcp.sim.tasks.registry import register_task

                items = value.split(",")
                names = [register_task(item) if ":" in item else item for item in items]
                args[i] = arg.removesuffix(value) + ",".join(names)
        return args

    def _task_place(self, argv: Sequence[str]) -> int | None:
        """Index of the argument that names a task without a flag."""
        if self._task_argument is None:
            return None
        bare = ["", *(arg if arg.startswith("--") and "=" not in arg else "" for arg in argv)]
        places = [
            i
            for i, arg in enumerate(argv)
            if not arg.startswith("-") and bare[i] in ("", "--debug")
        ]
        if len(places) > self._task_argument:
            return places[self._task_argument]
        # Behind a switch, which looks like a flag with a value: options are not known yet.
        return next((i for i, arg in enumerate(argv) if _CLASS.fullmatch(arg)), None)

    def _print_version(self) -> int:
        from importlib import metadata

        from egovcp.terminal import echo

        distribution = self.module.partition(".")[0].replace("_", "-")
        echo(f"{self.prog} {metadata.version(distribution)}")
        return 0

    def _missing(self, error: ModuleNotFoundError) -> int:
        from egovcp.packages import missing_package
        from egovcp.terminal import echo

        missing = missing_package(error, self.module, self.prog)
        if missing is None:
            raise error
        echo(f"{self.prog}: error: {missing}", error=True)
        return missing.exit_code


def _check_hub_variables() -> None:
    from egovcp.errors import EnvironmentFailure

    for name in _HUB_VARIABLES:
        try:
            int(os.environ.get(name, "0"))
        except ValueError:
            raise EnvironmentFailure(
                f"{name}={os.environ[name]}: expected whole seconds; change or unset this variable"
            ) from None


def prepare_process() -> None:
    """Make standard streams, user name and home folder usable."""
    _open_standard_streams()
    _name_user()
    _escape_log_messages()


def _open_standard_streams() -> None:
    """Replace closed streams by the null device; escape characters that cannot be encoded."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:  # otherwise the next file that is opened would become stdout
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        reconfigure: Callable[..., Any] | None = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


def _name_user() -> None:
    """Set a user and a home folder if the system has none, as in `docker run --user 12345`.

    Otherwise some libraries raise KeyError or RuntimeError, also during import.
    """
    import pwd

    names = ("LOGNAME", "USER", "LNAME", "USERNAME")  # of getpass.getuser()
    try:
        pwd.getpwuid(os.getuid())
    except KeyError:
        if not any(os.environ.get(name) for name in names):
            os.environ["USER"] = f"user-{os.getuid()}"
    if os.path.expanduser("~") == "~":
        os.environ["HOME"] = "/"  # as Docker sets it for a user without an entry


def _escape_log_messages() -> None:
    """Escape control characters in log records, which may quote answers of servers."""
    import logging

    from egovcp.terminal import printable

    class PrintableRecord(logging.LogRecord):
        def getMessage(self) -> str:  # noqa: N802 - the name of the base class
            return printable(super().getMessage())

    logging.setLogRecordFactory(PrintableRecord)


def _report_bug() -> int:
    import traceback

    _print_last(traceback.format_exc())
    return 1


def _print_last(text: str) -> None:
    from contextlib import suppress

    from egovcp.terminal import discard_output, echo

    with suppress(OSError):  # stderr may be closed as well
        echo(text, error=True, end="")
    discard_output()


def exit_on_sigint(prog: str) -> None:
    """Exit at once on SIGINT: before the command has started, and after it has ended.

    Does nothing if SIGINT is ignored, as in a background job of a shell script.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        try:
            os.write(2, f"{prog}: interrupted\n".encode())
        finally:
            os._exit(INTERRUPTED)

    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, leave)


def raise_on_sigint() -> None:
    """Let SIGINT call `raise_interrupt`.

    Replaces only the handler of `exit_on_sigint`; other handlers stay in place.
    """
    if getattr(signal.getsignal(signal.SIGINT), "__module__", "") == __name__:
        signal.signal(signal.SIGINT, raise_interrupt)


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Signal handler: raise KeyboardInterrupt, delayed until a running import has finished."""
    import threading  # slow: after SIGINT is handled

    if not _is_importing(frame):
        raise KeyboardInterrupt
    main = threading.main_thread().ident
    retry = threading.Timer(_RETRY_S, signal.pthread_kill, [main, number])
    retry.daemon = True
    retry.start()


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT_MACHINERY:
            return True
        frame = frame.f_back
    return False


info = EntryPoint("egovcp-info", "egovcp.info")
