from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egovcp.errors import UsageError
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.live import LiveRobot
from egovcp.sim.robot import Contact
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import HEAD, PARTS, TORSO, build_scene
from egovcp.sim.tasks import find_task, task_names
from egovcp.sim.tasks.arch import ArchConfig, ArchTask
from egovcp.sim.tasks.ball import BallConfig, BallTask
from egovcp.sim.tasks.sequence import SequenceConfig
from egovcp.sim.tasks.wall import WallConfig
from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT, REWARD_TERMS, Solid

TASKS = task_names(training=True)

HOLD = np.zeros((4, ACTION_DIM))
HAND, ARM = PARTS.index("left_hand"), PARTS.index("left_arm")


def begin(env: VectorEnv, task: str) -> None:
    env.reset([Scenario(task, 0, i) for i in range(env.num_envs)])


def objects(env: VectorEnv) -> np.ndarray:
    """(B, 3) positions."""
    return np.array([instance.task.object_w for instance in env.instances])


def solids(env: VectorEnv) -> list[tuple[Solid, ...]]:
    return [instance.task.solids() for instance in env.instances]


def test_the_ball_flies_through_its_aim_after_its_flight_time(config: EnvConfig) -> None:
    aside = BallConfig(aim_lateral_range=(1.0, 1.0), aim_height_range=(0.3, 0.3))
    env = VectorEnv(replace(config, ball=aside), 4)
    begin(env, "ball")
    flight = np.array([p["flight"] for p in env.parameters])
    nearest = np.full(4, np.inf)
    for _ in range(35):
        env.step(HOLD)
        state, position = env.privileged_state(), objects(env)
        velocity = [i.robot.data.qvel[i.task._qvel][:3] for i in env.instances]
        left = flight - state.since_event
        path = position + np.array(velocity) * left[:, None]
        path[:, 2] -= 0.5 * 9.81 * left**2
        aim = state.pelvis_w[:, :3] + [aside.aim_forward, 1.0, 0.3]
        flying = np.isfinite(position[:, 0]) & (left > 0)
        miss = np.linalg.norm(path - aim, axis=1)
        nearest = np.where(flying, np.minimum(nearest, miss), nearest)
    assert nearest.max() < 0.05


def test_the_ball_is_out_of_sight_and_of_truth_before_the_throw(env: VectorEnv) -> None:
    begin(env, "ball")
    assert np.isnan(objects(env)).all()
    assert solids(env) == [()] * 4


def test_a_box_flies_as_the_ball_of_its_volume_would(config: EnvConfig) -> None:
    """Nothing but shape and attitude differs, so that episodes can be compared one by one."""
    ball, box = (
        VectorEnv(replace(config, ball=BallConfig(shape=shape)), 4) for shape in ("sphere", "box")
    )
    begin(ball, "ball")
    begin(box, "ball")
    assert ball.parameters == box.parameters
    for _ in range(14):
        seen = ball.step(HOLD).observation.depth, box.step(HOLD).observation.depth
    np.testing.assert_allclose(objects(ball), objects(box), atol=0.002, equal_nan=False)
    sizes = [(a.size, b.size) for (a,), (b,) in zip(solids(ball), solids(box), strict=True)]
    for (radius, _, _), (half, _, _) in sizes:
        assert (2 * half) ** 3 == pytest.approx(4 / 3 * np.pi * radius**3)
    thing = [(depth > 0) & (depth < 2600) for depth in seen]
    area = thing[1].sum() / thing[0].sum()
    assert 0.8 < area < 1.6  # a cube shows at least its face, at most its hexagon
    assert (thing[0] != thing[1]).any()
    solid = solids(box)[0][0]
    assert solid.shape == "box"
    assert abs(solid.quaternion_w[0]) < 0.999


def test_a_box_hits_and_falls(config: EnvConfig) -> None:
    middle = BallConfig(shape="box", aim_lateral_range=(0.0, 0.0), aim_height_range=(0.3, 0.3))
    env = VectorEnv(replace(config, ball=middle), 4)
    begin(env, "ball")
    hits = sum(env.step(HOLD).reward_terms["hit"] for _ in range(40))
    assert (hits < 0).any()
    assert (objects(env)[:, 2] < 1.0).all()


def thrown(env: VectorEnv) -> BallTask:
    begin(env, "ball")
    for _ in range(8):
        env.step(HOLD)
    task = env.instances[0].task
    assert isinstance(task, BallTask)
    return task


@pytest.mark.parametrize(
    ("parts", "blocked", "hit"),
    [
        ([HAND], True, False),
        ([ARM], False, False),
        ([TORSO], False, True),
        ([HEAD, HAND], True, False),
        ([ARM, HEAD], False, True),
    ],
)
def test_first_contacts_count_by_part(
    env: VectorEnv, parts: list[int], blocked: bool, hit: bool
) -> None:
    task = thrown(env)
    task.process_contacts([Contact(part, 10.0) for part in parts])
    assert (task.blocked, task.hit) == (blocked, hit)
    terms = task.rewards()
    assert (terms["block"], terms["hit"]) == (float(blocked), -float(hit))
    assert not any(task.rewards().values())


