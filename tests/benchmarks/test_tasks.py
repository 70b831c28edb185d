"""How hard the tasks are: what is printed about the reference policies."""

from dataclasses import replace

import pytest
import tasks
from tasks import Result

from egovcp.sim.config import evaluation_config
from egovcp_deploy.scores import EpisodeScore


def _score(reward: float, success: bool, fell: bool = False) -> EpisodeScore:
    return EpisodeScore(0, 10, reward, success, fell)


def _found(**rewards: float) -> dict[str, Result]:
    return {name: tasks.result([_score(10 * r, True)] * 4) for name, r in rewards.items()}


def test_a_result_counts_successes_falls_and_reward_per_step():
    found = tasks.result([_score(1.0, True), _score(3.0, False, True)])
    assert (found.success, found.falls) == (0.5, 0.5)
    assert found.reward == pytest.approx(0.2)
    assert found.reward_ci95 == pytest.approx((0.1, 0.3))


def test_normalized_reward_is_0_for_random_and_1_for_the_oracle():
    found = _found(hold=0.02, random=-0.01, oracle=0.05)
    assert tasks.normalized_reward("hold", found) == pytest.approx(0.5)
    assert tasks.normalized_reward("random", found) == 0.0
    assert tasks.normalized_reward("oracle", found) == 1.0


def test_no_normalized_reward_without_an_oracle_that_earns_more():
    assert tasks.normalized_reward("hold", _found(hold=0.02, oracle=0.05)) is None
    assert tasks.normalized_reward("hold", _found(hold=0.02, random=0.05, oracle=0.05)) is None


def test_rows_are_narrow_and_name_the_best_constant_action():
    found = _found(hold=0.02, random=-0.01, oracle=0.05)
    action = (0.45, -0.3, 0.85, 0.45, 0.3, 0.85, 0.0)
    found["constant"] = replace(found["hold"], action=action)
    lines = tasks.rows("wall 0.85 m/s", found)
    assert len(lines) == 4
    assert max(map(len, lines)) <= 120
    assert lines[-1].endswith("50%  0.45 -0.3 0.85 0.45 0.3 0.85 0")
    metrics = tasks.metrics("wall 0.85 m/s", found)
    assert metrics["wall_0.85_m_per_s_constant_normalized_reward"] == pytest.approx(0.5)


def test_all_controllers_play_a_task(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tasks, "search_constant", lambda t, s, play: _Best(play))
    env = replace(evaluation_config(), controller="stance")
    found = tasks.measure(env, "ball", ("hold", "constant"), 1, 0, 1)
    assert found["hold"].reward == found["constant"].reward  # both hold the neutral pose
    assert found["constant"].action == (0.0,) * 7


class _Best:
    """The winner of a search that plays one scenario."""

    def __init__(self, play) -> None:
        self.action = (0.0,) * 7
        ((score,),) = play([self.action], [tasks.held_out("ball", 0, 0)])
        assert score.steps > 0
