"""`Fanout` forwards every call to all sinks and closes all of them even if one raises."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from egovcp.log.tick import Fanout, RunInfo
from tests.support.sinks import FaultySink


def test_every_sink_receives_every_call_in_order(make_tick: Any, tmp_path: Path) -> None:
    sinks = [FaultySink(tmp_path / name) for name in "ab"]
    with closing(Fanout(sinks)) as fanout:
        fanout.open(RunInfo("ball"))
        fanout.write(make_tick(0, bare=True))
        fanout.write(make_tick(1, bare=True))
    calls = [sink.path.read_text().splitlines() for sink in sinks]
    assert calls == [["open ball", "tick 0", "tick 1", "close"]] * 2


@pytest.mark.parametrize("broken", ["a", "b"])
def test_all_sinks_are_closed_even_if_one_fails(broken: str, tmp_path: Path) -> None:
    sinks = [FaultySink(tmp_path / name, fail_on_close=name == broken) for name in "ab"]
    with pytest.raises(OSError, match=f"No space left on device.*{broken}"):
        Fanout(sinks).close()
    assert [sink.path.read_text() for sink in sinks] == ["close\n"] * 2
