"""A graceful end after Ctrl-C: what is done is kept, a second Ctrl-C ends the command at once."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator


@contextlib.contextmanager
def stop_on_signal(echo_s: float = 0.0) -> Iterator[list[int]]:
    """A list that fills when SIGINT or SIGTERM asks for the end; a second one interrupts at once.

    Enter it on the main thread. The block looks at the list, keeps what is done, and raises
    KeyboardInterrupt afterwards.

    Args:
        echo_s: seconds during which a second one is taken for the first: a launcher hands on to
            its processes the Ctrl-C that the terminal has already sent them.
    """
    received: list[int] = []
    ignored_until = 0.0

    def note(number: int, frame: object) -> None:
        nonlocal ignored_until
        if not received:
            received.append(number)
            ignored_until = time.monotonic() + echo_s
        elif time.monotonic() >= ignored_until:
            raise KeyboardInterrupt

    previous = {s: signal.signal(s, note) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
