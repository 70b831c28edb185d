"""Prints all terminal output of the commands, with control characters escaped.

Messages quote text from datasets, recordings, policies and servers, whose control characters could
move the cursor, change the window title or hide text.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterable
from typing import Any, Final

_KEPT: Final = "\n"


def printable(text: object, keep: str = _KEPT) -> str:
    r"""The text with backslash escapes for all characters neither printable nor in ``keep``.

    Control characters, bidirectional overrides, zero-width characters and bytes that are not UTF-8
    (surrogates) are escaped: ``"\x1b"`` becomes ``"\\x1b"``.
    """
    words = str(text)
    if words.isprintable():
        return words
    return "".join(c if c.isprintable() or c in keep else _escaped(c) for c in words)


def one_line(text: object) -> str:
    """As `printable`, with line breaks escaped too."""
    return printable(text, keep="")


def echo(text: object = "", *, error: bool = False, end: str = "\n") -> None:
    """Print a text to stdout, or to stderr for an error.

    Raises:
        BrokenPipeError: the reader of the output has closed it.
    """
    print(printable(text), file=sys.stderr if error else sys.stdout, end=end, flush=True)


def echo_lines(lines: Iterable[object]) -> None:
    """Print each text as one line."""
    echo("\n".join(one_line(line) for line in lines))


def reader_is_gone() -> bool:
    """Whether stdout or stderr is a pipe without a reader, as after ``| head -1``."""
    return any(_has_no_reader(stream) for stream in (sys.stdout, sys.stderr))


def _has_no_reader(stream: Any) -> bool:
    try:
        descriptor = stream.fileno()
    except (AttributeError, OSError, ValueError):  # none, closed, or captured by a test
        return False
    poll = select.poll()
    poll.register(descriptor, 0)  # errors are always reported
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def discard_output() -> None:
    """Discard unwritten output, so that the exit of the interpreter does not fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def _escaped(character: str) -> str:
    return character.encode("unicode_escape", "surrogatepass").decode("ascii")


def without_token(text: str) -> str:
    """The text without the user's Hub token, which the answer of a server may contain."""
    if "huggingface_hub" not in sys.modules:
        return text
    from huggingface_hub import get_token

    token = get_token()
    return text.replace(token, "<token>") if token else text
