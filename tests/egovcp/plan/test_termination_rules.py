"""J after a failure, under each rule."""

import pytest
import torch

from egovcp.plan import PlannerConfig
from egovcp.plan.config import TerminationRule
from egovcp.plan.objective import evaluate
from tests.support.worlds import ScriptedWorld

VALUES = [8.0, 4.0, -2.0, 6.0]
FLOOR = -10.0


def _objective(rule: TerminationRule, deaths: list[float], values: list[float] = VALUES) -> float:
    world = ScriptedWorld(values, deaths, floor=FLOOR)
    actions = torch.zeros(1, 1, len(values), 7)
    config = PlannerConfig(termination_rule=rule)
    return evaluate(world, world.start(), actions, config).item()


@pytest.mark.parametrize("rule", ["paper", "shift", "survival"])
def test_without_a_failure_the_objective_is_the_mean_value(rule: TerminationRule) -> None:
    assert _objective(rule, [0.0] * 4) == pytest.approx(sum(VALUES) / 4)


@pytest.mark.parametrize(
    ("rule", "deaths", "expected"),
    [
        # The failed state's own value counts, later ones are lost.
        ("paper", [0, 0.95, 0, 0], (8 + 4 + 0 + 0) / 4),
        ("paper", [0, 0, 0.95, 0], (8 + 4 - 2 + 0) / 4),
        ("shift", [0, 0.95, 0, 0], (8 + 4 - 10 - 10) / 4),
        ("shift", [0, 0, 0.95, 0], (8 + 4 - 2 - 10) / 4),
        # Each value above the floor, weighted with the probability of being alive.
        ("survival", [0, 0.5, 0, 0], (8 + 4 + (0.5 * 8 - 10) + (0.5 * 16 - 10)) / 4),
        ("survival", [0, 0.5, 0.5, 0], (8 + 4 + (0.5 * 8 - 10) + (0.25 * 16 - 10)) / 4),
        ("survival", [0, 1.0, 0, 0], (8 + 4 - 10 - 10) / 4),
        # At the threshold is not beyond it.
        ("paper", [0, 0.9, 0, 0], sum(VALUES) / 4),
        ("shift", [0, 0.9, 0, 0], sum(VALUES) / 4),
        # The observed state is alive, whatever D says; after the last step nothing follows.
        ("paper", [1.0, 0, 0, 0], sum(VALUES) / 4),
        ("survival", [1.0, 0, 0, 1.0], sum(VALUES) / 4),
        # Dead stays dead.
        ("paper", [0, 0.95, 0.0, 0.0], (8 + 4) / 4),
    ],
)
def test_the_objective_after_a_failure(
    rule: TerminationRule, deaths: list[float], expected: float
) -> None:
    assert _objective(rule, deaths) == pytest.approx(expected)


def test_only_the_papers_rule_rewards_falling_when_values_are_negative() -> None:
    values, alive, dead = [-1.0, -1.0, -5.0, -5.0], [0.0] * 4, [0.0, 1.0, 0.0, 0.0]
    assert _objective("paper", dead, values) > _objective("paper", alive, values)
    assert _objective("shift", dead, values) < _objective("shift", alive, values)
    assert _objective("survival", dead, values) < _objective("survival", alive, values)