@pytest.mark.parametrize(("steps", "hit"), [(20, False), (80, True)])
def test_contacts_soon_after_a_block_do_not_count(env: VectorEnv, steps: int, hit: bool) -> None:
    task = thrown(env)
    task.process_contacts([Contact(HAND, 10.0)])
    task.physics_steps += steps
    task.process_contacts([Contact(TORSO, 10.0)])
    assert task.hit is hit
    assert task.success is not hit


def test_a_hand_after_a_hit_blocks_nothing(env: VectorEnv) -> None:
    task = thrown(env)
    task.process_contacts([Contact(TORSO, 10.0)])
    task.process_contacts([Contact(HAND, 10.0)])
    assert task.hit
    assert not task.blocked


@pytest.mark.parametrize("task", task_names())
def test_actions_cost_the_same_in_every_task(config: EnvConfig, task: str) -> None:
    env = VectorEnv(replace(config, pose_cost=0.5, action_rate_cost=0.2), 1)
    begin(env, task)
    action = np.linspace(-0.3, 0.3, ACTION_DIM)[None]
    assert env.step(0.0 * action).reward_terms["pose"] == 0.0
    result = env.step(action)
    pose, rate = 0.5 * np.mean(action**2), 0.2 * np.mean((action / ACTION_RATE_LIMIT) ** 2)
    assert result.reward_terms["pose"][0] == pytest.approx(-pose)
    assert result.reward_terms["action_rate"][0] == pytest.approx(-rate)
    assert result.reward[0] == pytest.approx(-pose - rate)
    assert env.step(action).reward_terms["action_rate"][0] == 0.0


@pytest.mark.parametrize("task", task_names())
def test_the_terms_of_a_task_are_terms_of_the_specification(env: VectorEnv, task: str) -> None:
    begin(env, task)
    terms, columns = env.step(HOLD).reward_terms, env.instances[0].task.reward_terms
    assert set(terms) == set(columns)
    assert set(columns.values()) <= set(REWARD_TERMS)


def test_a_push_gives_the_base_its_speed(config: EnvConfig) -> None:
    push = WallConfig(
        push_speed_range=(0.4, 0.4), push_bearing_range=(0.0, 0.0), away_probability=0.0
    )
    env = VectorEnv(replace(config, wall=push), 4)
    begin(env, "wall")
    fastest = np.zeros(4)
    for _ in range(10):
        env.step(HOLD)
        fastest = np.maximum(fastest, env.privileged_state().pelvis_velocity_w[:, 0])
    assert np.all((fastest > 0.2) & (fastest < 0.6))


@pytest.mark.parametrize("push_time", [0.007, 0.013, 0.02])
def test_the_parts_of_a_push_add_up_to_its_speed(config: EnvConfig, push_time: float) -> None:
    push = WallConfig(push_speed_range=(0.4, 0.4), away_probability=0.0, push_time=push_time)
    env = VectorEnv(replace(config, wall=push), 1)
    begin(env, "wall")
    task = env.instances[0].task
    velocity = task.robot.data.qvel[:3]
    velocity[:] = 0.0
    while task.since_event < 0.1:
        task.before_step()
        task.physics_steps += 1
    assert np.linalg.norm(velocity) == pytest.approx(0.4)


def test_an_unbraced_push_ends_at_the_wall_and_costs_once(config: EnvConfig) -> None:
    push = WallConfig(push_speed_range=(1.0, 1.0), away_probability=0.0)
    env = VectorEnv(replace(config, wall=push), 4)
    begin(env, "wall")
    distance = [p["distance"] for p in env.parameters]
    gap = env.privileged_state().object_b[:, 0]
    np.testing.assert_allclose(gap, distance, atol=0.02)
    hit = np.zeros(4)
    for _ in range(45):
        result = env.step(HOLD)
        hit += result.reward_terms["hit"]
    assert not result.success.any()
    np.testing.assert_array_equal(hit, -1.0)


@pytest.mark.parametrize(("part", "cost"), [(HAND, 0.0), (ARM, 1.0), (HEAD, 1.0)])
def test_only_hands_may_touch_the_wall(env: VectorEnv, part: int, cost: float) -> None:
    begin(env, "wall")
    task = env.instances[0].task
    task.process_contacts([Contact(part, 10.0)])
    assert [task.rewards()["hit"] for _ in range(2)] == [-cost, 0.0]
    assert task.achieved is (cost == 0.0)


def test_the_arch_is_located_by_the_lower_edge_of_its_lintel(env: VectorEnv) -> None:
    begin(env, "arch")
    state = env.privileged_state()
    drawn = [(p["distance"], p["lateral"]) for p in env.parameters]
    np.testing.assert_allclose(state.object_b[:, :2], drawn, atol=1e-6)
    edges = objects(env)[:, 2]
    np.testing.assert_allclose(edges, [p["clearance"] for p in env.parameters])
    lintel = {solid.name: solid for solid in solids(env)[0]}["arch_lintel"]
    assert lintel.position_w[2] - lintel.size[2] == pytest.approx(edges[0])


