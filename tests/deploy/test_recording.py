"""Which files the recording of a run consists of."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egovcp.log.tick import RunInfo, Tick
from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp_deploy.recording import LogOptions, missing_ticks, recording


def test_a_run_on_the_wall_clock_is_not_rendered(tmp_path: Path) -> None:
    depth, state, action = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM), np.zeros(ACTION_DIM)
    options = LogOptions(rrd=False, videos=1)
    with recording(tmp_path, RunInfo("ball"), options, None, blocking=False) as sink:
        sink.write(Tick(0, 0, depth, state, action, action))
    assert missing_ticks(sink) == {"rollout-0.mcap": 0}
    assert [path.name for path in tmp_path.iterdir()] == ["rollout-0.mcap"]
