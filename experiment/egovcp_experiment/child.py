"""A cell's process: ``python -m egovcp_experiment.child MODULE [--flags]`` runs ``MODULE.main``.

Its standard input is a pipe that nothing is ever written to. When the other end closes, because
the experiment is to stop or its process has died, the command is interrupted as by Ctrl-C: a
training keeps its checkpoint, a collection its episodes, and nothing runs on unseen.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading


def _interrupt_at_end_of_input() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGINT)


def main() -> int:
    """Entry point; returns the exit code of the command."""
    module, *argv = sys.argv[1:]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # Ray's workers block it
    threading.Thread(target=_interrupt_at_end_of_input, daemon=True).start()
    sys.argv = [module, *argv]
    try:
        return int(importlib.import_module(module).main(argv))
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