def test_an_upright_robot_hits_the_arch_once(config: EnvConfig) -> None:
    near = ArchConfig(distance_range=(0.5, 0.6))
    env = VectorEnv(replace(config, arch=near), 4)
    begin(env, "arch")
    hit = np.zeros(4)
    for _ in range(60):
        hit += env.step(HOLD).reward_terms["hit"]
    np.testing.assert_array_equal(hit, -1.0)


@pytest.mark.parametrize("task", TASKS)
def test_the_depth_image_shows_the_object_at_its_position(env: VectorEnv, task: str) -> None:
    """The camera looks over the floor, so what is near is the object."""
    begin(env, task)
    for _ in range(14):
        result = env.step(HOLD)
    near = result.observation.depth[0] < 3600
    assert np.mean(near & (result.observation.depth[0] > 0)) > 0.002


@pytest.mark.parametrize("task", TASKS)
def test_every_collision_geom_of_the_robot_has_a_part(task: str) -> None:
    scene = build_scene(find_task(task).scene_tasks(EnvConfig()), "points")
    named = {PARTS[p] for p in scene.index.part if p >= 0}
    assert named == set(PARTS)
    assert scene.index.part[scene.index.floor] == -1
    assert not np.any(scene.index.is_object & (scene.index.part >= 0))


def walked(config: EnvConfig) -> tuple[VectorEnv, ArchTask]:
    """A robot that begins to walk to an arch."""
    env = VectorEnv(replace(config, arch=ArchConfig()), 1)
    begin(env, "arch")
    task = env.instances[0].task
    assert isinstance(task, ArchTask)
    while not task.under_way:
        env.step(HOLD[:1])
    return env, task


def carry(task: ArchTask, forward: float, left: float = 0.0, turn: float = 0.0) -> None:
    """Move the robot through the scene by hand, and let the task look."""
    data, direction = task.robot.data, task._direction
    aside = np.array([-direction[1], direction[0], 0.0])
    data.qpos[:3] += forward * direction + left * aside
    yaw = turn / 2
    data.qpos[3:7] = [np.cos(yaw), 0.0, 0.0, np.sin(yaw)]
    task.before_step()


def test_the_arch_stands_still(config: EnvConfig) -> None:
    env, task = walked(config)
    place = task.robot.data.mocap_pos[0].copy()
    before = task._ahead
    carry(task, 0.2)
    assert task._ahead == pytest.approx(before - 0.2, abs=0.01)
    env.step(HOLD[:1])
    np.testing.assert_array_equal(task.robot.data.mocap_pos[0], place)


def test_a_walking_robot_is_kept_on_course(config: EnvConfig) -> None:
    _, task = walked(config)
    assert task.velocity_command == pytest.approx([task.speed, 0.0, 0.0], abs=0.05)
    carry(task, 0.0, left=0.15)
    assert task.velocity_command[1] < -0.05
    carry(task, 0.0, left=-0.15, turn=0.2)
    assert task.velocity_command[2] < -0.1


def test_having_walked_through_the_arch_it_stops(config: EnvConfig) -> None:
    _, task = walked(config)
    carry(task, task._ahead + 0.6)
    assert [task.rewards()["pass"] for _ in range(2)] == [ArchConfig().pass_reward, 0.0]
    assert task.achieved
    assert not task.velocity_command.any()


def test_a_touched_arch_is_not_passed(config: EnvConfig) -> None:
    _, task = walked(config)
    task.process_contacts([Contact(HAND, 1.0)])
    carry(task, task._ahead + 0.6)
    assert task.rewards() == {"pass": 0.0, "hit": -ArchConfig().hit_cost}
    assert task.finished
    assert not task.achieved


@pytest.mark.parametrize("task", ["arch", "sequence"])
def test_a_controller_that_does_not_walk_is_refused_for_the_arch(
    config: EnvConfig, task: str
) -> None:
    env = VectorEnv(replace(config, controller="stance"), 4)
    message = rf"task {task}.*'stance' does not walk.*--env\.controller=walk"
    with pytest.raises(UsageError, match=message):
        begin(env, task)
    begin(env, "ball")
    with pytest.raises(UsageError, match=message):
        env.reset_rows([0], [Scenario(task, 0, 0)])
    with pytest.raises(UsageError, match=message):
        LiveRobot(env.config).start(Scenario(task, 0, 0))


def test_a_sequence_without_an_arch_needs_no_walking(config: EnvConfig) -> None:
    parts = SequenceConfig(("ball", "wall"))
    env = VectorEnv(replace(config, controller="stance", sequence=parts), 1)
    env.reset([Scenario("sequence", 0, 0)])
    assert env.instances[0].task.current_name == "ball"
