"""Value maps and open-loop films of an untrained policy: the right moments, the right shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egovcp_experiment.studies import open_loop, value_maps
from egovcp_experiment.tools import read_json


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


def test_films_begin_with_what_was_filtered(flags: list[str], tmp_path: Path) -> None:
    assert open_loop.main([*flags, "--task=wall"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["episodes"] == 2
    for strip in found["strips"]:
        assert np.shape(strip["seen"]) == (len(open_loop.HORIZONS), 48, 64)
        assert np.shape(strip["foreseen"]) == np.shape(strip["seen"])
    assert found["errors_m"]["0"]["repeat"] == 0.0
    assert found["errors_m"]["16"]["model"] > 0.0


def test_the_ball_is_measured_where_it_is_seen(flags: list[str], tmp_path: Path) -> None:
    assert open_loop.main([*flags, "--task=ball"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["episodes"] == 2
    first = found["errors_m"]["0"]
    assert first["ball_images"] == 2
    assert first["repeat_ball"] == 0.0
    assert found["errors_m"]["4"]["repeat_ball"] > 0.3
    assert first["model_ball"] > 0.0


def test_errors_of_the_ball_are_those_of_its_pixels() -> None:
    ball = np.zeros((48, 64), bool)
    ball[10:14, 20:24] = True
    truth = np.where(ball, 2.0, 4.0)
    near, gone = truth + 0.1, np.zeros_like(truth)
    triples = [(near, truth, gone), (gone, truth, gone), (near, truth, truth)]
    found = open_loop.ball_errors(triples, [ball, ball, ball & False])
    assert found["ball_images"] == 2  # the third does not show it
    assert found["model_ball"] == pytest.approx((0.1 + 3.0) / 2)  # nothing in range: 5 m
    assert found["repeat_ball"] == pytest.approx(3.0)
    assert found["ball_detected"] == 0.5
    none = open_loop.ball_errors([], [])
    assert none["model_ball"] is none["ball_detected"] is None


def test_films_follow_the_actions_that_were_sent() -> None:
    """A model that counts: its picture k ticks ahead is the sum of the k actions sent."""
    import torch

    from egovcp.model import Carry

    class Counter:
        def decode(self, carry: Carry) -> tuple[torch.Tensor, None]:
            return carry.h.expand(1, 1, 1), None

        def imagine(self, carry: Carry, action: torch.Tensor) -> Carry:
            return Carry(carry.h + action[:, :1], carry.z)

    film = open_loop._Film(Carry(torch.zeros(1, 1), torch.zeros(1, 1)))
    film.sent = [np.full(7, float(k)) for k in range(16)]
    foreseen = open_loop._foreseen(Counter(), film)  # type: ignore[arg-type]
    assert foreseen[:, 0, 0].tolist() == [sum(range(k)) for k in open_loop.HORIZONS]
