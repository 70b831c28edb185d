"""The fan-out reaches every sink, also when one of them fails."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import pytest

from egovcp.log.sink import Fanout
from egovcp.log.tick import RunInfo, Tick


class Memory:
    """A sink that remembers its calls and may fail to close."""

    def __init__(self, broken: bool = False) -> None:
        self.calls: list[object] = []
        self.broken = broken

    def open(self, info: RunInfo) -> None:
        self.calls.append(info.task)

    def write(self, tick: Tick) -> None:
        self.calls.append(tick.index)

    def close(self) -> None:
        self.calls.append("closed")
        if self.broken:
            raise OSError("disk full")


def test_every_sink_sees_every_call_in_order(make_tick: Any) -> None:
    sinks = [Memory(), Memory()]
    with closing(Fanout(sinks)) as fanout:
        fanout.open(RunInfo("ball"))
        fanout.write(make_tick(0, bare=True))
        fanout.write(make_tick(1, bare=True))
    assert [sink.calls for sink in sinks] == [["ball", 0, 1, "closed"]] * 2


@pytest.mark.parametrize("broken", [0, 1])
def test_all_sinks_are_closed_although_one_fails(broken: int) -> None:
    sinks = [Memory(broken == 0), Memory(broken == 1)]
    with pytest.raises(OSError, match="disk full"):
        Fanout(sinks).close()
    assert [sink.calls for sink in sinks] == [["closed"]] * 2
