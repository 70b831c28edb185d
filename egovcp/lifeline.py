"""Processes that must not outlive the one that needs them, however that one ends.

`kill -9` leaves a program no time to end its children, so the kernel is asked to. Run as a
script, with the number of its parent and a command, this file becomes that command.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

_PR_SET_PDEATHSIG: Final = 1


def die_with_parent(parent: int) -> None:
    """Have this process killed when ``parent``, which started it, ends.

    Linux only; elsewhere nothing happens. What counts is the end of the *thread* that started
    this process, so start it from one that lasts, such as the main thread.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the kernel was told
        os.kill(os.getpid(), signal.SIGKILL)


def command(program: str, *arguments: str) -> list[str]:
    """How to start ``program`` so that it ends with this process."""
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), program, *arguments]


def main() -> None:
    """Entry point."""
    parent, program, *arguments = sys.argv[1:]
    die_with_parent(int(parent))
    os.execv(program, [program, *arguments])


if __name__ == "__main__":
    main()
