"""An artifact of egovcp-train behind LeRobot's interface acts as it does without LeRobot."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from torch import Tensor

from egovcp import spec
from egovcp.artifact import CONFIG, WEIGHTS, load_artifact
from egovcp.data import DatasetWriter, Provenance
from egovcp.errors import ArtifactError, DataError, UsageError
from egovcp.manifest import MANIFEST, PROCESSORS
from egovcp.testing import random_episode
from lerobot_policy_egovcp import EgovcpConfig, EgovcpPolicy, make_egovcp_pre_post_processors

type Observation = tuple[np.ndarray, np.ndarray]


def _observations(robots: int, ticks: int) -> list[Observation]:
    rng = np.random.default_rng(0)
    shape = (ticks, robots, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    depth = rng.integers(0, 5000, shape).astype(np.uint16)
    state = rng.normal(size=(ticks, robots, spec.STATE_DIM)).astype(np.float32)
    return list(zip(depth, state, strict=True))


def _batch(depth: np.ndarray, state: np.ndarray) -> dict[str, Tensor]:
    """As LeRobot shows it."""
    image = torch.from_numpy(depth.astype(np.float32))[:, None]
    return {spec.DEPTH_KEY: image, spec.STATE_KEY: torch.from_numpy(state)}


def _actions(policy: EgovcpPolicy, observations: list[Observation]) -> np.ndarray:
    return np.stack([policy.select_action(_batch(*seen)).numpy() for seen in observations])


# --- the same actions ---------------------------------------------------------------------
@pytest.mark.parametrize("robots", [1, 3])
def test_actions_are_those_of_the_artifact(artifact: Path, robots: int) -> None:
    observations = _observations(robots, ticks=3)
    policy = EgovcpPolicy.from_pretrained(artifact)
    plain = load_artifact(str(artifact)).make_policy(num_envs=robots)
    for depth, state in observations:
        expected = plain.act(depth, state).action
        plain.advance(expected)
        np.testing.assert_array_equal(policy.select_action(_batch(depth, state)), expected)


def test_the_predicted_video_is_what_the_first_robot_imagines(artifact: Path) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    policy.config.save_predicted_video = True
    plain = load_artifact(str(artifact)).make_policy(num_envs=2)
    latents = []
    for depth, state in _observations(2, ticks=3):
        policy.select_action(_batch(depth, state))
        latents.append(policy.last_predicted_latents)
        step = plain.act(depth, state)
        ahead = plain.imagine(step.plan, 16)[0]
        expected = np.hstack([plain.reconstruct()[0], *ahead[[3, 7, 15]]])
        np.testing.assert_array_equal(latents[-1][0, 0, 0], expected)
        plain.advance(step.action)
    frames = policy.decode_predicted_latents(torch.cat(latents, dim=2))
    assert frames.shape == (3, 4 * spec.DEPTH_ROWS, 4 * 4 * spec.DEPTH_COLS, 3)
    assert frames.any()


def test_make_policy_and_the_processors_give_the_same_actions(
    artifact: Path, meta: LeRobotDatasetMetadata
) -> None:
    """The way of lerobot-eval and lerobot-record."""
    config = PreTrainedConfig.from_pretrained(artifact)
    config.pretrained_path, config.device = artifact, "cpu"
    policy = make_policy(config, ds_meta=meta)
    before, after = make_pre_post_processors(config, str(artifact))
    plain = load_artifact(str(artifact)).make_policy()
    for depth, state in _observations(1, ticks=3):
        expected = plain.act(depth, state).action
        plain.advance(expected)
        action = after(policy.select_action(before(_batch(depth, state))))
        np.testing.assert_array_equal(action, expected)


def test_the_processors_of_an_artifact_are_those_that_lerobot_would_write(
    artifact: Path, tmp_path: Path
) -> None:
    config = PreTrainedConfig.from_pretrained(artifact)
    config.device = "cpu"
    for pipeline in make_egovcp_pre_post_processors(config):
        pipeline.save_pretrained(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(PROCESSORS)
    for name, content in PROCESSORS.items():
        assert json.loads((tmp_path / name).read_text()) == content
        assert json.loads((artifact / name).read_text()) == content


def test_reset_forgets_everything(artifact: Path) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    observations = _observations(2, ticks=3)
    first = _actions(policy, observations)
    assert not np.array_equal(_actions(policy, observations), first)
    policy.reset()
    np.testing.assert_array_equal(_actions(policy, observations), first)


def test_the_first_action_of_the_plan_is_the_one_selected(artifact: Path) -> None:
    planning, acting = (EgovcpPolicy.from_pretrained(artifact) for _ in range(2))
    for seen in _observations(2, ticks=2):
        plan = planning.predict_action_chunk(_batch(*seen))
        assert plan.shape == (2, acting.config.planner.horizon, spec.ACTION_DIM)
        assert torch.equal(acting.select_action(_batch(*seen)), plan[:, 0])


def test_another_planner_can_be_asked_for(artifact: Path) -> None:
    config = PreTrainedConfig.from_pretrained(
        artifact, cli_overrides=["--planner.samples=8", "--planner.horizon=2"]
    )
    policy = EgovcpPolicy.from_pretrained(artifact, config=config)
    (seen,) = _observations(1, ticks=1)
    assert policy.predict_action_chunk(_batch(*seen)).shape == (1, 2, spec.ACTION_DIM)


def test_it_is_ready_for_evaluation(artifact: Path) -> None:
    assert not EgovcpPolicy.from_pretrained(artifact).training


# --- refusals -----------------------------------------------------------------------------
@pytest.mark.parametrize("name", [CONFIG, WEIGHTS, MANIFEST, *PROCESSORS])
def test_what_was_tampered_with_is_refused(artifact: Path, tmp_path: Path, name: str) -> None:
    folder = Path(shutil.copytree(artifact, tmp_path / "copy"))
    content = bytearray((folder / name).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / name).write_bytes(content)
    config = PreTrainedConfig.from_pretrained(artifact)
    for given in (None, config):
        with pytest.raises(ArtifactError, match="copy"):
            EgovcpPolicy.from_pretrained(folder, config=given)


def test_a_folder_without_manifest_is_no_artifact(artifact: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(artifact, tmp_path / "copy"))
    (folder / MANIFEST).unlink()
    with pytest.raises(ArtifactError, match=MANIFEST):
        EgovcpPolicy.from_pretrained(folder)


def test_other_sizes_than_the_artifacts_are_refused(artifact: Path) -> None:
    config = PreTrainedConfig.from_pretrained(artifact, cli_overrides=["--world_model.hidden=48"])
    with pytest.raises(ArtifactError, match=r"--policy\.world_model"):
        EgovcpPolicy.from_pretrained(artifact, config=config)


def test_data_of_another_controller_is_refused(artifact: Path, tmp_path: Path) -> None:
    with DatasetWriter(tmp_path / "walking", Provenance("walker-7")) as writer:
        writer.add(random_episode(0))
    meta = LeRobotDatasetMetadata("me/walking", root=tmp_path / "walking")
    with pytest.raises(ArtifactError, match=r"stance.*walker-7"):
        EgovcpPolicy.from_pretrained(artifact, dataset_meta=meta)


def test_another_number_of_robots_needs_a_reset(artifact: Path) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    two, three = (_batch(*_observations(n, ticks=1)[0]) for n in (2, 3))
    policy.select_action(two)
    with pytest.raises(UsageError, match="2 robots and was shown 3"):
        policy.select_action(three)
    policy.reset()
    assert policy.select_action(three).shape == (3, spec.ACTION_DIM)


def test_metres_and_other_sizes_are_refused(artifact: Path) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact)
    (seen,) = _observations(1, ticks=1)
    batch = _batch(*seen)
    depth = batch[spec.DEPTH_KEY]
    with pytest.raises(DataError, match="millimetres"):
        policy.select_action(batch | {spec.DEPTH_KEY: depth / 1000})
    with pytest.raises(DataError, match="shape"):
        policy.select_action(batch | {spec.DEPTH_KEY: depth[..., :32]})


def test_holes_of_every_kind_read_as_holes(artifact: Path) -> None:
    (seen,) = _observations(1, ticks=1)
    batch = _batch(*seen)
    holes = batch[spec.DEPTH_KEY] == 0
    expected = EgovcpPolicy.from_pretrained(artifact).select_action(batch)
    for hole in (torch.nan, -1.0, -torch.inf, torch.inf):
        depth = batch[spec.DEPTH_KEY].masked_fill(holes, hole)
        policy = EgovcpPolicy.from_pretrained(artifact)
        assert torch.equal(policy.select_action(batch | {spec.DEPTH_KEY: depth}), expected)


def test_features_of_another_robot_are_refused(
    artifact: Path, config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    with pytest.raises(DataError, match=r"no feature 'observation\.images\.ego_depth'"):
        EgovcpPolicy(config)
    known = PreTrainedConfig.from_pretrained(artifact)
    known.input_features[spec.STATE_KEY].shape = (6,)
    with pytest.raises(DataError, match=r"'observation.state' has shape \(6,\), expected \(74,\)"):
        EgovcpPolicy(known)
