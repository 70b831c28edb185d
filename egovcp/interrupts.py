"""SIGINT (Ctrl-C) while modules are imported.

Several libraries swallow a KeyboardInterrupt that is raised during their import, or turn it into an
ImportError: the command then runs on. Before a command has started its work nothing has to be
cleaned up, and the process exits. Afterwards the signal is delivered again once the import is over.
"""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:  # `typing` and `types` are not imported before SIGINT is handled
    from types import FrameType

EXIT_CODE = 130  # 128 + SIGINT, as a shell reports a program which that signal ended
_RETRY_S = 0.05
_IMPORT_MACHINERY = "<frozen importlib._bootstrap>"


def exit_on_sigint(prog: str) -> None:
    """End the process at once on SIGINT: while the command is imported, and when it has ended.

    Does nothing where SIGINT is ignored, as in a job that a shell script starts in the background.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        try:
            os.write(2, f"{prog}: interrupted\n".encode())
        finally:
            os._exit(EXIT_CODE)

    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, leave)


def raise_on_sigint() -> None:
    """Raise KeyboardInterrupt on SIGINT, never inside an import: while the command works.

    Replaces only the handler of `exit_on_sigint`, so that code which is called from elsewhere keeps
    its own.
    """
    import threading  # not before SIGINT is handled

    main = threading.main_thread().ident

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not _is_importing(frame):
            raise KeyboardInterrupt
        retry = threading.Timer(_RETRY_S, signal.pthread_kill, [main, signal.SIGINT])
        retry.daemon = True
        retry.start()

    if getattr(signal.getsignal(signal.SIGINT), "__module__", "") == __name__:
        signal.signal(signal.SIGINT, interrupt)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORT_MACHINERY:
            return True
        frame = frame.f_back
    return False
