"""Walking by hand: when it steps, where the feet go, and what the legs do."""

from dataclasses import replace

import numpy as np
import pytest

from egovcp.robot import gait
from egovcp.robot.gait import Gait, GaitConfig
from egovcp.robot.kinematics import foot_positions
from egovcp.robot.stance_table import stance_table, standing_pose
from egovcp.spec import STATE_DIM, STATE_SLICES

CONFIG = GaitConfig()
HEIGHT = 0.72
MIRROR = np.array([1.0, -1.0])


def _state(batch: int = 1, vx: float = 0.0, vy: float = 0.0, height: float = HEIGHT) -> np.ndarray:
    """Measurements of robots that stand in the reference pose, with a velocity command."""
    pose = standing_pose(height)
    pitch = 2 * np.arctan2(pose.quaternion[2], pose.quaternion[0])
    state = np.zeros((batch, STATE_DIM))
    state[:, STATE_SLICES["projected_gravity"]] = (np.sin(pitch), 0.0, -np.cos(pitch))
    state[:, STATE_SLICES["joint_position"]] = pose.joints
    state[:, STATE_SLICES["command_velocity"]] = (vx, vy, 0.0)
    return state


def _start(state: np.ndarray) -> Gait:
    return gait.start(
        state[:, STATE_SLICES["joint_position"]], state[:, STATE_SLICES["projected_gravity"]]
    )


def _run(m: Gait, state: np.ndarray, ticks: int) -> list[np.ndarray]:
    return [_advance(m, state, np.zeros((len(state), 2))) for _ in range(ticks)]


