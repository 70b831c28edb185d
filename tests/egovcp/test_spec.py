"""The shared specification agrees with itself."""

import json

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import (
    ArtifactError,
    ConformanceError,
    DataError,
    EgovcpError,
    EnvironmentFailure,
    SafetyStop,
    UsageError,
    suggest,
)

BOX = spec.ACTION_BOX


def _random(rows: int) -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform(-1, 1, (rows, spec.ACTION_DIM))


# --- clock ------------------------------------------------------------------------------
def test_a_planner_tick_is_a_whole_number_of_controller_ticks_and_physics_steps() -> None:
    steps = spec.CONTROLLER_TICKS_PER_PLAN * spec.PHYSICS_STEPS_PER_CONTROLLER_TICK
    assert steps * spec.PHYSICS_DT == pytest.approx(spec.PLANNER_DT)
    assert spec.PHYSICS_STEPS_PER_CONTROLLER_TICK * spec.PHYSICS_DT == 1 / spec.CONTROLLER_HZ
    assert spec.CONTROLLER_HZ == spec.PLANNER_HZ * spec.CONTROLLER_TICKS_PER_PLAN


# --- the state --------------------------------------------------------------------------
def test_the_slices_tile_the_state_without_gap_or_overlap() -> None:
    taken = [i for part in spec.STATE_SLICES.values() for i in range(part.start, part.stop)]
    assert taken == list(range(spec.STATE_DIM))


def test_every_value_of_state_and_action_has_a_name_of_its_own() -> None:
    for names, size in (
        (spec.STATE_NAMES, spec.STATE_DIM),
        (spec.ACTION_NAMES, spec.ACTION_DIM),
        (spec.JOINT_NAMES, spec.NUM_JOINTS),
    ):
        assert len(names) == len(set(names)) == size


def test_the_command_is_velocity_hands_and_height() -> None:
    parts = [spec.STATE_SLICES[f"command_{name}"] for name in ("velocity", "hands", "height")]
    assert (parts[0].start, parts[-1].stop) == (spec.COMMAND_SLICE.start, spec.COMMAND_SLICE.stop)
    assert spec.COMMAND_SLICE.stop - spec.COMMAND_SLICE.start == 10
    named = spec.STATE_NAMES[spec.COMMAND_SLICE][-spec.ACTION_DIM :]
    assert [name.removeprefix("command.") for name in named] == list(spec.ACTION_NAMES)


def test_the_joint_slices_follow_the_joint_names() -> None:
    for part, suffix in (("joint_position", ".pos"), ("joint_velocity", ".vel")):
        names = spec.STATE_NAMES[spec.STATE_SLICES[part]]
        assert [name.removesuffix(suffix) for name in names] == list(spec.JOINT_NAMES)


# --- the action box ---------------------------------------------------------------------
def test_zero_is_neutral_and_one_reaches_the_walls() -> None:
    ones = np.ones(spec.ACTION_DIM)
    np.testing.assert_allclose(BOX.to_metric(0 * ones), BOX.neutral)
    np.testing.assert_allclose(BOX.to_metric(-ones), BOX.low)
    np.testing.assert_allclose(BOX.to_metric(ones), BOX.high)


def test_the_neutral_pose_lies_inside_the_box() -> None:
    assert (np.array(BOX.low) < np.array(BOX.neutral)).all()
    assert (np.array(BOX.neutral) < np.array(BOX.high)).all()


def test_to_metres_and_back_is_the_identity() -> None:
    actions = _random(500)
    np.testing.assert_allclose(BOX.to_normalised(BOX.to_metric(actions)), actions, atol=1e-12)
    metric = BOX.to_metric(actions)
    np.testing.assert_allclose(BOX.to_metric(BOX.to_normalised(metric)), metric, atol=1e-12)


def test_the_map_is_continuous_increasing_and_shape_agnostic() -> None:
    sweep = np.linspace(-1, 1, 201)[:, None] * np.ones(spec.ACTION_DIM)
    metric = BOX.to_metric(sweep)
    assert (np.diff(metric, axis=0) > 0).all()
    assert np.diff(metric, axis=0).max() < 0.02
    stacked = _random(6).reshape(2, 3, spec.ACTION_DIM)
    np.testing.assert_array_equal(BOX.to_metric(stacked)[1, 2], BOX.to_metric(stacked[1, 2]))


def test_left_and_right_hand_have_mirrored_boxes() -> None:
    for name in ("low", "neutral", "high"):
        left = getattr(BOX, name)[:3]
        mirrored = {"low": "high", "high": "low"}.get(name, name)
        right = getattr(BOX, name)[3], -getattr(BOX, mirrored)[4], getattr(BOX, name)[5]
        assert left == pytest.approx(right), name


def test_the_random_walk_stays_within_the_rate_limit() -> None:
    assert spec.ACTION_RATE_LIMIT >= spec.ACTION_ETA


# --- features ---------------------------------------------------------------------------
def test_the_features_are_json_and_have_the_shapes_of_the_constants() -> None:
    features = json.loads(json.dumps(spec.FEATURES))
    assert features[spec.DEPTH_KEY]["shape"] == [spec.DEPTH_ROWS, spec.DEPTH_COLS, 1]
    assert features[spec.STATE_KEY]["shape"] == [len(features[spec.STATE_KEY]["names"])]
    assert features[spec.ACTION_KEY]["shape"] == [len(features[spec.ACTION_KEY]["names"])]


# --- errors -----------------------------------------------------------------------------
def test_every_kind_of_error_has_its_exit_code() -> None:
    kinds = (UsageError, DataError, ArtifactError, EnvironmentFailure, SafetyStop)
    assert [kind.exit_code for kind in kinds] == [2, 3, 4, 5, 6]
    assert all(issubclass(kind, EgovcpError) for kind in (*kinds, ConformanceError))


def test_a_suggestion_names_the_nearest_and_all_choices() -> None:
    assert (
        suggest("bal", ("ball", "wall", "arch"))
        == "; did you mean 'ball'? choose from: arch, ball, wall"
    )
    assert suggest("xyz", ("ball", "wall", "arch")) == "; choose from: arch, ball, wall"
