"""The measures of several tasks together."""

import json

import numpy as np
import pytest
import torch

from egovcp.data import DatasetReader, EpisodeStore, ReturnConfig
from egovcp.data.index import evenly_spaced
from egovcp.model import Batch
from egovcp.testing import random_batch, toy_model
from egovcp_train.evaluation import evaluate
from egovcp_train.heldout.episodes import Recorded, recorded
from egovcp_train.heldout.report import measure, scalars
from egovcp_train.heldout.table import table


def _group(task: str, seed: int) -> Recorded:
    batch = random_batch(3, 24, seed)
    fails = batch.terminal_next.clone()
    fails[0, -1] = task == "wall"
    return Recorded(task, batch._replace(terminal_next=fails))


def test_tasks_are_judged_apart_and_groups_of_a_task_together() -> None:
    ball, wall, more = _group("ball", 0), _group("wall", 1), _group("wall", 2)
    report = measure(toy_model(), [ball, wall, more])
    assert {task: found["episodes"] for task, found in report.tasks.items()} == {
        "ball": 3,
        "wall": 6,
    }
    assert report.tasks["ball"] == measure(toy_model(), [ball]).tasks["ball"]
    assert report.tasks["ball"]["termination"]["1"]["auc"] is None
    assert 0 <= report.tasks["wall"]["termination"]["1"]["auc"] <= 1
    assert report.tasks["wall"]["value"]["rows"] == 6 * 24


def test_the_metrics_over_all_tasks_are_those_of_the_plain_evaluation() -> None:
    groups = [_group("ball", 0), _group("wall", 1)]
    batches: list[Batch] = [group.batch for group in groups]
    assert measure(toy_model(), groups).metrics == evaluate(toy_model(), batches)


def test_measuring_leaves_no_gradient_and_repeats() -> None:
    model, groups = toy_model(), [_group("ball", 0)]
    weights = {k: v.clone() for k, v in model.state_dict().items()}
    first, second = measure(model, groups), measure(model, groups)
    assert first.tasks == second.tasks
    assert not first.values["ball"].value.requires_grad
    assert all(torch.equal(weights[k], v) for k, v in model.state_dict().items())


def test_the_share_of_active_dimensions_is_counted_on_rows_that_count() -> None:
    group = _group("ball", 0)
    found = measure(toy_model(), [group]).tasks["ball"]["latent"]
    assert found["share"] == found["active"] / found["dimensions"]
    valid = group.batch.valid.clone()
    valid[1:] = False
    spoilt = group.batch.depth.clone()
    spoilt[1:] = 300
    alone = group._replace(batch=group.batch._replace(valid=valid))
    other = alone._replace(batch=alone.batch._replace(depth=spoilt))
    reports = [measure(toy_model(), [g]).tasks["ball"]["latent"] for g in (alone, other)]
    assert reports[0]["kl_nats"] == pytest.approx(reports[1]["kl_nats"])


def test_the_report_is_json_and_its_scalars_leave_out_what_is_unknown() -> None:
    tasks = measure(toy_model(), [_group("ball", 0)]).tasks
    assert json.loads(json.dumps(tasks, allow_nan=False)) == tasks
    found = scalars(tasks)
    assert found["ball/depth_valid_h4"] == tasks["ball"]["depth"]["valid"]["4"]["model_mm"]
    assert found["ball/value_slope"] == tasks["ball"]["value"]["slope"]
    assert not any("termination" in name for name in found)


def test_the_table_has_a_line_for_everything_that_was_measured() -> None:
    text = table(measure(toy_model(), [_group("ball", 0), _group("wall", 1)]).tasks)
    for words in ("ball: 3 episodes, 72 rows", "joint_velocity", "termination AUC  -", "R2"):
        assert words in text


def test_episodes_are_spread_evenly() -> None:
    assert evenly_spaced(np.arange(5), None).tolist() == [0, 1, 2, 3, 4]
    assert evenly_spaced(np.arange(5), 9).tolist() == [0, 1, 2, 3, 4]
    assert evenly_spaced(10 * np.arange(9), 3).tolist() == [0, 40, 80]


def test_recorded_episodes_are_whole_and_padded(dataset_root) -> None:
    from egovcp.cli import DatasetConfig

    reader = DatasetReader.open(DatasetConfig(root=str(dataset_root)))
    store = EpisodeStore.load([reader], "all", ReturnConfig(steps=5))
    (group,) = recorded(store, torch.device("cpu"))
    assert group.task == "ball"
    assert sorted(group.batch.valid.sum(1).tolist()) == [15, *[24] * 7]
    assert group.batch.terminal_next.sum() == 1
    few = EpisodeStore.load([reader], "all", ReturnConfig(steps=5), per_task=3)
    assert few.identities == tuple(store.identities[i] for i in (0, 4, 7))
    (group,) = recorded(store, torch.device("cpu"), per_task=2)
    assert len(group.batch.valid) == 2