def _advance(m: Gait, state: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    h = np.full(len(state), HEIGHT)
    gait.sense(m, state, CONFIG)
    return gait.advance(m, stance_table().at(h), h, tilt, state, CONFIG)


def _motion(m: Gait, state: np.ndarray, height: float = HEIGHT) -> np.ndarray:
    h = np.full(len(state), height)
    return gait.leg_motion(m, stance_table().at(h), h, np.zeros((len(state), 2)), state, CONFIG)


def _walking(phase: float, state: np.ndarray, velocity: tuple[float, float] = (0.0, 0.0)) -> Gait:
    m = _start(state)
    m.phase[:], m.blend[:], m.velocity[:] = phase, 1.0, velocity
    return m


def _foothold(m: Gait, state: np.ndarray) -> np.ndarray:
    h = np.full(len(state), HEIGHT)
    command = state[:, STATE_SLICES["command_velocity"]]
    return gait.foothold(m, stance_table().at(h), h, command, CONFIG)[0]


def test_a_robot_without_velocity_command_stands():
    state = _state(3)
    m = _start(state)
    assert not np.any(_run(m, state, 100))
    assert not m.blend.any()
    assert not m.heading_error.any()


def test_it_walks_while_commanded_and_stands_once_the_feet_are_together():
    walk, stand = _state(vx=0.3), _state()
    m = _start(walk)
    _run(m, walk, 50)
    assert m.blend == 1
    longest = CONFIG.linger + CONFIG.step_time + CONFIG.fade
    stood = _run(m, stand, round(longest * 50) + 2)
    assert m.blend == 0
    assert sum(int(s[0]) for s in stood) == 1


def test_it_begins_to_stand_only_as_a_foot_lands():
    state = _state(vx=0.3)
    m = _start(state)
    _run(m, state, 50)
    stand = _state()
    while m.blend == 1:
        before = m.phase.copy()
        _run(m, stand, 1)
    assert before // np.pi != m.phase // np.pi


def test_one_period_is_one_turn_of_the_clock():
    state = _state(vx=0.3)
    m = _start(state)
    _run(m, state, 20)
    before = m.phase.copy()
    _run(m, state, 31)
    turned = 31 * 0.02 * np.pi / CONFIG.step_time
    assert np.cos(m.phase - before - turned) == pytest.approx(1.0)


def test_the_weight_is_shifted_before_the_first_foot_leaves_the_floor():
    state = _state(vx=0.3)
    m = _start(state)
    _run(m, state, 1)
    loaded = 1 if np.sin(m.phase) >= 0 else 0  # the clock begins in the other foot's step
    while m.shifting > 0:
        assert _shortened(m, state) == pytest.approx([0.0, 0.0], abs=1e-9)
        _run(m, state, 1)
    _run(m, state, 6)
    assert (np.sin(m.phase) >= 0) == (loaded == 0)
    shortened = _shortened(m, state)
    assert shortened[1 - loaded] == 0
    assert shortened[loaded] > 0.02


def _shortened(m: Gait, state: np.ndarray) -> list[float]:
    """rad of either knee that comes from lifting the foot."""
    plain = replace(CONFIG, carry=0.0, knee=0.0, swing_gain=0.0)
    h = np.full(len(state), HEIGHT)
    motion = gait.leg_motion(m, stance_table().at(h), h, np.zeros((1, 2)), state, plain)
    return [float(motion[0, 3]), float(motion[0, 9])]


def test_a_robot_that_tips_over_steps_at_once():
    state = _state(2)
    m = _start(state)
    _advance(m, state, np.array([[0.05, 0.0], [0.0, 0.4]]))
    assert (m.blend > 0).tolist() == [False, True]
    assert m.shifting[1] == 0


@pytest.mark.parametrize("velocity", [(0.5, 0.0), (-0.5, 0.0), (0.0, 0.6), (0.0, -0.6)])
def test_a_robot_that_is_pushed_steps_before_it_tips(velocity):
    state = _state(2)
    m = _start(state)
    m.velocity[1] = velocity
    h = np.full(2, HEIGHT)
    gait.advance(m, stance_table().at(h), h, np.zeros((2, 2)), state, CONFIG)
    assert (m.blend > 0).tolist() == [False, True]


@pytest.mark.parametrize(("vy", "left_first"), [(0.2, True), (-0.2, False)])
def test_the_foot_on_the_side_of_the_motion_swings_first(vy, left_first):
    state = _state(vy=vy)
    m = _start(state)
    _run(m, state, 1)
    while m.shifting > 0:
        _run(m, state, 1)
    assert (np.sin(m.phase[0] + 0.1) > 0) == left_first


def test_feet_that_stand_tell_how_fast_the_pelvis_moves():
    state = _state(vx=0.3)
    m = _start(state)
    joints = STATE_SLICES["joint_position"]
    for _ in range(40):  # both legs turn back at 0.5 rad/s
        before = foot_positions(state[:, joints])[0, 0, 0]
        state[:, joints.start + np.array([0, 6])] += 0.5 * 0.02
        state[:, joints.start + np.array([4, 10])] -= 0.5 * 0.02
        _run(m, state, 1)
    backwards = (before - foot_positions(state[:, joints])[0, 0, 0]) / 0.02
    assert backwards > 0.2
    assert m.velocity[0, 0] == pytest.approx(backwards, rel=0.1)
    assert m.velocity[0, 1] == pytest.approx(0.0, abs=0.02)


# --- footholds -------------------------------------------------------------------------


def test_a_faster_pelvis_is_caught_farther_ahead():
    state = _state()
    slow, fast = (_foothold(_walking(2.5, state, (v, 0.0)), state) for v in (0.0, 0.4))
    assert fast[0] > slow[0] + 0.05


def test_a_pelvis_that_leaves_sideways_is_caught_on_that_side():
    state = _state()
    still, leaving = (_foothold(_walking(2.5, state, (0.0, v)), state) for v in (0.0, 0.3))
    assert leaving[1] > still[1] + 0.03


def test_a_command_puts_the_foot_back_so_that_the_pelvis_falls_forward():
    commanded, idle = _state(vx=0.4), _state()
    assert (
        _foothold(_walking(2.5, commanded), commanded)[0]
        < _foothold(_walking(2.5, idle), idle)[0] - 0.02
    )


def test_feet_never_cross_nor_straddle():
    state = _state()
    along, near, far = CONFIG.reach
    for velocity in ((5.0, 5.0), (-5.0, -5.0)):
        for phase, side in ((2.5, 1.0), (2.5 + np.pi, -1.0)):
            x, y = _foothold(_walking(phase, state, velocity), state)
            assert abs(x) <= along
            assert near <= side * y <= far


# --- legs ------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [0.6, 0.72])
def test_the_swinging_leg_is_shorter(height):
    state = _state(height=height)
    m = _walking(np.pi / 2, state)
    h = np.array([height])
    joints = state[:, STATE_SLICES["joint_position"]].copy()
    rest = foot_positions(joints)[0, 0, 2]
    goal = replace(CONFIG, swing_gain=0.0, carry=0.0)
    joints[:, :15] += gait.leg_motion(
        m, stance_table().at(h), h, np.zeros((1, 2)), state, goal
    ).clip(-2, 2)
    lifted = foot_positions(joints)[0, 0, 2] - rest
    assert lifted == pytest.approx(CONFIG.lift, abs=0.03)


def test_half_a_stride_later_the_other_leg_does_the_same():
    """But for the model, which is not quite symmetric."""
    sign = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0])
    for phase in (0.3, 1.2, 2.5):
        state = _state(vx=0.3)
        now = _motion(_walking(phase, state, (0.2, 0.1)), state)[0]
        later = _motion(_walking(phase + np.pi, state, (0.2, -0.1)), state)[0]
        np.testing.assert_allclose(now[:6], later[6:12] * sign, atol=1e-3)
        np.testing.assert_allclose(now[6:12], later[:6] * sign, atol=1e-3)


def test_the_standing_leg_turns_the_pelvis_upright():
    state = _state()
    h = np.full(1, HEIGHT)
    m = _walking(np.pi / 2, state)  # left swings, right stands
    row = stance_table().at(h)
    tilt = np.array([[0.0, 0.1]])  # nose down
    change = gait.leg_motion(m, row, h, tilt, state, CONFIG) - _motion(m, state)
    assert change[0, 6] > 0.1  # hip extends under the body
    assert change[0, 10] > 0.0  # toes press


def test_the_waist_is_left_to_the_policy():
    state = _state(vx=0.4)
    assert not _motion(_walking(1.0, state), state)[:, 12:].any()
