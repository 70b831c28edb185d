"""The reflection of the G1."""

import numpy as np

from egovcp import spec
from egovcp.robot.kinematics import palm_positions
from egovcp.robot_spec import G1


def _reflect_hands(metric: np.ndarray) -> np.ndarray:
    """Hand positions (..., 7) in metres, reflected by hand: swap, then y -> -y."""
    flip = np.array([1, -1, 1])
    left, right, height = metric[..., :3], metric[..., 3:6], metric[..., 6:]
    return np.concatenate([right * flip, left * flip, height], axis=-1)


def test_mirroring_twice_is_the_identity() -> None:
    rng = np.random.default_rng(0)
    state = rng.normal(size=(2, 3, spec.STATE_DIM)).astype(np.float32)
    action = rng.uniform(-1, 1, (2, 3, spec.ACTION_DIM)).astype(np.float32)
    np.testing.assert_array_equal(G1.mirrored_state(G1.mirrored_state(state)), state)
    np.testing.assert_array_equal(G1.mirrored_action(G1.mirrored_action(action)), action)
    assert G1.mirrored_state(state).dtype == np.float32


def test_mirroring_an_action_mirrors_the_hand_targets() -> None:
    action = np.random.default_rng(1).uniform(-1, 1, (100, spec.ACTION_DIM))
    mirrored = spec.ACTION_BOX.to_metric(G1.mirrored_action(action))
    np.testing.assert_allclose(mirrored, _reflect_hands(spec.ACTION_BOX.to_metric(action)))


def test_the_command_inside_the_state_mirrors_like_the_action() -> None:
    action = np.random.default_rng(2).uniform(-1, 1, spec.ACTION_DIM)
    state = np.zeros(spec.STATE_DIM)
    state[9:16] = spec.ACTION_BOX.to_metric(action)
    expected = spec.ACTION_BOX.to_metric(G1.mirrored_action(action))
    np.testing.assert_allclose(G1.mirrored_state(state)[9:16], expected)


def test_every_joint_is_exchanged_with_its_counterpart() -> None:
    for name in spec.JOINT_NAMES:
        other = name.replace("left_", "?").replace("right_", "left_").replace("?", "right_")
        state = np.zeros(spec.STATE_DIM)
        state[spec.STATE_NAMES.index(f"{name}.pos")] = 1.0
        found = G1.mirrored_state(state)[spec.STATE_NAMES.index(f"{other}.pos")]
        assert found == (-1.0 if "roll" in name or "yaw" in name else 1.0)


def test_forward_kinematics_of_a_mirrored_state_are_mirrored() -> None:
    state = np.random.default_rng(3).normal(scale=0.3, size=(50, spec.STATE_DIM))
    state[:, 3:6] += [0, 0, -1]
    palms = palm_positions(state)  # (50, left and right, xyz)
    mirrored = palm_positions(G1.mirrored_state(state))
    np.testing.assert_allclose(mirrored, palms[:, ::-1] * [1, -1, 1], atol=1e-4)
