"""What surrounds the trained policy, and the controller that is made of both."""

from types import SimpleNamespace

import numpy as np
import pytest

from egovcp.robot.stance import StanceConfig, StanceController
from egovcp.robot.stance_table import standing_pose
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, Walk, WalkConfig, WalkingController
from egovcp.spec import ACTION_BOX, STATE_DIM, STATE_SLICES


def _states(batch: int, ticks: int, seed: int = 0) -> np.ndarray:
    """Noisy measurements of standing robots whose commands wander, (T, B, 74)."""
    rng = np.random.default_rng(seed)
    pose = standing_pose(0.74)
    out = np.zeros((ticks, batch, STATE_DIM))
    out[..., STATE_SLICES["projected_gravity"]] = (0.0, 0.0, -1.0)
    out[..., STATE_SLICES["joint_position"]] = pose.joints
    out += 0.002 * rng.standard_normal(out.shape)
    action = np.cumsum(0.1 * rng.uniform(-1, 1, (ticks, batch, 7)), axis=0).clip(-1, 1)
    out[..., 9:16] = ACTION_BOX.to_metric(action)
    out[..., STATE_SLICES["command_velocity"]] = 0.0
    return out


def test_without_a_velocity_and_without_a_residual_it_is_the_stance_law():
    walk, stance = Walk(), StanceController(StanceConfig(reach=WalkConfig().reach))
    states = _states(2, 30)
    walk.reset(states[0])
    stance.reset(states[0])
    for state in states:
        walk.observe(state)
        np.testing.assert_array_equal(walk.targets(np.zeros((2, ACTIONS))), stance.step(state))


def test_the_residual_moves_legs_and_waist_only_and_within_its_limit():
    walk = Walk()
    state = _states(1, 1)[0]
    walk.reset(state)
    walk.observe(state)
    zero = walk.targets(np.zeros((1, ACTIONS)))
    some = walk.targets(np.full((1, ACTIONS), 0.1)) - zero
    np.testing.assert_allclose(some[:, :ACTIONS], 0.1 * WalkConfig().action_scale)
    assert not some[:, ACTIONS:].any()
    far = walk.targets(np.full((1, ACTIONS), 1e6)) - zero
    assert np.abs(far).max() <= WalkConfig().action_limit * WalkConfig().action_scale + 1e-9


def test_the_observation_is_the_state_the_clock_the_odometry_and_the_last_action():
    walk = Walk()
    state = _states(1, 1)[0]
    state[:, STATE_SLICES["command_velocity"]] = (0.3, 0.0, 0.0)
    walk.reset(state)
    for _ in range(10):
        walk.observe(state)
        walk.targets(np.full((1, ACTIONS), 0.5))
    seen = walk.observe(state)
    assert seen.shape == (1, OBSERVATION_DIM)
    np.testing.assert_allclose(seen[:, :STATE_DIM], state, rtol=1e-6, atol=1e-6)
    clock = seen[0, STATE_DIM : STATE_DIM + 3]
    assert clock[2] == 1
    assert clock[0] ** 2 + clock[1] ** 2 == pytest.approx(1.0)
    odometry = [*walk.gait.velocity[0], walk.gait.heading_error[0]]
    np.testing.assert_allclose(seen[0, STATE_DIM + 3 : STATE_DIM + 6], odometry, atol=1e-6)
    np.testing.assert_allclose(seen[0, STATE_DIM + 6 :], 0.5)


def _controller(gain: float = 0.1) -> WalkingController:
    class Policy(SimpleNamespace):
        def __call__(self, observation: np.ndarray) -> np.ndarray:
            return np.tanh(gain * observation[:, :ACTIONS])

    return WalkingController(Policy(config=WalkConfig(), digest=str(gain)))


def test_a_robot_does_not_depend_on_its_neighbours():
    states = _states(3, 20)
    states[:, 1, 6] = 0.3  # one of them walks
    together, alone = _controller(), _controller()
    together.reset(states[0])
    alone.reset(states[0, 1:2])
    for state in states:
        np.testing.assert_array_equal(together.step(state)[1:2], alone.step(state[1:2]))


def test_resetting_a_row_leaves_the_others_and_forgets_everything_in_it():
    states = _states(2, 20)
    states[:, :, 6] = 0.3
    kept, fresh, reference = _controller(), _controller(), _controller()
    kept.reset(states[0])
    reference.reset(states[0])
    for state in states[:10]:
        kept.step(state)
        reference.step(state)
    kept.reset(states[10], np.array([1]))
    fresh.reset(states[10])
    for state in states[10:]:
        got = kept.step(state)
        np.testing.assert_array_equal(got[0], reference.step(state)[0])
        np.testing.assert_array_equal(got[1], fresh.step(state)[1])


def test_after_walking_the_filter_starts_anew():
    """It believes in planted feet: what it made of the steps is forgotten."""
    walk = Walk()
    still = _states(1, 1)[0]
    moving = still.copy()
    moving[:, 6] = 0.3
    walk.reset(still)
    for _ in range(40):
        walk.observe(moving)
    estimates = []
    while walk.gait.blend > 0:
        estimates.append(np.abs(walk._memory.balance.prediction).max())
        walk.observe(still)
    assert np.abs(walk._memory.balance.prediction).max() < 0.1 * estimates[-1]


def test_the_identity_follows_the_policy():
    assert _controller(0.1).id != _controller(0.2).id
    assert _controller(0.1).id == _controller(0.1).id
    assert _controller().id.startswith("g1-walk-ppo-")
