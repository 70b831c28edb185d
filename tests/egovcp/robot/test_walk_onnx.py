"""The export says what the policy says, and tells a robot computer the rest."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest

from egovcp.errors import ArtifactError
from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import STIFFNESS
from egovcp.robot.walk_policy import OBSERVATION_NAMES, OnnxPolicy, WalkPolicy, export_onnx
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.spec import JOINT_NAMES


@pytest.fixture
def policy() -> WalkPolicy:
    """Numbers that anyone can make again: sines."""

    def wave(*shape: int) -> np.ndarray:
        return np.sin(np.arange(1, np.prod(shape) + 1)).reshape(shape).astype(np.float32)

    layers = ((wave(8, OBSERVATION_DIM) / 9, wave(8)), (wave(ACTIONS, 8), wave(ACTIONS)))
    std = np.abs(wave(OBSERVATION_DIM)) + np.float32(0.5)
    return WalkPolicy(wave(OBSERVATION_DIM), std, layers, WalkConfig(), {"seed": 7})


#: Its first actions for an observation of ones, computed in plain Python floats.
GOLDEN = (-5.4366, 5.4674, 5.0928, -6.7559, -4.1649)


@pytest.fixture
def path(policy: WalkPolicy, tmp_path: Path) -> Path:
    export_onnx(policy, tmp_path / "walk.onnx")
    return tmp_path / "walk.onnx"


def test_both_give_the_golden_vector(policy: WalkPolicy, path: Path):
    ones = np.ones((1, OBSERVATION_DIM), dtype=np.float32)
    np.testing.assert_allclose(policy(ones)[0, :5], GOLDEN, atol=1e-3)
    np.testing.assert_allclose(OnnxPolicy(path)(ones)[0, :5], GOLDEN, atol=1e-3)


def test_it_is_the_same_policy(policy: WalkPolicy, path: Path):
    exported = OnnxPolicy(path)
    x = 5 * np.random.default_rng(0).standard_normal((6, OBSERVATION_DIM)).astype(np.float32)
    np.testing.assert_allclose(exported(x), policy(x), rtol=1e-4, atol=1e-4)
    assert exported.digest == policy.digest
    assert exported.config == policy.config
    assert exported.provenance == {"seed": 7}


def test_the_controller_is_the_same_to_its_datasets(policy: WalkPolicy, path: Path):
    policy.save(path.with_suffix(".safetensors"))
    saved = make_controller(str(path.with_suffix(".safetensors")))
    assert make_controller(str(path)).id == saved.id


def test_the_metadata_tell_the_rest(path: Path):
    properties = {p.key: p.value for p in onnx.load(str(path)).metadata_props}
    assert json.loads(properties["joint_names"]) == list(JOINT_NAMES)
    assert json.loads(properties["stiffness"]) == STIFFNESS.tolist()
    assert len(json.loads(properties["default_joint_position"])) == len(JOINT_NAMES)
    assert float(properties["action_scale"]) == WalkConfig().action_scale
    assert len(OBSERVATION_NAMES) == OBSERVATION_DIM == len(set(OBSERVATION_NAMES))


def _changed(path: Path, key: str, value: str) -> None:
    model = onnx.load(str(path))
    for entry in model.metadata_props:
        if entry.key == key:
            entry.value = value
    onnx.save(model, str(path))


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("schema", "other", "other"),
        ("joint_names", "[]", "joint_names are others"),
        ("config", '{"gaits": 1}', "gaits"),
    ],
)
def test_another_layout_is_refused(path: Path, key: str, value: str, reason: str):
    _changed(path, key, value)
    with pytest.raises(ArtifactError, match=reason):
        OnnxPolicy(path)


def test_a_torn_or_missing_file_is_refused(path: Path):
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ArtifactError, match="not a controller"):
        OnnxPolicy(path)
    with pytest.raises(ArtifactError, match="no such controller"):
        OnnxPolicy(path.with_name("none.onnx"))
