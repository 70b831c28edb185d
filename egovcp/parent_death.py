"""Child processes that the kernel kills when their parent ends, even by SIGKILL.

Run as a script with the parent's process id and a command, this file executes that command.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

_PR_SET_PDEATHSIG: Final = 1


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when ``parent`` ends; does nothing outside Linux.

    The signal comes when the *thread* that started this process ends, so start it from the main
    thread.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before prctl
        os.kill(os.getpid(), signal.SIGKILL)


def command(program: str, *arguments: str) -> list[str]:
    """Command line that runs ``program`` until this process ends."""
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), program, *arguments]


def main() -> None:
    parent, program, *arguments = sys.argv[1:]
    die_with_parent(int(parent))
    os.execv(program, [program, *arguments])


if __name__ == "__main__":
    main()
