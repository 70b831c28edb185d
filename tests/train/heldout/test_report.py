"""Measurements on held-out episodes, of models whose answers are known."""

import itertools
import json

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.data import DatasetReader, EpisodeStore, ReturnConfig
from egovcp.data.index import evenly_spaced
from egovcp.dataset_options import DatasetConfig
from egovcp.model import PRESETS, Batch, Carry, WorldModel
from egovcp.model.losses import filter_sequence
from egovcp.model.privileged_value import PrivilegedValue
from egovcp.testing import random_batch, toy_model
from egovcp_train.heldout import report
from egovcp_train.heldout.pictures import table
from egovcp_train.heldout.report import (
    EpisodeBatch,
    TerminationRows,
    auc,
    calibration,
    episode_batches,
    measure,
    ranking,
    scalars,
    termination_rows,
    termination_scores,
)


# --- metrics over all tasks ----------------------------------------------------------
class _Oracle(WorldModel):
    """Q is ``scale`` times the action's first coordinate plus ``offset``."""

    scale, offset = 1.0, 0.0

    def value(self, carry: Carry, action: Tensor) -> Tensor:
        return self.scale * action[..., 0] + self.offset


def _batches(count: int = 3) -> list[Batch]:
    """Returns that are the action's first coordinate."""
    batches = [random_batch(3, 16, seed) for seed in range(count)]
    return [batch._replace(mc_return=batch.action[..., 0].clone()) for batch in batches]


def _oracle(scale: float = 1.0, offset: float = 0.0) -> WorldModel:
    model = _Oracle(PRESETS["debug"])
    model.scale, model.offset = scale, offset
    return model


def evaluate(model: WorldModel, batches: list[Batch]) -> dict[str, float]:
    """Metrics over all tasks."""
    return measure(model, [EpisodeBatch("ball", batch) for batch in batches]).metrics


def test_a_perfect_value_explains_everything() -> None:
    metrics = evaluate(_oracle(), _batches())
    assert metrics["value/r2"] == pytest.approx(1.0)
    assert metrics["value/slope"] == pytest.approx(1.0)


def test_a_timid_value_has_a_steep_slope() -> None:
    metrics = evaluate(_oracle(scale=0.5), _batches())
    assert metrics["value/slope"] == pytest.approx(2.0)
    assert metrics["value/r2"] == pytest.approx(0.75, abs=0.01)


def test_a_constant_value_explains_nothing() -> None:
    metrics = evaluate(_oracle(scale=0.0), _batches())
    assert metrics["value/r2"] == pytest.approx(0.0, abs=0.02)


def test_rows_that_do_not_count_are_left_out() -> None:
    def spoil(batch: Batch, name: str) -> Batch:
        mask, returns = getattr(batch, name).clone(), batch.mc_return.clone()
        mask[:, 10:] = False
        returns[:, 10:] = 100.0
        return batch._replace(**{name: mask}, mc_return=returns)

    for name in ("valid", "mc_valid"):
        metrics = evaluate(_oracle(), [spoil(batch, name) for batch in _batches()])
        assert metrics["value/r2"] == pytest.approx(1.0), name


def test_evaluating_repeats_and_changes_neither_model_nor_random_stream() -> None:
    model, batches = toy_model(), _batches()
    weights = {k: v.clone() for k, v in model.state_dict().items()}
    stream = torch.random.get_rng_state()
    assert evaluate(model, batches) == evaluate(model, batches)
    assert torch.equal(stream, torch.random.get_rng_state())
    assert all(torch.equal(weights[k], v) for k, v in model.state_dict().items())


def test_windows_too_short_to_look_ahead_are_no_error() -> None:
    metrics = evaluate(toy_model(), [random_batch(2, 5)])
    assert {"value/r2", "latent/kl", "latent/active"} <= metrics.keys()
    assert 0 <= metrics["latent/active"] <= PRESETS["debug"].latent


# --- calibration, against numpy ------------------------------------------------------
def test_slope_bias_and_r2_are_those_of_a_polynomial_fit() -> None:
    rng = np.random.default_rng(0)
    target = rng.normal(2.0, 3.0, 500)
    value = 0.4 * target + rng.normal(0.3, 1.0, 500)
    found = calibration(torch.tensor(value), torch.tensor(target))
    slope, _ = np.polyfit(value, target, 1)
    assert found["slope"] == pytest.approx(slope)
    assert found["bias"] == pytest.approx(value.mean() - target.mean())
    assert found["r2"] == pytest.approx(1 - ((value - target) ** 2).mean() / target.var())
    assert found["correlation"] == pytest.approx(np.corrcoef(value, target)[0, 1])
    assert found["rows"] == 500


