"""Policies without a world model: what they see, what they say, and their file."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from egovcp import spec
from egovcp.errors import ArtifactError, UsageError
from egovcp.reactive import SCHEMA, FrameStack, ReactiveConfig, ReactiveNetwork, ReactivePolicy
from tests.support.models import toy_reactive

ROWS, COLS = spec.DEPTH_ROWS, spec.DEPTH_COLS


def _flat(metres: list[float]) -> np.ndarray:
    """One flat depth image for each robot."""
    depth = np.array(metres, dtype=np.float64)[:, None, None] * 1e3
    return np.broadcast_to(depth, (len(metres), ROWS, COLS)).astype(np.uint16)


def _seen(stack: FrameStack, metres: list[float], is_first: list[bool]) -> list[list[float]]:
    images = stack.push(_flat(metres), np.array(is_first))
    return [[round(float(x.mean()), 3) for x in robot] for robot in images]


def test_frames_are_newest_first_and_repeat_after_a_reset() -> None:
    stack = FrameStack(2, ReactiveConfig(frames=3))
    assert _seen(stack, [1.0, 2.0], [True, True]) == [[0.8] * 3, [0.6] * 3]
    assert _seen(stack, [2.0, 3.0], [False, False]) == [[0.6, 0.8, 0.8], [0.4, 0.6, 0.6]]
    assert _seen(stack, [3.0, 4.0], [False, True]) == [[0.4, 0.6, 0.8], [0.2] * 3]


def test_frames_are_copied() -> None:
    stack = FrameStack(1, ReactiveConfig(frames=2))
    first = stack.push(_flat([1.0]), np.array([True]))
    before = first.clone()
    stack.push(_flat([3.0]), np.array([True]))
    assert torch.equal(first, before)


def test_reset_clears_the_frames() -> None:
    policy, state = ReactivePolicy(toy_reactive("c"), 1), np.zeros((1, spec.STATE_DIM))
    alone = policy.act(_flat([1.0]), state).action
    policy.observe(_flat([3.0]), state)
    later = policy.act(_flat([1.0]), state).action
    assert not np.allclose(alone, later)
    policy.reset()
    np.testing.assert_array_equal(policy.act(_flat([1.0]), state).action, alone)
    assert alone.shape == (1, spec.ACTION_DIM)
    assert np.abs(alone).max() <= 1.0


def test_save_and_load_round_trip(tmp_path: Path) -> None:
    network = toy_reactive("walk-1")
    network.save(tmp_path / "ppo.safetensors")
    loaded = ReactiveNetwork.load(tmp_path / "ppo.safetensors")
    images = torch.rand(3, 2, ROWS, COLS)
    state = torch.randn(3, spec.STATE_DIM)
    assert torch.equal(network(images, state), loaded(images, state))
    assert (loaded.config, loaded.controller_id) == (network.config, "walk-1")
    assert loaded.provenance == {"steps": 0}
    loaded.require_controller("walk-1")
    with pytest.raises(ArtifactError, match="walk-1, the robot has walk-2"):
        loaded.require_controller("walk-2")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": torch.zeros(3)}, r"mean has shape \[3\]"),
        ({"std": torch.zeros(spec.STATE_DIM)}, "not positive"),
        ({"mlp.1.bias": torch.full((7,), torch.nan)}, "finite"),
        ({"cnn.0.bias": None}, "cnn.0.bias"),
    ],
)
def test_damaged_files_are_refused(
    tmp_path: Path, change: dict[str, torch.Tensor | None], message: str
) -> None:
    path = tmp_path / "ppo.safetensors"
    toy_reactive("c").save(path)
    tensors = {k: v for k, v in (load_file(path) | change).items() if v is not None}
    _write(path, tensors)
    with pytest.raises(ArtifactError, match=message):
        ReactiveNetwork.load(path)


@pytest.mark.parametrize(("depth_max_m", "is_read"), [(spec.DEPTH_MAX_M, True), (3.0, False)])
def test_files_of_earlier_versions_are_read(
    tmp_path: Path, depth_max_m: float, is_read: bool
) -> None:
    path, network = tmp_path / "ppo.safetensors", toy_reactive("c")
    _write(path, dict(network.tensors), depth_max_m=depth_max_m)
    if is_read:
        assert ReactiveNetwork.load(path).config == network.config
    else:
        with pytest.raises(ArtifactError, match="depth_max_m"):
            ReactiveNetwork.load(path)


def _write(path: Path, tensors: dict[str, torch.Tensor], **config: float) -> None:
    sizes = {"frames": 2, "channels": [2, 4, 4], "hidden": [16]}
    content = {"config": sizes | config, "controller_id": "c", "provenance": {}}
    save_file(tensors, path, {"schema": SCHEMA, "content": json.dumps(content)})


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no such policy"):
        ReactiveNetwork.load(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("text")
    with pytest.raises(ArtifactError, match="not a policy of schema"):
        ReactiveNetwork.load(tmp_path / "text.safetensors")
    save_file({"x": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ArtifactError, match="its schema is null"):
        ReactiveNetwork.load(tmp_path / "other.safetensors")


@pytest.mark.parametrize(
    "change", [{"frames": 0}, {"hidden": (0,)}, {"hidden": ()}, {"channels": (1, 0, 1)}]
)
def test_sizes_count_from_one(change: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=r"expected at least (1|one layer)"):
        ReactiveConfig(**change)  # type: ignore[arg-type]
