"""Masks cover the ball in images of any age."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egovcp.sim.config import CameraConfig, DelayConfig, EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp_experiment.studies.ball_masks import BallMasks

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
    env, masks = VectorEnv(config, 3), BallMasks(config)
    images = [env.reset([Scenario("ball", 5, i) for i in range(3)]).depth]
    overlaps = []
    for tick in range(_EVENT + 12):
        masks.update(env)
        found = np.stack([masks.mask(env, row, images[-1][row]) for row in range(3)])
        if tick < _EVENT:
            assert not found.any()
        elif tick > _EVENT + 3:
            far = np.where(images[0] > 0, images[0], 5000).astype(float)
            nearer = (images[-1] > 0) & (far - images[-1] > 200)
            overlaps.append((found & nearer).sum() / (found | nearer).sum())
        images.append(env.step(np.zeros((3, 7))).observation.depth)
    assert len(overlaps) == 8
    assert np.mean(overlaps) > 0.8