def test_the_ranking_ignores_what_does_not_depend_on_the_action() -> None:
    rng = torch.Generator().manual_seed(0)
    target, of_state = (torch.randn(200, n, generator=rng) for n in (8, 1))
    assert ranking(3.0 * target + 5.0 * of_state, target) == pytest.approx(1.0)
    assert ranking(-target, target + of_state) == pytest.approx(-1.0)
    assert abs(ranking(torch.randn(200, 8, generator=rng), target) or 1.0) < 0.1
    assert ranking(of_state.expand(-1, 8), target) is None


def test_in_training_q_is_compared_with_the_privileged_value() -> None:
    class FirstCoordinate(PrivilegedValue):
        def forward(self, state: Tensor, privileged: Tensor, action: Tensor) -> Tensor:
            return action[..., 0] + privileged[..., 0]

    model, (batch,) = _oracle(), _batches(1)
    model.return_mean.fill_(0.0)
    model.return_std.fill_(1.0)
    batch.mc_valid[:] = False
    critic = FirstCoordinate(batch.privileged.shape[-1])
    found = measure(model, [EpisodeBatch("ball", batch)], critic=critic)
    assert found.metrics["value/ranking"] == pytest.approx(1.0)
    assert found.metrics["value/r2"] < 0.9  # Q does not see the features
    assert found.tasks["ball"]["value"]["rows"] == batch.valid.sum()
    assert "ranking 1.000" in table(found.tasks)


def test_a_perfect_q() -> None:
    target = torch.randn(50)
    found = calibration(target.clone(), target)
    assert found["slope"] == pytest.approx(1.0)
    assert found["r2"] == pytest.approx(1.0)
    assert found["bias"] == pytest.approx(0.0)


def test_what_does_not_vary_has_no_slope_or_share() -> None:
    found = calibration(torch.ones(5), torch.randn(5))
    assert found["slope"] is None
    assert found["r2"] is not None
    found = calibration(torch.randn(5), torch.ones(5))
    assert found["r2"] is None
    assert calibration(torch.zeros(0), torch.zeros(0))["bias"] is None


# --- termination ---------------------------------------------------------------------
def _by_pairs(score: Tensor, positive: Tensor) -> float:
    pairs = list(itertools.product(score[positive].tolist(), score[~positive].tolist()))
    return sum(1.0 if p > n else 0.5 if p == n else 0.0 for p, n in pairs) / len(pairs)


@pytest.mark.parametrize("levels", [2, 5, 1000])
def test_the_auc_counts_pairs(levels: int) -> None:
    rng = torch.Generator().manual_seed(levels)
    score = torch.randint(levels, (200,), generator=rng).float()
    positive = torch.rand(200, generator=rng) < 0.2
    assert auc(score, positive) == pytest.approx(_by_pairs(score, positive), abs=1e-12)


def test_perfect_inverted_and_blind_scores() -> None:
    positive = torch.tensor([False, False, True, True])
    assert auc(torch.tensor([0.0, 1.0, 2.0, 3.0]), positive) == 1.0
    assert auc(torch.tensor([3.0, 2.0, 1.0, 0.0]), positive) == 0.0
    assert auc(torch.zeros(4), positive) == 0.5


@pytest.mark.parametrize("value", [True, False])
def test_without_both_outcomes_there_is_no_auc(value: bool) -> None:
    assert auc(torch.rand(5), torch.full((5,), value)) is None
    assert auc(torch.zeros(0), torch.zeros(0, dtype=torch.bool)) is None


class _Clock(WorldModel):
    """Counts the ticks in h; D's log-odds are that count."""

    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        return carry.h.masked_fill(is_first[:, None], -1.0) + 1.0

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        return Carry(carry.h + 1.0, carry.z)

    def termination_logit(self, carry: Carry) -> Tensor:
        return carry.h[..., 0]


def _found() -> TerminationRows:
    """Two episodes of 40 rows, one of which fails at row 29; the other meets its time limit."""
    batch = random_batch(2, 40)
    valid, fails = batch.valid.clone(), batch.terminal_next.clone()
    valid[0, 30:] = False
    fails[0, 29] = True
    batch = batch._replace(valid=valid, terminal_next=fails)
    model = _Clock(PRESETS["debug"])
    with torch.no_grad():
        return termination_rows(model, batch, filter_sequence(model, batch))


def test_a_row_is_judged_by_the_rows_that_follow_it() -> None:
    found = _found()
    scores = termination_scores([found])
    assert (scores["1"]["failing"], scores["1"]["rows"]) == (1, 70)
    assert (scores["5"]["failing"], scores["5"]["rows"]) == (5, 30 + 36)
    assert (scores["25"]["failing"], scores["25"]["rows"]) == (25, 30 + 16)
    # D grows with the ticks: rows 0 to 28 and 0 to 29 lie below the failing one, as does no other.
    assert scores["1"]["auc"] == pytest.approx((29 + 29 + 0.5) / 69)
    late = torch.cat([torch.arange(25.0), torch.arange(36.0)])
    pairs = (torch.arange(25.0, 30.0)[:, None] > late).double()
    pairs += 0.5 * (torch.arange(25.0, 30.0)[:, None] == late)
    assert scores["5"]["auc"] == pytest.approx(float(pairs.mean()))


