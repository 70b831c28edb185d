"""LeRobot's windows become the batches that egovcp-train learns from."""

import dataclasses
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_policy
from torch import Tensor

from egovcp.artifact import load_artifact, returns_of
from egovcp.data import DatasetReader, DatasetWriter, EpisodeStore, Provenance, ReturnConfig
from egovcp.data.samplers import gather
from egovcp.data.store import mirror_windows
from egovcp.errors import ArtifactError, DataError, UsageError
from egovcp.model import Batch
from egovcp.robot.stance import StanceController
from egovcp.testing import random_episode
from egovcp_train.datasets import set_normalisation
from lerobot_policy_egovcp import (
    EgovcpConfig,
    EgovcpPolicy,
    make_egovcp_pre_post_processors,
    modeling_egovcp,
)
from lerobot_policy_egovcp.batches import RowTargets, mirrored, open_reader, to_batch

ROWS = [0, 1, 5, 11, 12, 26, 32, 33, 92]  # first, middle and last rows; 24 to 32 end in a fall


def _reader(meta: LeRobotDatasetMetadata) -> DatasetReader:
    return open_reader(Path(meta.root), meta.repo_id)


def _store(meta: LeRobotDatasetMetadata, returns: ReturnConfig) -> EpisodeStore:
    return EpisodeStore.load([_reader(meta)], "all", returns)


def _windows(
    config: EgovcpConfig, meta: LeRobotDatasetMetadata, rows: list[int]
) -> dict[str, Tensor]:
    """What lerobot-train hands to the policy."""
    dataset = LeRobotDataset(
        meta.repo_id,
        root=meta.root,
        delta_timestamps=resolve_delta_timestamps(config, meta),
        return_uint8=True,
    )
    batch = torch.utils.data.default_collate([dataset[row] for row in rows])
    before, _ = make_egovcp_pre_post_processors(config, meta.stats)
    prepared: dict[str, Tensor] = before(batch)
    return prepared


@pytest.fixture
def policy(config: EgovcpConfig, meta: LeRobotDatasetMetadata) -> EgovcpPolicy:
    return make_policy(config, ds_meta=meta)


