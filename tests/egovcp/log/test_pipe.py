"""Messages arrive whole and in order, however little the pipe takes at a time."""

from __future__ import annotations

import os

import numpy as np
import pytest

from egovcp.log.pipe import Inbox, Outbox, enlarge, pack, receive


@pytest.mark.parametrize("large", [False, True])
def test_messages_arrive_complete_and_in_order(large: bool) -> None:
    rng = np.random.default_rng(0)
    messages = [rng.bytes(int(size)) for size in rng.integers(0, 300_000, 40)]
    reader, writer = os.pipe()
    if large:
        enlarge(writer)
    os.set_blocking(reader, False)
    outbox, inbox, arrived = Outbox(writer), Inbox(reader), []
    for number, message in enumerate(messages):
        outbox.put(pack(message))
        outbox.pump()
        if number < 20:
            arrived += list(inbox.ready())
    assert len(outbox) > 0
    while len(outbox):
        outbox.pump()
        arrived += list(inbox.ready())
    assert arrived == messages
    os.close(writer)
    with pytest.raises(EOFError):
        list(inbox.ready())
    os.close(reader)


def test_a_truncated_message_is_dropped() -> None:
    reader, writer = os.pipe()
    whole = pack("whole")
    os.write(writer, len(whole).to_bytes(4, "little") + whole + b"\x20\x00\x00\x00half")
    os.close(writer)
    assert list(receive(reader)) == ["whole"]
    os.close(reader)


def test_a_closed_reader_raises_broken_pipe() -> None:
    reader, writer = os.pipe()
    outbox = Outbox(writer)
    os.close(reader)
    outbox.put(pack("hello"))
    with pytest.raises(BrokenPipeError):
        outbox.pump()
    os.close(writer)
