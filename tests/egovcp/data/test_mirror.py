import numpy as np

from egovcp import spec
from egovcp.data.mirror import mirror_action, mirror_depth, mirror_position, mirror_state
from egovcp.robot.kinematics import palm_positions


def _reflect_hands(metric: np.ndarray) -> np.ndarray:
    """Hand positions (..., 7) in metres, reflected by hand: swap, then y -> -y."""
    flip = np.array([1, -1, 1])
    left, right, height = metric[..., :3], metric[..., 3:6], metric[..., 6:]
    return np.concatenate([right * flip, left * flip, height], axis=-1)


def test_mirroring_twice_is_the_identity() -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(0, 5000, (2, 3, 48, 64)).astype(np.uint16)
    state = rng.normal(size=(2, 3, spec.STATE_DIM)).astype(np.float32)
    action = rng.uniform(-1, 1, (2, 3, spec.ACTION_DIM)).astype(np.float32)
    np.testing.assert_array_equal(mirror_depth(mirror_depth(depth)), depth)
    np.testing.assert_array_equal(mirror_state(mirror_state(state)), state)
    np.testing.assert_array_equal(mirror_action(mirror_action(action)), action)
    assert mirror_state(state).dtype == np.float32


def test_mirroring_a_position_changes_the_side() -> None:
    position = np.array([[2.0, 0.3, 0.1], [1.0, -0.2, 0.5]], dtype=np.float32)
    np.testing.assert_array_equal(mirror_position(position), position * [1, -1, 1])
    assert mirror_position(position).dtype == np.float32


def test_mirroring_an_action_mirrors_the_hand_targets() -> None:
    action = np.random.default_rng(1).uniform(-1, 1, (100, spec.ACTION_DIM))
    mirrored = spec.ACTION_BOX.to_metric(mirror_action(action))
    np.testing.assert_allclose(mirrored, _reflect_hands(spec.ACTION_BOX.to_metric(action)))


def test_the_command_inside_the_state_mirrors_like_the_action() -> None:
    action = np.random.default_rng(2).uniform(-1, 1, spec.ACTION_DIM)
    state = np.zeros(spec.STATE_DIM)
    state[9:16] = spec.ACTION_BOX.to_metric(action)
    expected = spec.ACTION_BOX.to_metric(mirror_action(action))
    np.testing.assert_allclose(mirror_state(state)[9:16], expected)


def test_every_joint_is_exchanged_with_its_counterpart() -> None:
    for name in spec.JOINT_NAMES:
        other = name.replace("left_", "?").replace("right_", "left_").replace("?", "right_")
        state = np.zeros(spec.STATE_DIM)
        state[spec.STATE_NAMES.index(f"{name}.pos")] = 1.0
        found = mirror_state(state)[spec.STATE_NAMES.index(f"{other}.pos")]
        assert found == (-1.0 if "roll" in name or "yaw" in name else 1.0)


def test_forward_kinematics_of_a_mirrored_state_are_mirrored() -> None:
    state = np.random.default_rng(3).normal(scale=0.3, size=(50, spec.STATE_DIM))
    state[:, 3:6] += [0, 0, -1]
    palms = palm_positions(state)  # (50, left and right, xyz)
    mirrored = palm_positions(mirror_state(state))
    np.testing.assert_allclose(mirrored, palms[:, ::-1] * [1, -1, 1], atol=1e-4)
