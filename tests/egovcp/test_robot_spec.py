"""Data, models and planners of a robot of another kind than the G1."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from egovcp import spec
from egovcp.artifact import load_artifact, save_artifact
from egovcp.checks import check_dataset
from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    EpisodeIndex,
    EpisodeStore,
    Provenance,
    open_dataset,
)
from egovcp.data.store import gather, mirror_windows
from egovcp.decode import DecodeError
from egovcp.errors import ArtifactError, DataError, UsageError
from egovcp.manifest import MANIFEST, sealed
from egovcp.model import PRESETS
from egovcp.plan import PlannerConfig, Policy, blank_observation
from egovcp.plan.backends import library
from egovcp.robot_spec import G1, Mirror, RobotSpec
from egovcp.testing import random_episode, toy_model

ARM = RobotSpec(
    robot_type="arm",
    depth=(32, 48),
    depth_max_m=1.5,
    planner_hz=20,
    state_names=("angle.a", "angle.b", "speed.a", "speed.b", "height"),
    action_names=("a", "b", "grip"),
    action_box=spec.ActionBox((-1.0, -2.0, 0.0), (0.0, 0.0, 0.5), (1.0, 2.0, 2.0)),
    mirror=Mirror((1, 0, 3, 2, 4), (-1, -1, -1, -1, 1), (1, 0, 2), (-1, -1, 1)),
)
_CONTROL = Provenance("arm-1")


def _write(root: Path, robot: RobotSpec, count: int = 6) -> DatasetReader:
    with DatasetWriter(root, _CONTROL) as writer:
        for number in range(count):
            writer.add(random_episode(number, robot=robot))
    return open_dataset(root)


def test_a_description_survives_json() -> None:
    for robot in (ARM, dataclasses.replace(ARM, mirror=None)):
        assert RobotSpec.from_json(json.loads(json.dumps(robot.to_json()))) == robot
    assert RobotSpec.from_json(G1.to_json()) is G1
    assert G1.features == spec.FEATURES
    assert list(ARM.state_slices) == ["angle", "speed", "height"]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"depth": (30, 32)}, "multiples of 16"),
        ({"depth": (512, 512)}, "at most 30000 pixels"),
        ({"depth_max_m": 80.0}, "depth_max_m is 80"),
        ({"planner_hz": 0}, "planner_hz is 0"),
        ({"state_names": ("x", "y", "x")}, "state_names has 'x' twice"),
        ({"state_names": ("x", "")}, r"state_names\[1\] is empty"),
        ({"state_names": ("x",)}, "state_names are 1 names, expected 2 to 1024"),
        ({"action_names": ("a", "b")}, "for each of 2 actions"),
        ({"mirror": Mirror((1, 2, 0, 3, 4), (1,) * 5, (0, 1, 2), (1, 1, 1))}, "no reflection"),
        ({"mirror": Mirror((0, 1), (1, 1), (0, 1, 2), (1, 1, 1))}, "no reflection"),
    ],
)
def test_a_description_that_makes_no_sense_is_refused(
    changes: dict[str, object], problem: str
) -> None:
    with pytest.raises(UsageError, match=problem):
        dataclasses.replace(ARM, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [{"planner_hz": True}, {"mirror": {"state_sign": [1.0]}}])
def test_a_damaged_description_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(DecodeError, match="robot"):
        RobotSpec.from_json(ARM.to_json() | change)


def test_a_dataset_keeps_its_robot(tmp_path: Path) -> None:
    reader = _write(tmp_path / "arm", ARM)
    assert reader.robot == ARM
    assert (reader.fps, reader.info["robot_type"]) == (20, "arm")
    episode = reader.read(2)
    np.testing.assert_array_equal(episode.state, random_episode(2, robot=ARM).state)
    assert episode.depth.shape == (12, 32, 48)
    check_dataset(DatasetConfig(root=str(tmp_path / "arm")))
    assert "robot" not in _write(tmp_path / "g1", G1).info


def test_a_dataset_holds_one_robot(tmp_path: Path) -> None:
    with DatasetWriter(tmp_path / "both", _CONTROL) as writer:
        writer.add(random_episode(0))
        with pytest.raises(DataError, match="arm cannot be added to a dataset of robot unitree"):
            writer.add(random_episode(1, robot=ARM))
    arm, g1 = _write(tmp_path / "arm", ARM), _write(tmp_path / "g1", G1)
    with pytest.raises(DataError, match="train on the data of one robot"):
        EpisodeIndex.of([arm, g1])


def test_windows_are_reflected_by_the_mirror_of_the_robot(tmp_path: Path) -> None:
    store = EpisodeStore.load([_write(tmp_path / "arm", ARM)])
    batch = gather(store, store.start, np.arange(len(store.start)), 4)
    before = {name: batch[name].copy() for name in ("state", "action", "depth")}
    mirror_windows(batch, np.array([1]), store.robot)
    np.testing.assert_array_equal(batch["state"][0], before["state"][0])
    np.testing.assert_array_equal(batch["depth"][1], before["depth"][1][..., ::-1])
    expected = before["action"][1][:, [1, 0, 2]] * np.float32([-1, -1, 1])
    np.testing.assert_array_equal(batch["action"][1], expected)
    np.testing.assert_array_equal(ARM.mirrored_state(batch["state"][1]), before["state"][1])


def test_an_artifact_keeps_its_robot(tmp_path: Path) -> None:
    model = toy_model(robot=ARM)
    save_artifact(tmp_path / "policy", model, PlannerConfig(), {"controller_id": "arm-1"})
    artifact = load_artifact(str(tmp_path / "policy"))
    assert artifact.robot == ARM
    policy = artifact.make_policy(2)
    step = policy.act(*blank_observation(2, ARM))
    assert step.action.shape == (2, 3)
    assert policy.reconstruct().shape == (2, 32, 48)
    with pytest.raises(UsageError, match=r"expected \(2, 32, 48\) and \(2, 5\)"):
        policy.act(*blank_observation(2))


def test_a_changed_robot_does_not_fit_the_weights(tmp_path: Path) -> None:
    folder = tmp_path / "policy"
    save_artifact(folder, toy_model(robot=ARM), PlannerConfig(), {"controller_id": "arm-1"})
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["features"]["state_names"].append("more")
    manifest["features"]["mirror"] = None
    (folder / MANIFEST).write_text(json.dumps(sealed(manifest)))
    with pytest.raises(ArtifactError, match=r"tensor (en|de)code_state|tensor state_"):
        load_artifact(str(folder))


@pytest.mark.parametrize("optimiser", ["cem", "mppi"])
def test_the_kernel_plans_for_other_sizes(optimiser: str) -> None:
    if library.load_kernel_if_possible() is None:
        pytest.skip("no C compiler")
    sizes = dataclasses.replace(PRESETS["debug"], hidden=64, latent=16, units=64)
    model = toy_model(sizes, robot=ARM)
    rng = np.random.default_rng(0)
    depth = rng.integers(200, 1500, (1, *ARM.depth)).astype(np.uint16)
    state = rng.normal(size=(1, ARM.state_dim)).astype(np.float32)
    values = {}
    for backend in ("eager", "float32", "int8"):
        config = PlannerConfig(backend=backend, optimiser=optimiser)  # type: ignore[arg-type]
        step = Policy(model, config, 1).act(depth, state)
        assert step.plan.shape == (1, config.horizon, 3)
        values[backend] = float(step.value[0])
    assert values["float32"] == pytest.approx(values["eager"], rel=1e-3, abs=1e-3)
    assert values["int8"] == pytest.approx(values["eager"], rel=0.05)
