"""Open-loop images of an untrained policy, and the ball's pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp.model import Carry
from egovcp.sim.config import CameraConfig, DelayConfig, EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp_experiment.cell import read_json
from egovcp_experiment.studies import open_loop


def test_images_start_at_the_filtered_state(flags: list[str], tmp_path: Path) -> None:
    assert open_loop.main([*flags, "--task=wall"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["episodes"] == 2
    for strip in found["strips"]:
        assert np.shape(strip["seen"]) == (len(open_loop.HORIZONS), 48, 64)
        assert np.shape(strip["foreseen"]) == np.shape(strip["seen"])
    assert found["errors_m"]["0"]["repeat"] == 0.0
    assert found["errors_m"]["16"]["model"] > 0.0


def test_errors_on_the_ball_need_it_to_be_visible(flags: list[str], tmp_path: Path) -> None:
    assert open_loop.main([*flags, "--task=ball"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["episodes"] == 2
    first = found["errors_m"]["0"]
    assert first["ball_images"] == 2
    assert first["repeat_ball"] == 0.0
    assert found["errors_m"]["4"]["repeat_ball"] > 0.3
    assert first["model_ball"] > 0.0


def test_errors_on_the_ball_use_its_pixels_only() -> None:
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


def test_imagination_follows_the_actions_that_were_sent() -> None:
    """A model that counts: its picture k ticks ahead is the sum of the k actions sent."""

    class Counter:
        def decode(self, carry: Carry) -> tuple[torch.Tensor, None]:
            return carry.h.expand(1, 1, 1), None

        def imagine(self, carry: Carry, action: torch.Tensor) -> Carry:
            return Carry(carry.h + action[:, :1], carry.z)

    clip = open_loop._Clip(Carry(torch.zeros(1, 1), torch.zeros(1, 1)))
    clip.sent = [np.full(7, float(k)) for k in range(16)]
    foreseen = open_loop._imagine(Counter(), clip)  # type: ignore[arg-type]
    assert foreseen[:, 0, 0].tolist() == [sum(range(k)) for k in open_loop.HORIZONS]


_EVENT = 6  # tick of the throw


@pytest.mark.parametrize("age", [0.02, 0.06, 0.08])
def test_masks_cover_the_ball(age: float) -> None:
    """The robot holds its pose, so that the ball is all that comes nearer after the throw."""
    usual, none = EnvConfig(controller="stance"), (0.0, 0.0)
    config = replace(
        usual,
        camera=CameraConfig(noise_per_z2=none, hole_probability=none, edge_probability=none),
        delay=DelayConfig(image_age=(age, age)),
        ball_episode=replace(
            usual.ball_episode, event_ticks=(_EVENT, _EVENT), empty_probability=0.0
        ),
    )
    env, masks = VectorEnv(config, 3), open_loop.BallMasks(config)
    images = [env.reset([Scenario("ball", 5, i) for i in range(3)]).depth]
    overlaps = []
    for tick in range(_EVENT + 12):
        masks.update(env.privileged_state())
        found = np.stack(
            [
                masks.mask(row, int(env.parameters[row]["image_age_ticks"]), images[-1][row])
                for row in range(3)
            ]
        )
        if tick < _EVENT:
            assert not found.any()
        elif tick > _EVENT + 3:
            far = np.where(images[0] > 0, images[0], 5000).astype(float)
            nearer = (images[-1] > 0) & (far - images[-1] > 200)
            overlaps.append((found & nearer).sum() / (found | nearer).sum())
        images.append(env.step(np.zeros((3, 7))).observation.depth)
    assert len(overlaps) == 8
    assert np.mean(overlaps) > 0.8
