"""The search for the best constant action."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from egovcp.errors import DataError, UsageError
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks import task_names
from egovcp.spec import ACTION_DIM
from egovcp_deploy.controllers import Action, candidate_actions, load_constants, search_constant
from egovcp_deploy.options import held_out
from egovcp_deploy.scores import EpisodeScore


class Landscape:
    """Reward falls with the distance from ``best``; noise depends on the scenario alone."""

    def __init__(self, best: Action, noise: float) -> None:
        self.best, self.noise = np.array(best), noise
        self.played: list[tuple[Action, Scenario]] = []

    def __call__(
        self, actions: Sequence[Action], scenarios: Sequence[Scenario]
    ) -> list[list[EpisodeScore]]:
        self.played += itertools.product(actions, scenarios)
        return [[self._score(action, scenario) for scenario in scenarios] for action in actions]

    def _score(self, action: Action, scenario: Scenario) -> EpisodeScore:
        luck = np.random.default_rng(scenario.episode).normal(0, self.noise)
        reward = float(luck - np.sum((np.array(action) - self.best) ** 2))
        return EpisodeScore(scenario.episode, 10, reward, reward > -1, False, [0.1])


@pytest.mark.parametrize("task", task_names())
@pytest.mark.parametrize("which", [0, 1, -1])
def test_the_best_action_wins_under_noise_shared_by_all(task: str, which: int) -> None:
    best = candidate_actions(task)[which]
    land = Landscape(best, noise=5.0)
    found = search_constant(task, 0, land)
    assert found.action == best
    assert found.episodes == sum(action == best for action, _ in land.played)


def test_a_grid_of_the_neutral_pose_alone_is_played(monkeypatch: pytest.MonkeyPatch) -> None:
    neutral = (0.0,) * ACTION_DIM
    monkeypatch.setattr("egovcp_deploy.controllers.candidate_actions", lambda task: [neutral])
    found = search_constant("ball", 0, Landscape(neutral, noise=0.0))
    assert (found.action, found.episodes) == (neutral, 6)


def test_candidates_play_the_same_scenarios_and_none_of_the_evaluation() -> None:
    land = Landscape(candidate_actions("ball")[3], noise=1.0)
    search_constant("ball", 4, land)
    by_action: dict[Action, list[Scenario]] = {}
    for action, scenario in land.played:
        by_action.setdefault(action, []).append(scenario)
    first = min(map(len, by_action.values()))
    assert len({tuple(played[:first]) for played in by_action.values()}) == 1
    assert all(len(set(played)) == len(played) for played in by_action.values())
    evaluated = {held_out("ball", 4, i) for i in range(1000)}
    assert not evaluated & {scenario for _, scenario in land.played}


@pytest.mark.parametrize("task", task_names())
def test_the_grid_is_symmetric_inside_the_box_and_holds_the_neutral_pose(task: str) -> None:
    actions = np.array(candidate_actions(task))
    assert np.abs(actions).max() <= 1.0
    np.testing.assert_array_equal(actions[:, [0, 2]], actions[:, [3, 5]])
    np.testing.assert_array_equal(actions[:, 1], -actions[:, 4])
    assert len(np.unique(actions, axis=0)) == len(actions)
    assert (actions == 0).all(axis=1).sum() == 1


ENTRY = {"action": [0.1] * ACTION_DIM, "reward_mean": 0.2, "success_rate": 0.3, "episodes": 4}


def test_constant_json_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "constant.json"
    path.write_text(json.dumps({"constants": {"ball": ENTRY}}))
    assert load_constants(path, {})["ball"].action == (0.1,) * ACTION_DIM


def test_an_option_that_was_null_is_compared_and_a_later_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "constant.json"
    path.write_text(json.dumps({"constants": {}, "env": {"limit": None}}))
    assert load_constants(path, {"env": {"limit": None, "later": 3}}) == {}
    with pytest.raises(UsageError, match=r"found with env\.limit=null, expected 3"):
        load_constants(path, {"env": {"limit": 3}})


@pytest.mark.parametrize(
    "content",
    [
        None,
        "not json",
        "[1]",
        '{"ball": {}}',
        '{"constants": {"ball": 3}}',
        '{"constants": {"ball": {"action": [1, 2]}}}',
        '{"constants": {"ball": {"a": 0}}}',
        f'{{"constants": {{"ball": {{"action": [{"9" * 400}]}}}}}}',
        json.dumps({"constants": {"ball": ENTRY | {"episodes": "four"}}}),
    ],
)
def test_a_file_of_another_format_is_refused(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "constant.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(DataError, match=r"constant\.json"):
        load_constants(path, {})
