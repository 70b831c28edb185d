"""The clock of walking: when it steps, when it stands, and what the legs do."""

import numpy as np
import pytest

from egovcp.robot import gait
from egovcp.robot.gait import Gait, GaitConfig
from egovcp.robot.kinematics import LINK_NAMES, link_transforms
from egovcp.robot.stance_table import stance_table
from egovcp.spec import NUM_JOINTS, STATE_DIM, STATE_SLICES

CONFIG = GaitConfig()
FEET = [LINK_NAMES.index(f"{side}_ankle_roll_link") for side in ("left", "right")]


def _state(batch: int = 1, vx: float = 0.0, vy: float = 0.0) -> np.ndarray:
    state = np.zeros((batch, STATE_DIM))
    state[:, STATE_SLICES["command_velocity"]] = (vx, vy, 0.0)
    return state


def _run(m: Gait, state: np.ndarray, ticks: int) -> list[np.ndarray]:
    return [gait.advance(m, state, np.zeros((len(state), 2)), CONFIG) for _ in range(ticks)]


def test_a_robot_that_is_not_told_to_walk_stands():
    m = gait.start(3)
    _run(m, _state(3), 100)
    assert not m.amount.any()
    assert not gait.leg_motion(
        m, stance_table().at(np.full(3, 0.74)).joints, np.zeros((3, 3)), CONFIG
    ).any()


def test_it_walks_while_told_to_and_stands_once_the_feet_are_together():
    m = gait.start(1)
    _run(m, _state(vx=0.3), 50)
    assert m.amount == 1
    stood = _run(m, _state(), round((CONFIG.linger + CONFIG.fade) * 50) + 2)
    assert m.amount == 0
    assert sum(int(s[0]) for s in stood) == 1


def test_one_period_is_one_turn_of_the_clock():
    m = gait.start(1)
    _run(m, _state(vx=0.3), 20)
    before = m.phase.copy()
    _run(m, _state(vx=0.3), round(CONFIG.period * 50))
    assert np.cos(m.phase - before) == pytest.approx(1.0)


def test_it_steps_when_it_tips_over():
    m = gait.start(2)
    gait.advance(m, _state(2), np.array([[0.05, 0.0], [0.0, 0.3]]), CONFIG)
    assert (m.amount > 0).tolist() == [False, True]


@pytest.mark.parametrize(("vy", "left_first"), [(0.2, True), (-0.2, False)])
def test_the_foot_on_the_side_of_the_motion_swings_first(vy, left_first):
    m = gait.start(1)
    _run(m, _state(vy=vy), 8)
    assert (np.sin(m.phase[0]) > 0) == left_first


def _feet(phase: float, height: float = 0.72, vx: float = 0.0) -> np.ndarray:
    """(2, 3) feet below the pelvis and (2,) how far their soles point up."""
    pose = stance_table().at(np.array([height])).joints
    m = Gait(np.array([phase]), np.ones(1), np.ones(1))
    joints = np.zeros((1, NUM_JOINTS))
    joints[:, :15] = pose + gait.leg_motion(m, pose, np.array([[vx, 0.0, 0.0]]), CONFIG)
    position, rotation = link_transforms(joints)
    return np.concatenate([position[0, FEET], rotation[0, FEET][:, :1, 2]], axis=1)


@pytest.mark.parametrize("height", [0.6, 0.72])
def test_the_swinging_foot_is_lifted_and_both_soles_stay_as_level_as_in_standing(height):
    rest, swing = _feet(0.0, height), _feet(np.pi / 2, height)
    assert swing[0, 2] - rest[0, 2] == pytest.approx(CONFIG.lift, abs=0.015)
    assert swing[1, 2] == pytest.approx(rest[1, 2], abs=0.005)
    np.testing.assert_allclose(swing[:, 3], rest[:, 3], atol=0.01)


def test_a_stride_covers_the_way_that_the_speed_asks_for():
    """A foot stands for half a period, in which the pelvis moves by v T / 2."""
    back, front = _feet(0.0, vx=0.4)[0, 0], _feet(np.pi, vx=0.4)[0, 0]
    assert front - back == pytest.approx(0.4 * CONFIG.period / 2, rel=0.1)


def test_half_a_stride_later_the_other_leg_does_the_same():
    mirror = np.array([1.0, -1.0, 1.0, 1.0])
    for phase in (0.3, 1.2, 2.5):
        now, later = _feet(phase, vx=0.3), _feet(phase + np.pi, vx=0.3)
        np.testing.assert_allclose(now[0], later[1] * mirror, atol=1e-3)