def test_groups_are_judged_together() -> None:
    one = _found()
    assert termination_scores([one, one])["5"]["failing"] == 10
    assert termination_scores([one, one])["5"]["auc"] == pytest.approx(
        termination_scores([one])["5"]["auc"]
    )


# --- tasks and batches ---------------------------------------------------------------
def _group(task: str, seed: int) -> EpisodeBatch:
    batch = random_batch(3, 24, seed)
    fails = batch.terminal_next.clone()
    fails[0, -1] = task == "wall"
    return EpisodeBatch(task, batch._replace(terminal_next=fails))


def test_tasks_are_judged_apart_and_groups_of_a_task_together() -> None:
    ball, wall, more = _group("ball", 0), _group("wall", 1), _group("wall", 2)
    found = measure(toy_model(), [ball, wall, more])
    assert {task: row["episodes"] for task, row in found.tasks.items()} == {
        "ball": 3,
        "wall": 6,
    }
    assert found.tasks["ball"] == measure(toy_model(), [ball]).tasks["ball"]
    assert found.tasks["ball"]["termination"]["1"]["auc"] is None
    assert 0 <= found.tasks["wall"]["termination"]["1"]["auc"] <= 1
    assert found.tasks["wall"]["value"]["rows"] == 6 * 24


def test_metrics_over_all_tasks_do_not_depend_on_the_task() -> None:
    groups = [_group("ball", 0), _group("wall", 1)]
    assert measure(toy_model(), groups).metrics == evaluate(toy_model(), [g.batch for g in groups])


def test_open_loop_errors_leave_out_batches_that_are_not_chosen() -> None:
    chosen, other = _group("ball", 0), _group("ball", 1)._replace(open_loop=False)
    alone, both = (
        measure(toy_model(), groups).tasks["ball"] for groups in ([chosen], [chosen, other])
    )
    assert both["depth"] == alone["depth"]
    assert both["state"] == alone["state"]
    assert both["value"]["rows"] == 2 * alone["value"]["rows"]


def test_open_loop_batches_are_evenly_spread(dataset_root, monkeypatch) -> None:
    monkeypatch.setattr(report, "EPISODES_AT_ONCE", 2)
    monkeypatch.setattr(report, "OPEN_LOOP_EPISODES", 4)
    reader = DatasetReader.open(DatasetConfig(root=str(dataset_root)))
    store = EpisodeStore.load([reader], "all", ReturnConfig(steps=5))
    groups = list(episode_batches(store, torch.device("cpu")))
    assert [group.open_loop for group in groups] == [True, False, False, True]


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
    reader = DatasetReader.open(DatasetConfig(root=str(dataset_root)))
    store = EpisodeStore.load([reader], "all", ReturnConfig(steps=5))
    (group,) = episode_batches(store, torch.device("cpu"))
    assert group.task == "ball"
    assert sorted(group.batch.valid.sum(1).tolist()) == [15, *[24] * 7]
    assert group.batch.terminal_next.sum() == 1
    few = EpisodeStore.load([reader], "all", ReturnConfig(steps=5), per_task=3)
    assert few.identities == tuple(store.identities[i] for i in (0, 4, 7))
    (group,) = episode_batches(store, torch.device("cpu"), per_task=2)
    assert len(group.batch.valid) == 2


# --- the object --------------------------------------------------------------------------
def test_the_error_of_the_object_is_its_distance_over_known_rows() -> None:
    model, batch = toy_model(), random_batch(2, 5)
    batch.valid[1, 3:] = False
    with torch.no_grad():
        found = model.object_position(filter_sequence(model, batch).carry)
    batch.object[..., :3] = found + torch.tensor([0.3, 0.0, 0.4])
    batch.object[~batch.object_known] = 100.0
    result = measure(model, [EpisodeBatch("ball", batch), EpisodeBatch("wall", batch)])
    assert result.metrics["object_rmse_m"] == pytest.approx(0.5, rel=1e-4)
    assert scalars(result.tasks)["wall/object_rmse_m"] == pytest.approx(0.5, rel=1e-4)
    assert "object  position 0.500 m RMSE" in table(result.tasks)


@pytest.mark.parametrize("decodes", [True, False])
def test_without_a_known_object_or_a_decoder_there_is_no_error(decodes: bool) -> None:
    model, batch = toy_model(), random_batch(2, 5)
    if decodes:
        batch.privileged[..., spec.OBJECT_KNOWN] = 0.0
    else:
        model = model.without_object_head()
    result = measure(model, [EpisodeBatch("ball", batch)])
    assert result.tasks["ball"]["object_rmse_m"] is None
    assert "object_rmse_m" not in result.metrics
    assert "object" not in table(result.tasks)
