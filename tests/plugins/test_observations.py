"""The observations that `select_action` accepts, and what it says of others."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.utils import build_inference_frame
from torch import Tensor

from egovcp import spec
from egovcp.errors import ArtifactError, DataError
from lerobot_policy_egovcp import EgovcpPolicy
from lerobot_policy_egovcp.batches import read_observation

ROBOTS = 2
Batch = dict[str, Any]


@pytest.fixture
def depth() -> Tensor:
    """(E, 1, 48, 64) float32, whole millimetres."""
    shape = (ROBOTS, 1, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    rng = np.random.default_rng(0)
    return torch.from_numpy(rng.integers(300, 5000, shape).astype(np.float32))


@pytest.fixture
def state() -> Tensor:
    """(E, 74) float32."""
    return torch.from_numpy(np.random.default_rng(1).normal(size=(ROBOTS, 74)).astype(np.float32))


def _read(depth: Any, state: Any) -> tuple[np.ndarray, np.ndarray]:
    return read_observation({spec.DEPTH_KEY: depth, spec.STATE_KEY: state})


@pytest.mark.parametrize(
    "dtype", ["uint16", "int16", "int32", "uint32", "int64", "float32", "float64"]
)
def test_depth_of_any_numeric_type_is_the_same(depth: Tensor, state: Tensor, dtype: str) -> None:
    found, _ = _read(depth.to(getattr(torch, dtype)), state)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, depth[:, 0].numpy())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_state_of_any_float_type_becomes_float32(
    depth: Tensor, state: Tensor, dtype: torch.dtype
) -> None:
    _, found = _read(depth, state.to(dtype))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, state.numpy(), rtol=0.01, atol=0.01)


def test_the_channel_may_be_last(depth: Tensor, state: Tensor) -> None:
    expected = _read(depth, state)[0]
    np.testing.assert_array_equal(_read(depth.movedim(1, -1), state)[0], expected)
    np.testing.assert_array_equal(_read(depth[0].movedim(0, -1), state[0])[0], expected[:1])


def test_an_observation_without_batch_dimension_is_that_of_one_robot(
    depth: Tensor, state: Tensor
) -> None:
    for one in (_read(depth[0], state[0]), _read(depth[0], state[:1]), _read(depth[:1], state[0])):
        for found, expected in zip(one, _read(depth[:1], state[:1]), strict=True):
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda depth: depth[..., :32], r"shape \(2, 1, 48, 32\); expected \(E, 1, 48, 64\)"),
        (lambda depth: depth[:, 0], r"shape \(2, 48, 64\); expected \(E, 1, 48, 64\)"),
        (lambda depth: depth[0, 0], r"shape \(48, 64\); .* or \(1, 48, 64\) for one"),
        (lambda depth: depth[None], r"shape \(1, 2, 1, 48, 64\)"),
        (lambda depth: depth.repeat(1, 3, 1, 1), r"shape \(2, 3, 48, 64\)"),
        (lambda depth: depth.to(torch.uint8), "type uint8; expected"),
        (lambda depth: depth / 1e3, "millimetres, not metres"),
        (lambda depth: depth.clamp_max(300) / 1e3, r"at most 0\.3, .* not metres"),
        (lambda depth: depth.clamp_max(5).to(torch.uint16), "millimetres, not metres"),
        (lambda depth: depth.numpy(), r"is a ndarray; expected a torch\.Tensor"),
        (lambda depth: depth[:1], "of 1 robots and .* of 2"),
    ],
)
def test_other_depth_is_refused(
    depth: Tensor, state: Tensor, change: Callable[[Tensor], Any], message: str
) -> None:
    with pytest.raises(DataError, match=rf"ego_depth.*{message}"):
        _read(change(depth), state)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state[:, :73], r"shape \(2, 73\); expected \(E, 74\)"),
        (lambda state: state[0, :73], r"shape \(73,\); .* or \(74\) for one"),
        (lambda state: state[None], r"shape \(1, 2, 74\)"),
        (lambda state: state > 0, "type bool; expected numbers"),
        (lambda state: state.tolist(), r"is a list; expected a torch\.Tensor"),
    ],
)
def test_another_state_is_refused(
    depth: Tensor, state: Tensor, change: Callable[[Tensor], Any], message: str
) -> None:
    with pytest.raises(DataError, match=rf"observation\.state.*{message}"):
        _read(depth, change(state))


def test_an_incomplete_observation_is_refused(depth: Tensor, state: Tensor) -> None:
    with pytest.raises(DataError, match=r"no 'observation\.images\.ego_depth', only .*\.state"):
        read_observation({spec.STATE_KEY: state})
    with pytest.raises(DataError, match=r"no 'observation\.state', only .*ego_depth"):
        read_observation({spec.DEPTH_KEY: depth})
    with pytest.raises(DataError, match="only other keys"):
        read_observation({})
    with pytest.raises(DataError, match="at least one robot"):
        _read(depth[:0], state[:0])


# --- the policy ----------------------------------------------------------------------------
def test_an_observation_of_the_robot_plugin_is_accepted(
    artifact: Path, depth: Tensor, state: Tensor
) -> None:
    """`EgovcpG1.get_observation`: uint16 (48, 64, 1), which LeRobot only transposes."""
    raw = dict(zip(spec.STATE_NAMES, state[0].tolist(), strict=True))
    raw["ego_depth"] = depth[0].movedim(0, -1).numpy().astype(np.uint16)
    features = {
        spec.STATE_KEY: {"dtype": "float32", "shape": (74,), "names": list(spec.STATE_NAMES)},
        spec.DEPTH_KEY: {"dtype": "video", "shape": (48, 64, 1), "names": None},
    }
    frame = build_inference_frame(raw, torch.device("cpu"), features)
    assert frame[spec.DEPTH_KEY].dtype == torch.uint16
    batch = {spec.DEPTH_KEY: depth[:1], spec.STATE_KEY: state[:1]}
    expected = EgovcpPolicy.from_pretrained(artifact).select_action(batch)
    assert torch.equal(EgovcpPolicy.from_pretrained(artifact).select_action(frame), expected)


def test_a_refused_observation_does_not_change_the_policy(
    artifact: Path, depth: Tensor, state: Tensor
) -> None:
    batch = {spec.DEPTH_KEY: depth, spec.STATE_KEY: state}
    expected = EgovcpPolicy.from_pretrained(artifact).select_action(batch)
    policy = EgovcpPolicy.from_pretrained(artifact)
    with pytest.raises(DataError, match="73"):
        policy.select_action(batch | {spec.STATE_KEY: state[:, :73]})
    assert torch.equal(policy.select_action(batch), expected)


def test_a_covered_camera_is_refused_in_the_first_image_only(
    artifact: Path, depth: Tensor, state: Tensor
) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    covered = {spec.DEPTH_KEY: torch.full_like(depth, 200.0), spec.STATE_KEY: state}
    with pytest.raises(DataError, match="not metres"):
        policy.select_action(covered)
    policy.select_action({spec.DEPTH_KEY: depth, spec.STATE_KEY: state})
    policy.select_action(covered)
    policy.reset()
    with pytest.raises(DataError, match="not metres"):
        policy.select_action(covered)


def test_a_state_that_is_not_finite_is_skipped_with_one_warning(
    artifact: Path, depth: Tensor, state: Tensor, caplog: pytest.LogCaptureFixture
) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    bad = state.clone()
    bad[1, 20] = torch.nan
    actions = []
    with caplog.at_level(logging.WARNING, "lerobot_policy_egovcp"):
        for seen in (state, bad, bad, state, bad):
            batch = {spec.DEPTH_KEY: depth, spec.STATE_KEY: seen}
            actions.append(policy.select_action(batch))
    assert torch.stack(actions).isfinite().all()
    found = [r.getMessage() for r in caplog.records if r.name.startswith("lerobot_policy_egovcp")]
    assert (
        found
        == [f"skipped the observation of robot 1: {spec.STATE_KEY} is not finite, or impossible"]
        * 2
    )


def test_a_controller_other_than_that_of_the_data_is_refused(
    artifact: Path, depth: Tensor, state: Tensor
) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    batch: Batch = {spec.DEPTH_KEY: depth, spec.STATE_KEY: state}
    with pytest.raises(ArtifactError, match=r"stance.*'walker-7'.*--env\.simulation\.controller"):
        policy.select_action(batch | {"info": {spec.CONTROLLER_ID_KEY: "walker-7"}})
    policy.select_action(batch | {"info": {}})


# --- datasets ------------------------------------------------------------------------------
def test_a_frame_of_a_dataset_is_accepted(artifact: Path, dataset_root: Path) -> None:
    frame = LeRobotDataset("me/ball", root=dataset_root)[0]
    batch = {key: frame[key][None] for key in (spec.DEPTH_KEY, spec.STATE_KEY)}
    expected = EgovcpPolicy.from_pretrained(artifact).select_action(batch)
    action = EgovcpPolicy.from_pretrained(artifact).select_action(frame)
    assert action.shape == (1, spec.ACTION_DIM)
    assert torch.equal(action, expected)
