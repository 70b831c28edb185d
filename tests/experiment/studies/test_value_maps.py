"""Value maps of an untrained policy: times and shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from egovcp_experiment.cell import read_json
from egovcp_experiment.studies import value_maps


def test_value_maps_are_taken_once_at_every_moment(flags: list[str], tmp_path: Path) -> None:
    assert value_maps.main([*flags, "--env.ball_episode.event_ticks=[11,11]"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert [m["moment"] for m in found["maps"]] == list(value_maps.MOMENTS)[: len(found["maps"])]
    assert len(found["maps"]) >= 5
    ticks = [m["tick"] for m in found["maps"]]
    assert ticks[:2] == [1, 11]  # 0.4 s before the throw, and at the throw
    assert ticks == sorted(set(ticks))
    shown = found["maps"][0]
    assert np.shape(shown["values"]) == (len(found["z"]), len(found["x"]))
    x, z = shown["best"]
    best = np.array(shown["values"])[found["z"].index(z), found["x"].index(x)]
    assert best == np.max(shown["values"])
    for shown in found["maps"]:
        for (low, high), ends in zip(shown["reach"], (found["x"], found["z"]), strict=True):
            assert ends[0] - 1e-6 <= low < high <= ends[-1] + 1e-6
            assert high - low < 0.5 * (ends[-1] - ends[0])
