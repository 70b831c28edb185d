from __future__ import annotations

import mujoco
import numpy as np
import pytest

from egovcp.sim import camera as camera_module
from egovcp.sim.camera import RayCastCamera, RayCaster
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_MAX_M

FLOOR = "<geom type='plane' size='0 0 1'/>"
SHAPES = {"sphere": 1, "capsule": 2, "box": 3, "cylinder": 2, "ellipsoid": 3}


def picture(xml: str, position: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Depth seen by a camera that looks along x, a little upwards and to the left."""
    where = " ".join(map(str, position))
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body name='eye' pos='{where}' euler='5 -4 8'>"
        f"<geom size='.3' group='3'/></body>{xml}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = RayCastCamera(CameraConfig(position=(0.0, 0.0, 0.0)))
    return camera.render(RayCaster(model, model.body("eye").id), data, 0.05)


@pytest.fixture
def without_shortcuts(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Undone, all rays go to MuJoCo."""
    monkeypatch.setattr(camera_module, "_level_floor", lambda model, planes: None)
    return monkeypatch


def clutter(rng: np.random.Generator, count: int) -> str:
    """Things of all shapes around the camera: in view, at its edges, behind, on top of it."""
    found = []
    for i in range(count):
        shape = rng.choice(list(SHAPES))
        size = rng.uniform(0.02, 0.5, SHAPES[shape])
        position, turn = rng.uniform([-1, -1.5, 0], [3, 1.5, 2]), rng.uniform(-180, 180, 3)
        words = [" ".join(map(str, values)) for values in (size, position, turn)]
        found.append(
            f"<body pos='{words[1]}' euler='{words[2]}'>"
            f"<geom type='{shape}' size='{words[0]}' group='{3 * (i % 2)}'/></body>"
        )
    return "".join(found)


@pytest.mark.parametrize("count", [1, 6])
@pytest.mark.parametrize("floor", ["", FLOOR])
@pytest.mark.parametrize("seed", range(12))
def test_pictures_are_those_of_casting_every_ray(
    count: int, floor: str, seed: int, without_shortcuts: pytest.MonkeyPatch
) -> None:
    scene = clutter(np.random.default_rng(seed), count) + floor
    every = picture(scene)
    without_shortcuts.undo()
    assert (picture(scene) == every).all()


@pytest.mark.parametrize(
    "floor",
    [
        "<geom type='plane' size='0 0 1' euler='5 0 0'/>",
        "<geom type='plane' size='2 1 1'/>",
        "<body pos='0 0 0.2' euler='0 3 0'><geom type='plane' size='0 0 1'/></body>",
        FLOOR + "<geom type='plane' size='0 0 1' pos='0 0 .1'/>",
    ],
)
def test_other_floors_are_seen_too(floor: str, without_shortcuts: pytest.MonkeyPatch) -> None:
    every = picture(floor)
    assert every.any()
    without_shortcuts.undo()
    assert (picture(floor) == every).all()


def test_a_camera_under_the_floor_does_not_see_it() -> None:
    assert not picture(FLOOR, position=(0.0, 0.0, -1.0)).any()


def test_an_empty_picture_needs_no_ray_of_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        camera_module.mujoco, "mj_multiRay", lambda *_: pytest.fail("rays were cast")
    )
    depth = picture(FLOOR + "<geom size='.1' pos='-3 0 1'/>")
    assert 0 < depth.max() <= DEPTH_MAX_M
