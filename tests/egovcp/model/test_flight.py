"""The filter that follows what is thrown: it finds the path, whatever the robot does meanwhile."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from egovcp import spec
from egovcp.data.mirror import mirror_state
from egovcp.model import flight
from egovcp.model.camera_pose import CameraPose, camera_pose, earlier
from egovcp.model.config import FlightConfig
from egovcp.model.floor import LEVEL, Floor
from egovcp.robot.kinematics import LINK_NAMES, heading_rotation, link_transforms

CONFIG = FlightConfig()
DT = spec.PLANNER_DT
GRAVITY = torch.tensor([0.0, 0.0, -9.81])
NO_FLOOR = Floor(torch.zeros(1, 2, 3), torch.zeros(1, 2))


class Throw(NamedTuple):
    """From `start` (m) at `velocity` (m/s), in the heading frame of a robot that never turns."""

    start: tuple[float, float, float] = (3.0, 0.3, 0.5)
    velocity: tuple[float, float, float] = (-3.6, -0.2, 3.4)

    def at(self, t: float) -> Tensor:
        s, v = torch.tensor(self.start), torch.tensor(self.velocity)
        return s + v * t + 0.5 * GRAVITY * t * t

    @property
    def crossing(self) -> tuple[float, float, float]:
        """y, z (m) and time (s)."""
        t = (CONFIG.plane - self.start[0]) / self.velocity[0]
        y, z = self.at(t)[1:].tolist()
        return y, z, t


def _standing(rng: np.random.Generator, sway: float) -> Tensor:
    """A state (1, 74) of somebody who sways: gravity, waist and knees."""
    state = np.zeros((1, spec.STATE_DIM), np.float32)
    tilt = rng.normal(0, sway, 2)
    down = np.array([-math.sin(tilt[0]), -math.sin(tilt[1]), -1.0])
    state[0, spec.STATE_SLICES["projected_gravity"]] = down / np.linalg.norm(down)
    joints = state[0, spec.STATE_SLICES["joint_position"]]
    joints[12:15] = rng.normal(0, sway, 3)
    joints[[3, 9]] = abs(rng.normal(0, 3 * sway))
    return torch.from_numpy(state)


def _turned(pose: CameraPose, angle: float) -> CameraPose:
    """The same camera seen from a frame that stays put."""
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return CameraPose(turn @ pose.axes, pose.position @ turn.T, pose.yaw_rate)


class World(NamedTuple):
    """What a robot lives through: its states, and a camera whose pictures are late."""

    sway: float = 0.0  # rad
    yaw_rate: float = 0.0  # rad/s
    age: float = 0.06  # s, of a picture
    watched: int = 0  # ticks before the throw, in which the floor is seen

    def states(self, ticks: int) -> list[Tensor]:
        rng = np.random.default_rng(0)
        quiet = [_standing(rng, 0.0)] if self.watched == 0 else []
        return [*quiet, *(_standing(rng, self.sway) for _ in range(self.watched + ticks))]


def _follow(throw: Throw, ticks: int, world: World = World()) -> Tensor:  # noqa: B008
    """The memory (1, ...) after so many pictures of a throw."""
    states = world.states(ticks)
    rate = torch.tensor([world.yaw_rate])
    poses = [camera_pose(s, CONFIG.camera)._replace(yaw_rate=rate) for s in states]
    ground = [_turned(pose, world.yaw_rate * DT * k) for k, pose in enumerate(poses)]
    memory = torch.zeros(1, flight.SIZE)
    thrown = len(states) - ticks
    for k, pose in enumerate(poses):
        axes, position = _earlier(ground, k, world.age / DT)
        at = throw.at((k - thrown) * DT) - position
        point = torch.linalg.solve(axes, at[..., None])[..., 0]
        seen = flight.Sighting(point, torch.full((1,), 1e3 * (k >= thrown)))
        below = torch.tensor([[2.5, 0.6, LEVEL], [2.5, -0.6, LEVEL]]) - position
        floor = Floor((below @ axes.mT.inverse()), torch.full((1, 2), float(world.watched > 0)))
        memory = flight.follow(memory, pose, seen, floor, torch.tensor([k == 0]), CONFIG)
    return memory


def _earlier(ground: list[CameraPose], k: int, ticks: float) -> tuple[Tensor, Tensor]:
    """Axes and position of the camera so long before tick k."""
    before = max(k - int(ticks), 0)
    part = ticks - int(ticks)
    a, b = ground[before], ground[max(before - 1, 0)]
    return torch.lerp(a.axes, b.axes, part), torch.lerp(a.position, b.position, part)


@pytest.mark.parametrize("sway", [0.0, 0.05])
@pytest.mark.parametrize("yaw_rate", [0.0, 0.4])
def test_the_crossing_is_found_whatever_the_robot_does(sway: float, yaw_rate: float) -> None:
    throw, ticks, world = Throw(), 12, World(sway, yaw_rate, watched=10)
    told = _follow(throw, ticks, world)[0, flight.TOLD]
    angle = yaw_rate * DT * (world.watched + ticks - 1)  # the plane turns with the robot
    c, s = math.cos(angle), math.sin(angle)
    now = (ticks - 1) * DT + world.age
    t = torch.linspace(0, 1.5, 15001)
    path = torch.stack([throw.at(float(x)) for x in t])
    k = int((c * path[:, 0] + s * path[:, 1] - CONFIG.plane).abs().argmin())
    y = float(-s * path[k, 0] + c * path[k, 1])
    assert told[0] > 0.9
    assert abs(float(told[1]) - y) < 0.05
    assert abs(float(told[2]) - float(path[k, 2])) < 0.05
    assert abs(float(told[3]) - (float(t[k]) - now)) < 0.02


def test_who_has_watched_the_floor_knows_how_old_pictures_are_and_where_a_ball_goes() -> None:
    still = _follow(Throw(), 8)[0, 1:3]

    def swayed(age: float, watched: int) -> float:
        told = _follow(Throw(), 8, World(0.03, age=age, watched=watched))
        return float((told[0, 1:3] - still).norm())

    blind, watching = ([swayed(age, n) for age in CONFIG.picture_ages] for n in (0, 20))
    assert max(watching) < 0.002
    assert min(blind) > 0.004


def test_more_pictures_make_it_surer() -> None:
    sure = [float(_follow(Throw(), ticks)[0, 0]) for ticks in (1, 3, 6, 12)]
    assert sure == sorted(sure)
    assert 0 < sure[0] < 0.2
    assert sure[-1] > 0.9


def test_one_picture_tells_little_more_than_the_mean_of_all_throws() -> None:
    told = _follow(Throw(velocity=(-3.6, 1.0, 3.4)), 1)[0]
    (y, _), (z, _) = CONFIG.aim
    assert abs(float(told[1]) - y) < 0.1
    assert abs(float(told[2]) - z) < 0.1


def test_in_a_mirror_it_passes_on_the_other_side() -> None:
    here, there = _follow(Throw(), 8), _follow(Throw((3.0, -0.3, 0.5), (-3.6, 0.2, 3.4)), 8)
    torch.testing.assert_close(here[0, 1], -there[0, 1], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(here[0, [0, 2, 3]], there[0, [0, 2, 3]], atol=1e-4, rtol=1e-4)


def _nothing(memory: Tensor, ticks: int) -> Tensor:
    pose = camera_pose(_standing(np.random.default_rng(0), 0.0), CONFIG.camera)
    unseen = flight.Sighting(torch.ones(1, 3), torch.zeros(1))
    for _ in range(ticks):
        memory = flight.follow(memory, pose, unseen, NO_FLOOR, torch.tensor([False]), CONFIG)
    return memory


def test_where_nothing_flies_nothing_is_told() -> None:
    assert not _nothing(torch.zeros(1, flight.SIZE), 20)[:, flight.TOLD].any()


def test_a_path_is_remembered_while_its_thing_is_out_of_sight_and_forgotten_after() -> None:
    memory = _follow(Throw(), 8)
    unseen = _nothing(memory, 4)
    assert abs(float(unseen[0, 3]) - (float(memory[0, 3]) - 4 * DT)) < 1e-4
    torch.testing.assert_close(unseen[0, :3], memory[0, :3], atol=0.05, rtol=0)
    gone = _nothing(memory, 30)
    assert not gone[:, flight.TOLD].any()
    assert not gone[:, flight.SUMS].any()


def test_a_flicker_beside_the_path_is_none_of_it() -> None:
    memory = _follow(Throw(), 8)
    pose = camera_pose(_standing(np.random.default_rng(0), 0.0), CONFIG.camera)
    flicker = flight.Sighting(torch.tensor([[2.0, -1.5, 0.0]]), torch.tensor([1e3]))
    after = flight.follow(memory, pose, flicker, NO_FLOOR, torch.tensor([False]), CONFIG)
    torch.testing.assert_close(after, _nothing(memory, 1))


def test_an_episode_begins_with_nothing_even_after_what_is_no_number() -> None:
    pose = camera_pose(_standing(np.random.default_rng(0), 0.0), CONFIG.camera)
    seen = flight.Sighting(torch.tensor([[3.0, 0.0, 0.0]]), torch.tensor([1e3]))
    first = torch.tensor([True])
    memories = (torch.zeros(1, flight.SIZE), torch.full((1, flight.SIZE), torch.nan))
    fresh, healed = (flight.follow(m, pose, seen, NO_FLOOR, first, CONFIG) for m in memories)
    assert torch.equal(fresh, healed)


def test_following_tick_by_tick_equals_following_all_at_once() -> None:
    rng = np.random.default_rng(1)
    torch.manual_seed(1)
    size, ticks = 4, 25
    states = torch.cat([_standing(rng, 0.05) for _ in range(size * ticks)])
    pose = camera_pose(states, CONFIG.camera)._replace(yaw_rate=0.5 * torch.randn(size * ticks))
    pose = CameraPose(*(x.view(size, ticks, *x.shape[1:]) for x in pose))
    t = DT * torch.arange(ticks) % 1.0
    path = torch.stack([3.0 - 3.6 * t, 0.3 - 0.2 * t, 0.1 + 3.4 * t - 4.9 * t * t], -1)
    seen = flight.Sighting(
        path + 0.1 * torch.randn(size, ticks, 3), 1e3 * (torch.rand(size, ticks) < 0.6)
    )
    first = torch.rand(size, ticks) < 0.1
    height = LEVEL + 0.01 * torch.randn(size, ticks, 2, 1)
    floor = Floor(
        torch.cat([2.0 + torch.rand(size, ticks, 2, 2), height], -1), torch.ones(size, ticks, 2)
    )
    begun = 3.0 * first[:, :1] * torch.ones(size, flight.SIZE)  # of an episode before
    together = flight.follow_all(begun, pose, seen, floor, first, CONFIG)
    memory = begun
    for k in range(ticks):
        now = (
            CameraPose(*(x[:, k] for x in pose)),
            flight.Sighting(*(x[:, k] for x in seen)),
            Floor(*(x[:, k] for x in floor)),
        )
        memory = flight.follow(memory, *now, first[:, k], CONFIG)
        torch.testing.assert_close(together[:, k], memory)
    assert 0.1 < (together[..., 0] > 0).float().mean() < 0.9


def test_later_is_what_nothing_seen_meanwhile_tells() -> None:
    memory = _follow(Throw(), 8)
    torch.testing.assert_close(
        flight.later(memory, 3)[0, flight.TOLD],
        _nothing(memory, 3)[0, flight.TOLD],
        atol=0.02,
        rtol=0,
    )
    assert not flight.later(memory, 50)[0, flight.TOLD].any()
    assert torch.equal(flight.later(memory[:, :4]), flight.later(memory)[:, :4])


@pytest.mark.parametrize("off", [(0.0, 0.0), (1.5, -1.0)])
def test_the_pixels_say_where_it_is_better_than_the_encoder(off: tuple[float, float]) -> None:
    """A ball of 0.1 m, 2 m ahead, 0.3 m to the left and 0.2 m up, before a far wall."""
    focal = spec.DEPTH_ROWS / 2 / CONFIG.camera.half_height
    column = (spec.DEPTH_COLS - 1) / 2 - 0.3 / 2.0 * focal
    row = (spec.DEPTH_ROWS - 1) / 2 - 0.2 / 2.0 * focal
    rows, cols = torch.meshgrid(
        torch.arange(float(spec.DEPTH_ROWS)), torch.arange(float(spec.DEPTH_COLS)), indexing="ij"
    )
    away = torch.hypot(rows - row, cols - column) / focal * 2.0
    depth = torch.where(away < 0.1, 1.9, 4.5)
    near = (1 - depth / spec.DEPTH_MAX_M)[None]
    sight = torch.tensor(
        [
            [
                2 * (column + off[0]) / (spec.DEPTH_COLS - 1) - 1,
                2 * (row + off[1]) / (spec.DEPTH_ROWS - 1) - 1,
                1 - 1.85 / spec.DEPTH_MAX_M,
                4.0,
            ]
        ]
    )
    seen = flight.sighting(near, sight, spec.DEPTH_MAX_M, CONFIG)
    torch.testing.assert_close(seen.point[0], torch.tensor([2.0, 0.3, 0.2]), atol=0.02, rtol=0)
    unsure = flight.sighting(
        near, sight - torch.tensor([0.0, 0.0, 0.0, 5.0]), spec.DEPTH_MAX_M, CONFIG
    )
    assert seen.weight > 0
    assert unsure.weight == 0


def test_of_many_pictures_those_that_show_nothing_are_passed_over() -> None:
    generator = torch.Generator().manual_seed(0)
    near = torch.rand((80, spec.DEPTH_ROWS, spec.DEPTH_COLS), generator=generator)
    sight = torch.randn((80, 4), generator=generator)
    many = flight.sighting(near, sight, spec.DEPTH_MAX_M, CONFIG)
    few = [
        flight.sighting(near[k : k + 8], sight[k : k + 8], spec.DEPTH_MAX_M, CONFIG)
        for k in range(0, 80, 8)
    ]
    assert 20 < (many.weight > 0).sum() < 60
    for whole, parts in zip(many, zip(*few, strict=True), strict=True):
        assert torch.equal(whole, torch.cat(parts))


def test_the_camera_is_where_kinematics_says() -> None:
    rng = np.random.default_rng(1)
    state = torch.cat([_standing(rng, 0.2) for _ in range(5)])
    pose = camera_pose(state, CONFIG.camera)
    numbers = state.numpy().astype(np.float64)
    position, rotation = link_transforms(numbers[:, spec.STATE_SLICES["joint_position"]])
    level = heading_rotation(numbers[:, spec.STATE_SLICES["projected_gravity"]])
    torso = LINK_NAMES.index("torso_link")
    mount = position[:, torso] + rotation[:, torso] @ np.array(CONFIG.camera.position)
    seen = np.einsum("nij,nj->ni", level, mount)
    np.testing.assert_allclose(pose.position[:, :2], seen[:, :2], atol=1e-5)
    forward = np.einsum("nij,njk->nik", level, rotation[:, torso])[..., 0]
    c, s = math.cos(CONFIG.camera.pitch), math.sin(CONFIG.camera.pitch)
    up = np.einsum("nij,njk->nik", level, rotation[:, torso])[..., 2]
    np.testing.assert_allclose(pose.axes[..., 0], c * forward - s * up, atol=1e-5)


def test_who_squats_has_a_lower_camera() -> None:
    upright, squat = (torch.zeros(1, spec.STATE_DIM) for _ in range(2))
    for state in (upright, squat):
        state[:, spec.STATE_SLICES["projected_gravity"]] = torch.tensor([0.0, 0.0, -1.0])
    joints = squat[:, spec.STATE_SLICES["joint_position"]]
    for hip, knee, ankle in ((0, 3, 4), (6, 9, 10)):
        joints[:, hip], joints[:, knee], joints[:, ankle] = -0.5, 1.0, -0.5
    high, low = (camera_pose(s, CONFIG.camera).position[0, 2] for s in (upright, squat))
    assert 0.05 < float(high - low) < 0.15


def test_the_camera_of_the_mirrored_robot_is_mirrored() -> None:
    state = torch.cat([_standing(np.random.default_rng(3), 0.2) for _ in range(4)])
    there = torch.from_numpy(mirror_state(state.numpy()).astype(np.float32))
    a, b = camera_pose(state, CONFIG.camera), camera_pose(there, CONFIG.camera)
    flip = torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(a.position * flip, b.position, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(a.axes * flip[:, None] * flip, b.axes, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("ahead", [0, 4])
def test_it_is_painted_where_the_camera_will_see_it(ahead: int) -> None:
    throw, ticks = Throw(), 8
    memory = flight.later(_follow(throw, ticks), ahead)
    state = _standing(np.random.default_rng(0), 0.0)
    pose = camera_pose(state, CONFIG.camera)
    place = throw.at((ticks - 1 + ahead) * DT) - pose.position[0]
    x, left, up = (pose.axes[0].T @ place).tolist()
    seen = flight.in_picture(memory, state, spec.DEPTH_MAX_M, CONFIG)[0]
    half = CONFIG.camera.half_height
    assert abs(float(seen[0]) * half * 4 / 3 * x + left) < 0.03
    assert abs(float(seen[1]) * half * x + up) < 0.03
    assert abs((1 - float(seen[2])) * spec.DEPTH_MAX_M - (x - CONFIG.radius)) < 0.03
    assert seen[3] > 0
    unsure = flight.in_picture(_follow(throw, 1), state, spec.DEPTH_MAX_M, CONFIG)
    assert unsure[0, 3] < 0


def test_a_state_is_wound_back_by_its_own_velocities() -> None:
    """A body that turns about a fixed axis while its joints move evenly."""
    axis, rate, age = np.array([0.4, -0.7, 0.2]), 0.8, 0.06

    def state(t: float) -> Tensor:
        out = np.zeros((1, spec.STATE_DIM), np.float32)
        spin = Rotation.from_rotvec(axis * rate * t)
        out[0, spec.STATE_SLICES["projected_gravity"]] = spin.inv().apply([0.1, 0.2, -0.97])
        out[0, spec.STATE_SLICES["angular_velocity"]] = axis * rate
        out[0, spec.STATE_SLICES["joint_position"]] = 0.1 + 0.5 * t
        out[0, spec.STATE_SLICES["joint_velocity"]] = 0.5
        return torch.from_numpy(out)

    back = earlier(state(1.0), torch.tensor([age]))
    torch.testing.assert_close(back, state(1.0 - age), atol=2e-3, rtol=0)
