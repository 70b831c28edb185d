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


def command(program: str, *arguments: str) -> list[str]:
    """Command line that runs ``program`` until this process ends; outside Linux, without limit.

    The signal comes when the *thread* that started the program ends, so start it from the main
    thread.
    """
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), program, *arguments]


def main() -> None:
    parent, program, *arguments = sys.argv[1:]
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != int(parent):  # it ended before prctl
            os.kill(os.getpid(), signal.SIGKILL)
    os.execv(program, [program, *arguments])


if __name__ == "__main__":
    main()
