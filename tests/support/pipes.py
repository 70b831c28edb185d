"""Pipes that block their writer."""

import os
from contextlib import suppress


def full_pipe() -> tuple[int, int]:
    """File descriptors of reader and writer of a pipe that takes no byte more."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(1 << 16))
    os.set_blocking(writer, True)
    return reader, writer
