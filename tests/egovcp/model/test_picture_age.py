"""The floor tells how old pictures are; where none is seen nothing is told."""

import math

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import picture_age
from egovcp.model.camera_pose import CameraPose
from egovcp.model.config import AGES, FlightConfig
from egovcp.model.floor import LEVEL, Floor, floor
from egovcp.model.picture_age import at_ages, gathered, shares

CONFIG = FlightConfig()
HIGH = 0.5  # m, of the camera above the pelvis


def _pose(pitch: float) -> CameraPose:
    """Of a camera that looks so far down."""
    c, s = math.cos(pitch), math.sin(pitch)
    axes = torch.tensor([[[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]])
    return CameraPose(axes, torch.tensor([[0.0, 0.0, HIGH]]), torch.zeros(1))


def _picture(pose: CameraPose, wall: float = math.inf) -> Tensor:
    """Nearness (1, 48, 64) of a floor, and of a wall so far ahead."""
    rows, cols = spec.DEPTH_ROWS, spec.DEPTH_COLS
    focal = rows / 2 / CONFIG.camera.half_height
    up = -(torch.arange(rows) - (rows - 1) / 2)[:, None].expand(rows, cols) / focal
    left = -(torch.arange(cols) - (cols - 1) / 2).expand(rows, cols) / focal
    rays = torch.stack([torch.ones(rows, cols), left, up], -1) @ pose.axes[0].T
    down = torch.where(rays[..., 2] < 0, (LEVEL - HIGH) / rays[..., 2], math.inf)
    depth = torch.minimum(down, wall / rays[..., 0])
    return (1 - depth / spec.DEPTH_MAX_M).clamp(0.0, 1.0)[None]


@pytest.mark.parametrize("pitch", [0.0, 0.1, 0.3])
def test_the_middle_of_the_floors_pixels_lies_on_it(pitch: float) -> None:
    pose = _pose(pitch)
    seen = floor(_picture(pose), pose, spec.DEPTH_MAX_M, CONFIG.camera)
    assert seen.seen.all()
    on_ground = seen.point @ pose.axes[0].T + pose.position
    torch.testing.assert_close(on_ground[..., 2], torch.full((1, 2), LEVEL), atol=1e-3, rtol=0)
    assert on_ground[0, 0, 1] > 0.1 > -0.1 > on_ground[0, 1, 1]  # to the left, to the right


def test_a_wall_is_no_floor() -> None:
    pose = _pose(0.0)
    seen = floor(_picture(pose, wall=0.6), pose, spec.DEPTH_MAX_M, CONFIG.camera)
    assert not seen.seen.any()


def _sways(age: float, ticks: int) -> Tensor:
    """The shares (T, A) of somebody who sways and whose pictures are ``age`` s old."""

    def at(t: float) -> CameraPose:
        return _pose(0.1 + 0.03 * math.sin(2 * math.pi * 1.3 * t))

    poses = [at(k * spec.PLANNER_DT) for k in range(-2, ticks)]
    flat = torch.stack([torch.cat([p.axes.flatten(), p.position.flatten()]) for p in poses])
    history = torch.stack([flat[2:], flat[1:-1], flat[:-2]], 1)[None]  # (1, T, 3, 12)
    shown = [
        floor(_picture(at(k * spec.PLANNER_DT - age)), _pose(0.1), spec.DEPTH_MAX_M, CONFIG.camera)
        for k in range(ticks)
    ]
    seen = Floor(*(torch.stack(part, 1) for part in zip(*shown, strict=True)))
    first = torch.arange(ticks)[None] == 0
    evidence = torch.zeros(1, picture_age.SIZE)
    return shares(gathered(evidence, at_ages(history, CONFIG), seen, first, CONFIG), CONFIG)[0]


@pytest.mark.parametrize("which", range(AGES))
def test_who_sways_learns_the_age_and_who_has_just_begun_does_not_know_it(which: int) -> None:
    found = _sways(CONFIG.picture_ages[which], 30)
    torch.testing.assert_close(found.sum(-1), torch.ones(30))
    torch.testing.assert_close(found[1], torch.full((AGES,), 1 / AGES))
    assert int(found[-1].argmax()) == which
    assert found[-1, which] > found[5, which] > 0.25


def test_without_a_floor_all_ages_are_believed_alike() -> None:
    torch.testing.assert_close(
        shares(torch.zeros(2, 3, picture_age.SIZE), CONFIG), torch.full((2, 3, AGES), 1 / AGES)
    )
