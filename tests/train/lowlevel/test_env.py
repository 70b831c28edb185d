"""The environment of the low-level policy: physics, commands, rewards, mirror, episodes."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from egovcp.errors import UsageError
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp.spec import ACTION_BOX, STATE_SLICES
from egovcp_train.lowlevel import rewards
from egovcp_train.lowlevel.commands import Commands, between
from egovcp_train.lowlevel.config import CommandConfig, DisturbanceConfig, LowLevelTask
from egovcp_train.lowlevel.env import LowLevelEnv, mirrored
from egovcp_train.lowlevel.physics import BatchPhysics, PhysicsOptions, neutral_qpos
from egovcp_train.lowlevel.sensing import PRIVILEGED_DIM, TorsoMotion

SILENT = SensorConfig(0.0, 0.0, 0.0, 0.0)
STANDING = CommandConfig(standing=1.0, still_hands=1.0)
PLAIN = DisturbanceConfig(
    wall=0.0,
    push=(0.0, 0.0),
    payload=(0.0, 0.0),
    mass_scale=(1.0, 1.0),
    stiffness_scale=(1.0, 1.0),
    damping_scale=(1.0, 1.0),
    delay=(0.0, 0.0),
    models=1,
)


def _env(robots: int = 4, seed: int = 0, **task: object) -> LowLevelEnv:
    return LowLevelEnv(robots, LowLevelTask(**task), WalkConfig(), SILENT, seed=seed)


def _zero(env: LowLevelEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, ACTIONS)


def test_without_a_residual_it_stands_and_earns_nearly_everything():
    env = _env(commands=STANDING, disturbances=PLAIN)
    for _ in range(100):
        obs, reward, done, extras = env.step(_zero(env))
        assert not done.any()
    assert obs["policy"].shape == (4, OBSERVATION_DIM)
    assert obs["privileged"].shape == (4, PRIVILEGED_DIM)
    for term in ("velocity", "turning", "height", "upright", "contact"):
        assert extras["log"][f"/reward/{term}"] > 0.8, term
    weights = env.task.rewards
    best = weights.alive + weights.velocity + weights.turning + weights.height
    best += weights.upright + weights.contact
    assert float(reward.mean()) == pytest.approx(best / 50, rel=0.1)


def test_told_to_walk_without_a_trained_residual_it_falls_and_starts_again():
    env = _env(8, commands=CommandConfig(standing=0.0, in_place=0.0, interval=(10.0, 10.0)))
    fell = 0
    for _ in range(200):
        _, reward, done, extras = env.step(_zero(env))
        for row in torch.nonzero(done):
            assert float(reward[row]) < -1
            assert int(env.episode_length_buf[row]) == 0
            assert env.logic.walk.gait.blend[row] == 0
            assert not extras["time_outs"][row]
        fell += int(done.sum())
    assert fell >= 8


def test_an_episode_is_cut_at_its_time_limit():
    env = _env(2, commands=STANDING, disturbances=PLAIN, episode=0.5)
    for tick in range(1, 26):
        _, _, done, extras = env.step(_zero(env))
        assert bool(done.all()) == (tick == 25)
    assert bool(extras["time_outs"].all())


def test_the_same_seed_gives_the_same_run_whatever_the_threads():
    def run(seed: int, threads: int) -> torch.Tensor:
        env = LowLevelEnv(
            4, LowLevelTask(), WalkConfig(), SensorConfig(), threads=threads, seed=seed
        )
        env.logic.difficulty = 1.0
        for _ in range(40):
            obs, *_ = env.step(_zero(env))
        env.close()
        return obs["policy"]

    assert torch.equal(run(1, 1), run(1, 2))
    assert not torch.equal(run(1, 1), run(2, 1))


def test_new_targets_act_after_the_delay():
    """Two robots get the same new targets, one of them 20 ms later."""
    env = _env(2, commands=STANDING, disturbances=PLAIN)
    physics = env.physics
    target = physics.qpos[:, 7:] + 0.3
    physics.step(target, np.array([0, 4]))
    moved = np.abs(physics.qvel[:, 6:]).max(axis=1)
    assert moved[0] > 3 * moved[1]


def test_a_delay_may_be_longer_than_a_tick():
    """Targets of 1, 2, 3 in turn; 30 ms late, 2 acts from the middle of the third tick on."""
    physics = BatchPhysics(1, "points", PLAIN, 1, 0)
    qpos = neutral_qpos(1)
    physics.place(np.arange(1), qpos, np.zeros((1, 29)))
    acting = []
    for target in (1.0, 2.0, 3.0):
        physics.step(np.full((1, 29), target), np.array([6]))
        acting.append(physics._control[0, :, 0].tolist())
    physics.close()
    assert acting == [[0, 0, 0, 0], [0, 0, 1, 1], [1, 1, 2, 2]]


@pytest.mark.parametrize(
    "options", [PhysicsOptions(0.002), PhysicsOptions(cone="elliptic", integrator="Euler")]
)
def test_physics_takes_the_simulators_options(options):
    physics = BatchPhysics(2, "stock", PLAIN, 1, 0, options)
    option = physics._models[0].opt
    assert option.timestep == options.timestep
    assert (option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC) == (options.cone == "elliptic")
    assert (option.integrator == mujoco.mjtIntegrator.mjINT_EULER) == (options.timestep == 0.005)
    qpos = neutral_qpos(2)
    physics.place(np.arange(2), qpos, qpos[:, 7:])
    physics.step(qpos[:, 7:], np.zeros(2, dtype=np.intp))
    assert physics.state[:, 0] == pytest.approx(0.02)  # s
    physics.close()


def test_a_push_is_a_change_of_the_horizontal_velocity():
    push = replace(PLAIN, push=(0.5, 0.5), push_interval=(0.1, 0.1))
    env = _env(16, commands=STANDING, disturbances=push)
    fastest = 0.0
    for _ in range(8):
        env.step(_zero(env))
        fastest = max(fastest, float(np.linalg.norm(env.physics.qvel[:, :2], axis=1).max()))
    assert 0.3 < fastest < 0.7


def test_a_standing_robot_that_is_pushed_at_a_wall_braces_on_it_and_lets_go():
    speed = (0.4, 0.4)
    config = replace(PLAIN, wall=1.0, wall_push=(speed, speed), push_interval=(8.0, 8.0))
    env = _env(commands=STANDING, disturbances=config)
    env._next_push[:] = 10
    gaps, palms, walls = [], [], []
    for _ in range(9):
        env.step(_zero(env))
        assert not env.walls.active.any()
    for _ in range(320):
        env.step(_zero(env))
        x = env.physics.snapshot()
        normal = np.stack([np.cos(env.walls.yaw), np.sin(env.walls.yaw)], axis=1)[:, None]
        to_wall = (env.walls.position[:, None, :2] - x.palms[..., :2]) * normal
        palms.append(np.where(env.walls.active, to_wall.sum(-1).min(axis=1), np.nan))
        gaps.append(env.walls.distance(x))
        walls.append(env.walls.active.copy())
    walls, palms, gaps = np.array(walls), np.array(palms), np.array(gaps)
    assert walls[0].all()
    assert not walls[-10:].any()
    assert np.all((gaps[0] > 0.5) & (gaps[0] < 0.85))
    nearest = np.nanmin(palms, axis=0)
    assert (nearest < 0.08).any(), "no palm reached the wall"
    assert (nearest > -0.02).all(), "a palm is inside the wall"


def test_steps_cost_nothing_for_a_while_after_a_push():
    env = _env(2, commands=STANDING, disturbances=PLAIN)
    env.step(_zero(env))
    env.logic.walk.gait.blend[:] = 1.0
    env.logic.pushed(np.array([1]))
    terms = env.logic.reward_terms(env.physics.snapshot())
    assert terms["stepping"].tolist() == [1.0, 0.0]


def test_episodes_end_at_different_times_once_they_are_spread():
    env = _env(16, commands=STANDING, disturbances=PLAIN, episode=0.5)
    env.spread_ends()
    ended = [int(env.step(_zero(env))[2].sum()) for _ in range(25)]
    assert sum(ended) == 16
    assert max(ended) < 8


def test_robots_differ_within_the_ranges():
    env = _env(64, disturbances=DisturbanceConfig(models=64))
    friction = env.physics.floor_friction
    low, high = DisturbanceConfig().friction
    assert low <= friction.min() < friction.max() <= high
    assert len(np.unique(friction)) == 64


def test_a_robot_whose_simulation_diverges_has_fallen_and_starts_again():
    env = _env(2, commands=STANDING, disturbances=PLAIN)
    env.physics.qvel[1, 7] = np.nan
    obs, reward, done, _ = env.step(_zero(env))
    assert done.tolist() == [0.0, 1.0]
    assert torch.isfinite(reward).all()
    assert torch.isfinite(obs["policy"]).all()
    assert torch.isfinite(obs["privileged"]).all()
    for _ in range(5):
        obs, _, done, _ = env.step(_zero(env))
    assert not done.any()


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: CommandConfig(forward=((0.1, 0.3), (0.6, 0.1))),
        lambda: DisturbanceConfig(friction=(1.0, 0.5)),
        lambda: DisturbanceConfig(models=0),
    ],
)
def test_ranges_the_wrong_way_round_are_refused(wrong):
    with pytest.raises(UsageError, match="expected"):
        wrong()


# --- commands ----------------------------------------------------------------------


def _run_commands(config: CommandConfig, difficulty: float, ticks: int = 3000) -> np.ndarray:
    commands = Commands(8, config, np.random.default_rng(0))
    commands.difficulty = difficulty
    commands.reset(np.arange(8))
    out = []
    for _ in range(ticks):
        commands.advance()
        out.append(commands.vector)
    return np.array(out)


@pytest.mark.parametrize("difficulty", [0.0, 1.0])
def test_commands_stay_in_their_ranges(difficulty):
    config = CommandConfig()
    c = _run_commands(config, difficulty)
    fastest = between(*config.forward, difficulty)[1]
    back = between(*config.backward_speed, difficulty)[1]
    assert -back - 1e-9 <= c[..., 0].min() < 0 < c[..., 0].max() <= fastest + 1e-9
    assert np.abs(c[..., 1]).max() <= difficulty * config.sideways + 1e-9
    assert np.abs(c[..., 2]).max() <= difficulty * config.turning + 1e-9
    low = between(*config.standing_height, difficulty)[0]
    assert c[..., 9].min() >= min(low, ACTION_BOX.neutral[-1]) - 1e-9
    assert (ACTION_BOX.to_normalised(c[..., 3:]) <= 1 + 1e-9).all()


def test_velocities_change_no_faster_than_their_ramp():
    config = CommandConfig()
    change = np.abs(np.diff(_run_commands(config, 1.0)[..., :3], axis=0)).max()
    assert change <= config.acceleration / 50 + 1e-9


def test_some_robots_only_turn_or_only_go_sideways():
    config = CommandConfig(standing=0.0, in_place=1.0, acceleration=100.0)
    v = _run_commands(config, 1.0)[..., :3]
    assert not v[..., 0].any()
    sideways, turns = v[..., 1] != 0, v[..., 2] != 0
    assert sideways.any()
    assert turns.any()
    # at most one tick in which one command ramps down as the other one ramps up
    assert (sideways & turns).mean() < 0.02


def test_held_hands_move_at_the_rate_limit_and_rest():
    config = CommandConfig(standing=1.0, still_hands=0.0, held_hands=1.0)
    c = ACTION_BOX.to_normalised(_run_commands(config, 0.0)[..., 3:])[..., :6]
    step = np.abs(np.diff(c[1::2], axis=0))
    assert step.max() == pytest.approx(0.32, abs=1e-6)
    assert 0.5 < (step.max(axis=2) < 1e-9).mean() < 0.9


def test_hands_move_like_those_of_the_data_or_rest():
    config = CommandConfig(standing=1.0, held_hands=0.0)
    c = ACTION_BOX.to_normalised(_run_commands(config, 1.0)[..., 3:])
    step = np.abs(np.diff(c[1::2], axis=0))[..., :6]
    assert step.max() <= 0.32 + 1e-9
    assert (step.max(axis=2) == 0).mean() > 0.1
    still = _run_commands(CommandConfig(still_hands=1.0), 1.0)[..., 3:9]
    assert np.ptp(still, axis=0).max() == 0


# --- mirror ------------------------------------------------------------------------


def test_mirrored_twice_is_the_same():
    env = _env(3)
    obs, actions = env.get_observations(), torch.randn(3, ACTIONS)
    once = mirrored(env, obs, actions)
    twice = mirrored(env, once[0][3:], once[1][3:])
    for group in ("policy", "privileged"):
        torch.testing.assert_close(twice[0][group][3:], obs[group])
    torch.testing.assert_close(twice[1][3:], actions)


def test_a_mirrored_robot_under_mirrored_commands_does_the_mirrored_thing():
    """Robot 1 gets everything in the mirror, tick by tick; what is observed stays a mirror."""
    env = _env(2, commands=STANDING, disturbances=PLAIN)
    qpos = neutral_qpos(2)  # itself its mirror image
    env.physics.place(np.arange(2), qpos, qpos[:, 7:])
    env.logic.restart(np.arange(2))
    commands = env.logic.commands
    commands.velocity[:] = commands._goal[:] = [[0.2, 0.1, 0.2], [0.2, -0.1, -0.2]]
    commands._ticks_left[:] = 1000
    env._observe(env.physics.snapshot())
    _, action = mirrored(env, None, torch.randn(1, ACTIONS, generator=torch.manual_seed(0)))
    for _ in range(15):
        obs, *_ = env.step(0.1 * action)
    both, _ = mirrored(env, obs, None)
    # The model's inertias are not quite symmetric; wrists show it most, in rates of rad/s.
    for group, tolerance in (("policy", 0.3), ("privileged", 0.01)):
        np.testing.assert_allclose(both[group][2], both[group][1], atol=tolerance)
        assert np.abs(obs[group][0] - obs[group][1]).max() > 5 * tolerance
    for part in ("angular_velocity", "projected_gravity", "joint_position"):
        columns = STATE_SLICES[part]
        reflected, lived = (both["policy"][row, columns] for row in (2, 1))
        np.testing.assert_allclose(reflected, lived, atol=0.01)


# --- rewards -----------------------------------------------------------------------


def _terms(env: LowLevelEnv, **change: np.ndarray) -> dict[str, np.ndarray]:
    x = replace(env.physics.snapshot(), **change)
    n = env.num_envs
    action = np.zeros((n, ACTIONS))
    walk = env.logic.walk
    motion, torso = rewards.AverageVelocity(n), TorsoMotion(n)
    for _ in range(100):
        motion.add(x)
        torso.add(env.physics.snapshot())
    torso.add(x)
    return rewards.terms(
        x,
        motion.value,
        env.logic.commands.vector,
        walk,
        action,
        action,
        torso,
        np.zeros(n, dtype=bool),
    )


@pytest.fixture(scope="module")
def stood() -> LowLevelEnv:
    env = _env(1, commands=STANDING, disturbances=PLAIN)
    for _ in range(50):
        env.step(_zero(env))
    return env


@pytest.mark.parametrize(
    ("change", "term"),
    [
        ({"velocity": np.array([[0.3, 0.0, 0.0]])}, "velocity"),
        ({"angular_velocity": np.array([[0.0, 0.0, 0.6]])}, "turning"),
        ({"position": np.array([[0.0, 0.0, 0.65]])}, "height"),
        ({"quaternion": np.array([[0.98, 0.199, 0.0, 0.0]])}, "upright"),
        ({"feet": np.array([[[0.0, 0.12, 0.2], [0.0, -0.12, 0.035]]])}, "contact"),
    ],
)
def test_what_is_wanted_earns_less_when_it_is_missed(stood, change, term):
    assert _terms(stood, **change)[term] < 0.7 * _terms(stood)[term]


@pytest.mark.parametrize(
    ("change", "term"),
    [
        ({"feet_velocity": np.array([[[0.5, 0, 0], [0, 0, 0.0]]])}, "slip"),
        ({"feet": np.array([[[0, 0.02, 0.035], [0, -0.02, 0.035]]])}, "stance_width"),
        ({"feet_forward": np.array([[[0.8, 0.6, 0], [0.8, -0.6, 0.0]]])}, "foot_heading"),
        ({"torque": np.full((1, 29), 50.0)}, "torque"),
        ({"quaternion": np.array([[0.9998, 0.02, 0.0, 0.0]])}, "torso_rate"),
        ({"quaternion": np.array([[0.9998, 0.02, 0.0, 0.0]])}, "torso_change"),
    ],
)
def test_what_is_not_wanted_is_counted(stood, change, term):
    x = stood.physics.snapshot()
    yaw = 2 * np.arctan2(x.quaternion[0, 3], x.quaternion[0, 0])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for name in ("feet", "feet_forward"):
        if name in change:  # given in the heading frame
            flat = change[name][..., :2] @ turn.T
            change = {name: np.concatenate([flat, change[name][..., 2:]], axis=-1)}
            if name == "feet":
                change[name] = change[name] + np.array([*x.position[0, :2], 0.0])
    assert _terms(stood, **change)[term] > _terms(stood)[term] + 0.05


def test_the_observed_state_is_what_a_robot_measures(stood):
    state = stood.get_observations()["policy"][0].numpy()
    x = stood.physics.snapshot()
    joints, rate = (state[STATE_SLICES[n]] for n in ("joint_position", "angular_velocity"))
    np.testing.assert_allclose(joints, x.joints[0], rtol=1e-6)
    np.testing.assert_allclose(rate, x.angular_velocity[0], rtol=1e-6)
    gravity = state[STATE_SLICES["projected_gravity"]]
    assert gravity @ gravity == pytest.approx(1.0)
    assert gravity[2] < -0.99
