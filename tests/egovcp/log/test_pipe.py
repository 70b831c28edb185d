"""Messages arrive whole and in order, however little the pipe takes at a time."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection
from threading import Thread

import numpy as np
import pytest

from egovcp.log.writer_process import Outbox, enlarge, pack, receive


@pytest.mark.parametrize("large", [False, True])
def test_messages_arrive_complete_and_in_order(large: bool) -> None:
    rng = np.random.default_rng(0)
    messages = [rng.bytes(int(size)) for size in rng.integers(0, 300_000, 40)]
    reader, writer = os.pipe()
    if large:
        enlarge(writer)
    outbox = Outbox(writer)
    for message in messages:
        outbox.put(pack(message))
    arrived: list[bytes] = []
    with Connection(reader, writable=False) as connection:
        thread = Thread(target=lambda: arrived.extend(receive(connection)))
        thread.start()
        while len(outbox):
            outbox.pump()
        os.close(writer)
        thread.join(20)
    assert arrived == messages


def test_a_truncated_message_is_dropped() -> None:
    reader, writer = os.pipe()
    whole = pack("whole")
    os.write(writer, whole + b"\x00\x00\x00\x20half")
    os.close(writer)
    with Connection(reader, writable=False) as connection:
        assert list(receive(connection)) == ["whole"]


def test_a_closed_reader_raises_broken_pipe() -> None:
    reader, writer = os.pipe()
    outbox = Outbox(writer)
    os.close(reader)
    outbox.put(pack("hello"))
    with pytest.raises(BrokenPipeError):
        outbox.pump()
    os.close(writer)
