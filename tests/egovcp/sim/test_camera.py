"""Depth images by ray casting, and the faults of the camera."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from egovcp.robot.geometry import pixel_rays
from egovcp.sim import camera as camera_module
from egovcp.sim.camera import DepthNoise, RayCastCamera, RayCaster, discontinuity
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_COLS, DEPTH_MAX_M, DEPTH_MIN_M, DEPTH_ROWS

NOISELESS = CameraConfig(
    position=(0.0, 0.0, 0.0),
    noise_per_z2=(0.0, 0.0),
    hole_probability=(0.0, 0.0),
    edge_probability=(0.0, 0.0),
)


def render_level(xml: str, pitch: float = 0.0) -> np.ndarray:
    """Depth seen from an invisible body at height 1 that looks along x."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><body name='eye' pos='0 0 1'><geom size='.01' group='3'/></body>"
        f"{xml}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return RayCastCamera(NOISELESS).render(RayCaster(model, model.body("eye").id), data, pitch)


def plate(x: float) -> str:
    return f"<geom type='box' pos='{x + 0.01} 0 1' size='0.01 20 20'/>"


def test_a_flat_wall_has_the_same_planar_depth_everywhere() -> None:
    np.testing.assert_allclose(render_level(plate(2.0)), 2.0, atol=1e-5)


@pytest.mark.parametrize("x", [DEPTH_MIN_M - 0.02, DEPTH_MAX_M + 0.02])
def test_what_is_out_of_range_reads_zero(x: float) -> None:
    assert not render_level(plate(x)).any()


def test_left_and_up_in_the_world_are_left_and_up_in_the_image() -> None:
    depth = render_level("<geom type='sphere' pos='2 0.5 1.4' size='0.1'/>")
    rows, columns = np.nonzero(depth)
    assert rows.max() < DEPTH_ROWS / 2
    assert columns.max() < DEPTH_COLS / 2


def test_pitching_down_raises_what_lies_ahead() -> None:
    ahead = "<geom type='sphere' pos='2 0 1' size='0.1'/>"
    level, tilted = (np.nonzero(render_level(ahead, pitch))[0].mean() for pitch in (0.0, 0.2))
    assert tilted < level - 3


def test_the_vertical_field_of_view_is_that_of_the_config() -> None:
    rays = pixel_rays(RayCastCamera(CameraConfig()).focal).reshape(DEPTH_ROWS, DEPTH_COLS, 3)
    pixel = rays[0, 0, 2] - rays[1, 0, 2]
    top = rays[0, 0, 2] + pixel / 2
    assert 2 * np.arctan(top) == pytest.approx(CameraConfig().vertical_fov)


def noisy(depth: float, seed: int = 0, **config: tuple[float, float]) -> np.ndarray:
    flat = np.full((DEPTH_ROWS, DEPTH_COLS), depth, dtype=np.float32)
    off = {"noise_per_z2": (0.0, 0.0), "hole_probability": (0.0, 0.0)}
    noise = DepthNoise(CameraConfig(**(off | config)), np.random.default_rng(seed))
    return noise.apply(flat)


def test_without_faults_a_measurement_is_the_depth_in_millimetres() -> None:
    assert (noisy(1.234) == 1234).all()


def test_noise_grows_with_the_square_of_depth() -> None:
    near, far = (noisy(z, noise_per_z2=(0.01, 0.01)).std() for z in (1.0, 2.0))
    assert far / near == pytest.approx(4.0, rel=0.1)


def test_holes_have_the_given_share() -> None:
    lost = (noisy(1.0, hole_probability=(0.2, 0.2)) == 0).mean()
    assert lost == pytest.approx(0.2, abs=0.03)


def test_edges_are_found_on_both_sides_of_a_jump_only() -> None:
    depth = np.full((4, 6), 2.0, dtype=np.float32)
    depth[:, 3:] = 1.0
    edge = discontinuity(depth, np.float32(0.12))
    assert edge.any(axis=0).tolist() == [False, False, True, True, False, False]


FLOOR = "<geom type='plane' size='0 0 1'/>"
SHAPES = {"sphere": 1, "capsule": 2, "box": 3, "cylinder": 2, "ellipsoid": 3}


def render_view(xml: str, position: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
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
@pytest.mark.parametrize("seed", range(4))
def test_images_equal_those_of_casting_every_ray(
    count: int, floor: str, seed: int, without_shortcuts: pytest.MonkeyPatch
) -> None:
    scene = clutter(np.random.default_rng(seed), count) + floor
    every = render_view(scene)
    without_shortcuts.undo()
    assert (render_view(scene) == every).all()


@pytest.mark.parametrize(
    "floor",
    [
        "<geom type='plane' size='0 0 1' euler='5 0 0'/>",
        "<geom type='plane' size='2 1 1'/>",
        "<body pos='0 0 0.2' euler='0 3 0'><geom type='plane' size='0 0 1'/></body>",
        FLOOR + "<geom type='plane' size='0 0 1' pos='0 0 .1'/>",
    ],
)
def test_other_floors_are_rendered(floor: str, without_shortcuts: pytest.MonkeyPatch) -> None:
    every = render_view(floor)
    assert every.any()
    without_shortcuts.undo()
    assert (render_view(floor) == every).all()


def test_a_camera_under_the_floor_does_not_see_it() -> None:
    assert not render_view(FLOOR, position=(0.0, 0.0, -1.0)).any()


def test_an_empty_scene_casts_no_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        camera_module.mujoco, "mj_multiRay", lambda *_: pytest.fail("rays were cast")
    )
    depth = render_view(FLOOR + "<geom size='.1' pos='-3 0 1'/>")
    assert 0 < depth.max() <= DEPTH_MAX_M