def test_a_window_of_lerobot_is_a_window_of_the_stream(
    policy: EgovcpPolicy, config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    store = _store(meta, config.returns)
    ends = store.start + store.length
    episode = np.searchsorted(ends, ROWS, side="right")
    expected = gather(store, np.array(ROWS), episode, config.sequence_length)
    found = to_batch(_windows(config, meta, ROWS), RowTargets.of(_reader(meta), config.returns))
    valid = expected["valid"]
    for name in Batch._fields:
        value = getattr(found, name).numpy()
        np.testing.assert_array_equal(value[valid], expected[name][valid], err_msg=name)
        assert value.shape == expected[name].shape
    for flag in ("valid", "is_first", "mc_valid", "terminal_next"):
        np.testing.assert_array_equal(getattr(found, flag), expected[flag], err_msg=flag)
    assert found.terminal_next.any()
    assert 0 < found.is_first.sum() < len(ROWS)


def test_a_mirrored_window_of_lerobot_is_a_mirrored_window_of_the_stream(
    policy: EgovcpPolicy, config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    store = _store(meta, config.returns)
    episode = np.searchsorted(store.start + store.length, ROWS, side="right")
    expected = gather(store, np.array(ROWS), episode, config.sequence_length)
    which = np.arange(len(ROWS)) % 2 == 0
    mirror_windows(expected, np.flatnonzero(which))
    plain = to_batch(_windows(config, meta, ROWS), RowTargets.of(_reader(meta), config.returns))
    found = mirrored(plain, torch.from_numpy(which))
    valid = expected["valid"]
    for name in Batch._fields:
        value = getattr(found, name).numpy()
        np.testing.assert_array_equal(value[valid], expected[name][valid], err_msg=name)


@pytest.mark.parametrize("mirror", [True, False])
def test_only_a_model_of_mirrored_windows_plans_in_a_mirror(mirror: bool) -> None:
    assert EgovcpConfig(mirror=mirror).planner.mirror == mirror


def test_mirrored_windows_are_for_learning_alone(
    policy: EgovcpPolicy,
    config: EgovcpConfig,
    meta: LeRobotDatasetMetadata,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    def count(rows: Batch, which: Tensor) -> Batch:
        asked.append(len(which))
        return rows

    monkeypatch.setattr(modeling_egovcp, "mirrored", count)
    batch = _windows(config, meta, ROWS)
    policy.eval().forward(batch)
    assert asked == []
    policy.train().forward(batch)
    assert asked == [len(ROWS)]
    config.mirror = False
    policy.forward(batch)
    assert asked == [len(ROWS)]


def test_a_new_policy_has_the_statistics_of_the_dataset(
    policy: EgovcpPolicy, config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    trained = EgovcpPolicy(config).world_model
    set_normalisation(trained, _store(meta, config.returns))
    for name, expected in trained.named_buffers():
        found = policy.world_model.get_buffer(name)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4, msg=name)
        assert expected.ne(0).any()


def test_the_loss_falls_and_every_part_is_reported(
    policy: EgovcpPolicy, config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    batch = _windows(config, meta, ROWS)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    losses = []
    for _ in range(40):
        loss, parts = policy.forward(batch)
        assert loss.item() == pytest.approx(sum(parts.values()), rel=1e-4)
        assert {"depth", "state", "value", "termination", "kl_prior"} <= parts.keys()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    # Which half of the images is reconstructed is drawn at each step: a few losses say little.
    assert np.mean(losses[-10:]) < 0.9 * np.mean(losses[:10])


def test_what_is_saved_is_an_artifact(
    policy: EgovcpPolicy, meta: LeRobotDatasetMetadata, tmp_path: Path
) -> None:
    (tmp_path / "notes.md").write_text("mine")
    policy.save_pretrained(tmp_path)
    loaded = load_artifact(str(tmp_path))
    assert loaded.controller_id == StanceController().id
    assert loaded.manifest["datasets"] == [{"repo_id": "me/ball", "revision": ""}]
    assert returns_of(loaded) == policy.config.returns
    assert loaded.planner == policy.config.planner
    for name, value in policy.world_model.state_dict().items():
        assert torch.equal(loaded.world_model.state_dict()[name], value), name
    assert (tmp_path / "notes.md").read_text() == "mine"


def test_saving_what_was_loaded_keeps_where_it_comes_from(artifact: Path, tmp_path: Path) -> None:
    EgovcpPolicy.from_pretrained(artifact).save_pretrained(tmp_path)
    old, new = load_artifact(str(artifact)), load_artifact(str(tmp_path))
    for key in ("controller_id", "datasets", "heldout", "train_config", "step"):
        assert new.manifest[key] == old.manifest[key]
    assert new.world_model.config == old.world_model.config


def test_an_artifact_of_egovcp_train_can_be_trained_further(
    artifact: Path, meta: LeRobotDatasetMetadata
) -> None:
    policy = EgovcpPolicy.from_pretrained(artifact, dataset_meta=meta)
    policy.config.sequence_length, policy.config.returns = 6, ReturnConfig(steps=4)
    statistics = {k: v.clone() for k, v in policy.world_model.named_buffers()}
    loss, _ = policy.train().forward(_windows(policy.config, meta, ROWS))
    loss.backward()
    assert policy.world_model.gru.project.parts[0].weight.grad.abs().max() > 0
    for name, value in policy.world_model.named_buffers():
        assert torch.equal(value, statistics[name]), name


@pytest.mark.parametrize(
    ("returns", "found"),
    [
        (ReturnConfig(steps=4, gamma=0.9), r"gamma=0\.9, .* give --policy\.returns\.gamma=0\.97"),
        (ReturnConfig(steps=4, scale="none"), r"scale=none, .* --policy\.returns\.scale=dataset"),
    ],
)
def test_weights_of_another_return_are_refused_for_training(
    returns: ReturnConfig, found: str, artifact: Path, meta: LeRobotDatasetMetadata
) -> None:
    config = PreTrainedConfig.from_pretrained(artifact)
    config.returns, config.pretrained_path = returns, artifact
    with pytest.raises(UsageError, match=rf"--policy\.returns\.{found}"):
        make_policy(config, ds_meta=meta)


def test_object_losses_without_object_head_are_refused_for_training(
    artifact: Path, meta: LeRobotDatasetMetadata
) -> None:
    flags = ["--world_model.loss.multistep_object=1"]
    config = PreTrainedConfig.from_pretrained(artifact, cli_overrides=flags)
    with pytest.raises(UsageError, match=r"no object head .*\.loss\.multistep_object=0"):
        EgovcpPolicy.from_pretrained(artifact, config=config, dataset_meta=meta)
    evaluated = EgovcpPolicy.from_pretrained(artifact, config=config)
    assert not evaluated.config.world_model.predicts_object
    assert config.world_model.loss.multistep_object == 1


def test_rows_of_files_that_were_not_downloaded_are_not_valid(tmp_path: Path) -> None:
    """Of --dataset.episodes, LeRobot downloads only the files."""
    root, config = tmp_path / "dataset", ReturnConfig(steps=4)
    with DatasetWriter(root, Provenance(StanceController().id, seed=0), 2) as writer:
        for number in range(4):
            writer.add(random_episode(number))
    reader = open_reader(root, "me/ball")
    complete = RowTargets.of(reader, config)
    reader.data_path(0).unlink()
    found = RowTargets.of(open_reader(root, "me/ball"), config)
    for name, values in vars(found).items():
        assert values.shape == getattr(complete, name).shape
        assert values.dtype == getattr(complete, name).dtype
        assert not values[:24].any()
        assert torch.equal(values[24:], getattr(complete, name)[24:])


# --- refusals -----------------------------------------------------------------------------
def test_a_dataset_that_is_not_ours_is_refused(
    config: EgovcpConfig, dataset_root: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(dataset_root, tmp_path / "foreign"))
    (root / "meta" / "collection.json").unlink()
    with pytest.raises(DataError, match=r"collection\.json"):
        make_policy(config, ds_meta=LeRobotDatasetMetadata("me/foreign", root=root))


def test_episodes_shorter_than_the_return_are_refused(
    config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    config.returns = ReturnConfig(steps=50)
    with pytest.raises(DataError, match=r"--policy\.returns\.steps"):
        make_policy(config, ds_meta=meta)


def test_a_policy_without_dataset_can_neither_train_nor_be_saved(
    artifact: Path, tmp_path: Path, config: EgovcpConfig, meta: LeRobotDatasetMetadata
) -> None:
    make_policy(config, ds_meta=meta)  # fills in the features
    lonely = EgovcpPolicy(config)
    with pytest.raises(UsageError, match="dataset_meta"):
        lonely.forward(_windows(config, meta, [0]))
    with pytest.raises(ArtifactError, match="controller_id"):
        lonely.save_pretrained(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        *({"sequence_length": 1}, {"drop_n_last_frames": -1}, {"returns": ReturnConfig(steps=0)}),
        *({"optimizer_lr": math.nan}, {"scheduler_decay_steps": -1}, {"planner_seed": 2**70}),
        {"sequence_length": 10**9},
    ],
)
def test_senseless_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="--policy"):
        EgovcpConfig(device="cpu", **options)


def test_normalising_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="normalises by itself"):
        EgovcpConfig(device="cpu", normalization_mapping={"STATE": "MEAN_STD"})


# --- the variants of the paper's table I ---------------------------------------------------
def _variant(config: EgovcpConfig, **loss: object) -> EgovcpConfig:
    """An autoregressive model with rewards, and a planner that adds them up."""
    losses = dataclasses.replace(config.world_model.loss, reward=1.0, **loss)  # type: ignore[arg-type]
    world = dataclasses.replace(config.world_model, dynamics="autoregressive", loss=losses)
    planner = dataclasses.replace(config.planner, objective="td", horizon=2)
    return dataclasses.replace(config, world_model=world, planner=planner)


def test_a_variant_is_trained_saved_and_acts(
    config: EgovcpConfig, meta: LeRobotDatasetMetadata, tmp_path: Path
) -> None:
    chosen = _variant(config, q_target="td", td_decay=0.0, autoregressive_steps=3)
    policy: EgovcpPolicy = make_policy(chosen, ds_meta=meta)
    loss, terms = policy.forward(_windows(chosen, meta, ROWS))
    loss.backward()  # type: ignore[no-untyped-call]
    assert {"autoregressive_depth", "value", "reward"} <= terms.keys()
    assert not {"kl_prior", "kl_posterior"} & terms.keys()
    policy.save_pretrained(tmp_path / "policy")
    loaded = EgovcpPolicy.from_pretrained(tmp_path / "policy")
    batch = {
        "observation.images.ego_depth": torch.full((2, 1, 48, 64), 2000.0),
        "observation.state": torch.zeros(2, 74),
    }
    assert loaded.predict_action_chunk(batch).shape == (2, 3, 7)


def test_a_slow_copy_of_q_is_not_for_lerobot(config: EgovcpConfig) -> None:
    with pytest.raises(UsageError, match=r"td_decay=0"):
        _variant(config, q_target="td", autoregressive_steps=3)


def test_windows_that_are_too_short_to_feed_back_are_refused(config: EgovcpConfig) -> None:
    with pytest.raises(UsageError, match=r"--policy\.sequence_length=6"):
        _variant(config, autoregressive_steps=6)
