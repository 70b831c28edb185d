"""Files of the walking policy: safetensors and ONNX."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from safetensors.numpy import save_file

from egovcp.errors import ArtifactError
from egovcp.robot.g1 import STIFFNESS
from egovcp.robot.gait import GaitConfig
from egovcp.robot.walk_policy import OBSERVATION_NAMES, SCHEMA, WalkPolicy, export_onnx
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.spec import JOINT_NAMES

SIZES = (OBSERVATION_DIM, 16, 8, ACTIONS)


@pytest.fixture
def policy() -> WalkPolicy:
    rng = np.random.default_rng(0)

    def array(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape).astype(np.float32)

    layers = tuple(
        (array(after, before), array(after)) for before, after in itertools.pairwise(SIZES)
    )
    config = WalkConfig(gait=GaitConfig(step_time=0.35))
    std = np.abs(array(OBSERVATION_DIM)) + 0.1
    return WalkPolicy(array(OBSERVATION_DIM), std, layers, config, {"seed": 3})


def test_saved_and_loaded_it_is_the_same(policy: WalkPolicy, tmp_path: Path):
    path = tmp_path / "walk.safetensors"
    policy.save(path)
    loaded = WalkPolicy.load(path)
    x = np.random.default_rng(1).standard_normal((4, OBSERVATION_DIM)).astype(np.float32)
    np.testing.assert_array_equal(loaded(x), policy(x))
    assert loaded.digest == policy.digest
    assert loaded.config == policy.config
    assert loaded.provenance == {"seed": 3}


def test_it_is_the_network_that_torch_makes_of_the_same_numbers(policy: WalkPolicy):
    modules: list[torch.nn.Module] = []
    for weight, bias in policy.layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": torch.tensor(weight), "bias": torch.tensor(bias)})
        modules += [linear, torch.nn.ELU()]
    network = torch.nn.Sequential(*modules[:-1])
    x = np.random.default_rng(1).standard_normal((4, OBSERVATION_DIM)).astype(np.float32)
    with torch.no_grad():
        scaled = (torch.tensor(x) - torch.tensor(policy.mean)) / torch.tensor(policy.std)
        expected = network(scaled.clamp(-10, 10)).numpy()
    np.testing.assert_allclose(policy(x), expected, rtol=1e-4, atol=1e-4)


def test_a_rows_bits_do_not_depend_on_the_batch(policy: WalkPolicy):
    x = np.random.default_rng(1).standard_normal((33, OBSERVATION_DIM)).astype(np.float32)
    np.testing.assert_array_equal(policy(x)[7:8], policy(x[7:8]))


def test_the_digest_follows_every_number(policy: WalkPolicy):
    other = replace(policy, mean=policy.mean + np.float32(1e-3))
    walk = replace(policy, config=WalkConfig(action_scale=0.31))
    assert len({policy.digest, other.digest, walk.digest}) == 3


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(ArtifactError, match=r"none\.safetensors.*egovcp-train-lowlevel"):
        WalkPolicy.load(tmp_path / "none.safetensors")


def _tensors(policy: WalkPolicy) -> dict[str, np.ndarray]:
    out = {"mean": policy.mean, "std": policy.std}
    for i, (weight, bias) in enumerate(policy.layers):
        out |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
    return out


GOOD = {"schema": SCHEMA, "content": json.dumps({"config": {}, "provenance": {}})}


@pytest.mark.parametrize(
    ("change", "metadata", "reason"),
    [
        ({}, {}, "schema is null"),
        ({}, GOOD | {"schema": "egovcp-walk-0"}, "egovcp-walk-0"),
        ({}, {"schema": SCHEMA}, "content"),
        ({}, GOOD | {"content": "{"}, "double quotes"),
        ({}, GOOD | {"content": '{"config": {"gaits": 1}, "provenance": {}}'}, "gaits"),
        ({"mean": np.zeros(94, np.float32)}, GOOD, r"mean has shape \(94,\)"),
        ({"mean": np.full(OBSERVATION_DIM, np.nan, np.float32)}, GOOD, "finite"),
        ({"mean": np.zeros(OBSERVATION_DIM)}, GOOD, "mean has dtype F64, expected F32"),
        ({"std": np.zeros(OBSERVATION_DIM, np.float32)}, GOOD, "not positive"),
        ({"layers.0.bias": np.zeros(5, np.float32)}, GOOD, "layer 0"),
        ({"layers.3.weight": np.zeros((ACTIONS, 3), np.float32)}, GOOD, "layers.3.bias"),
    ],
)
def test_anything_else_is_refused(policy, tmp_path, change, metadata, reason):
    path = tmp_path / "walk.safetensors"
    save_file(_tensors(policy) | change, path, metadata=metadata or None)
    with pytest.raises(ArtifactError, match=reason):
        WalkPolicy.load(path)


def test_a_torn_file_is_refused(policy: WalkPolicy, tmp_path: Path):
    path = tmp_path / "walk.safetensors"
    policy.save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ArtifactError, match="not a controller"):
        WalkPolicy.load(path)


@pytest.fixture
def sine_policy() -> WalkPolicy:
    """Numbers that anyone can make again: sines."""

    def wave(*shape: int) -> np.ndarray:
        return np.sin(np.arange(1, np.prod(shape) + 1)).reshape(shape).astype(np.float32)

    layers = ((wave(8, OBSERVATION_DIM) / 9, wave(8)), (wave(ACTIONS, 8), wave(ACTIONS)))
    std = np.abs(wave(OBSERVATION_DIM)) + np.float32(0.5)
    return WalkPolicy(wave(OBSERVATION_DIM), std, layers, WalkConfig(), {"seed": 7})


#: Its first actions for an observation of ones, computed in plain Python floats.
GOLDEN = (-5.4366, 5.4674, 5.0928, -6.7559, -4.1649)


@pytest.fixture
def path(sine_policy: WalkPolicy, tmp_path: Path) -> Path:
    export_onnx(sine_policy, tmp_path / "walk.onnx")
    return tmp_path / "walk.onnx"


def test_both_give_the_golden_vector(sine_policy: WalkPolicy, path: Path):
    ones = np.ones((1, OBSERVATION_DIM), dtype=np.float32)
    np.testing.assert_allclose(sine_policy(ones)[0, :5], GOLDEN, atol=1e-3)
    np.testing.assert_allclose(_run(path, ones)[0, :5], GOLDEN, atol=1e-3)


def test_the_exported_network_is_the_same(sine_policy: WalkPolicy, path: Path):
    x = 5 * np.random.default_rng(0).standard_normal((6, OBSERVATION_DIM)).astype(np.float32)
    np.testing.assert_allclose(_run(path, x), sine_policy(x), rtol=1e-4, atol=1e-4)


def _run(path: Path, observation: np.ndarray) -> np.ndarray:
    (action,) = onnxruntime.InferenceSession(path).run(["action"], {"observation": observation})
    return action


def test_the_metadata_tell_the_rest(sine_policy: WalkPolicy, path: Path):
    properties = {p.key: p.value for p in onnx.load(str(path)).metadata_props}
    assert properties["digest"] == sine_policy.digest
    assert json.loads(properties["provenance"]) == {"seed": 7}
    assert json.loads(properties["joint_names"]) == list(JOINT_NAMES)
    assert json.loads(properties["stiffness"]) == STIFFNESS.tolist()
    assert len(json.loads(properties["default_joint_position"])) == len(JOINT_NAMES)
    assert float(properties["action_scale"]) == WalkConfig().action_scale
    assert len(OBSERVATION_NAMES) == OBSERVATION_DIM == len(set(OBSERVATION_NAMES))
