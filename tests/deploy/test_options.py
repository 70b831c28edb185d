"""Output folders, options of the planner, seeds, and scenes of a played episode."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.cli import parse_config
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.plan import PlannerConfig
from egovcp.policy_options import PlannerOptions
from egovcp.sim.config import evaluation_config
from egovcp.sim.scenario import HELD_OUT, SEARCH, require_training_seed
from egovcp.sim.tasks import task_names
from egovcp_deploy.evaluate import EvalConfig
from egovcp_deploy.options import SEEDS, check_output_dir, held_out, make_output_dir


def test_an_empty_folder_is_accepted_and_a_new_one_created(tmp_path: Path) -> None:
    assert make_output_dir(str(tmp_path)) == tmp_path
    assert make_output_dir(str(tmp_path / "a" / "b")).is_dir()


def test_checking_creates_nothing(tmp_path: Path) -> None:
    check_output_dir(str(tmp_path / "a"))
    assert not (tmp_path / "a").exists()


def test_a_folder_with_results_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "eval.json").write_text("{}")
    with pytest.raises(UsageError, match=r"eval\.json"):
        make_output_dir(str(tmp_path))


def test_missing_flag_and_file_in_the_way_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        make_output_dir(str(tmp_path / "file"))
    with pytest.raises(EnvironmentFailure, match="cannot write to"):
        make_output_dir(str(tmp_path / "file" / "below"))
    with pytest.raises(UsageError, match="missing"):
        make_output_dir("")


def test_planner_options_change_only_what_they_name() -> None:
    own = PlannerConfig(samples=512, horizon=6)
    assert PlannerOptions().apply(own) == own
    changed = PlannerOptions(samples=128).apply(own)
    assert (changed.samples, changed.horizon) == (128, 6)
    other = PlannerOptions(optimiser="icem", backend="float32").apply(own)
    assert (other.optimiser, other.backend, other.samples) == ("icem", "float32", 512)
    assert PlannerOptions(min_std=0.05).apply(own) == replace(own, min_std=0.05)
    assert PlannerOptions(action_parameterization="target").apply(own) == replace(
        own, action_parameterization="target"
    )
    with pytest.raises(UsageError, match=r"planner\.elites=4 exceeds planner\.samples=2"):
        PlannerOptions(samples=2).apply(own)
    with pytest.raises(UsageError, match="min_std=-1: expected at least 0"):
        PlannerOptions(min_std=-1).apply(own)
    with pytest.raises(UsageError, match=r"--planner\.min_std=11.*: expected .* at most 10"):
        parse_config(EvalConfig, ["--planner.min_std=11"], "egovcp-eval")


def test_scenario_seeds_of_collection_evaluation_and_search_are_disjoint() -> None:
    seeds = {held_out("ball", seed, 0).seed for seed in (0, 1, SEEDS - 1)}
    assert all(HELD_OUT <= seed < SEARCH for seed in seeds)
    require_training_seed(HELD_OUT - 1)
    with pytest.raises(UsageError, match="for evaluation"):
        require_training_seed(HELD_OUT)
    for bad in (-1, 10**9):
        with pytest.raises(UsageError, match="--seed"):
            parse_config(EvalConfig, [f"--seed={bad}"], "egovcp-eval")


def test_played_episodes_all_have_an_event() -> None:
    assert {
        evaluation_config().episode(t).empty_probability for t in task_names(training=True)
    } == {0.0}
    given = parse_config(EvalConfig, ["--env.controller=stance"], "egovcp-eval").env
    assert given == replace(evaluation_config(), controller="stance")
