"""Late plans are used where they still fit, and unusable ones never."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp_deploy.pilot.plans import PlanBook


def plan(first: float) -> np.ndarray:
    """Steps 0 .. 3 hold first + 0.1 step."""
    return np.repeat((first + 0.1 * np.arange(4))[:, None], 7, axis=1)


def test_a_plan_in_time_gives_its_first_action() -> None:
    book = PlanBook()
    assert book.offer(0, plan(0.0))
    assert book.decide(0)[0] == 0.0
    assert book.misses == 0


def test_without_a_new_plan_the_old_one_goes_on_to_its_end() -> None:
    book = PlanBook()
    book.offer(0, plan(0.0))
    taken = [book.decide(tick) for tick in range(6)]
    np.testing.assert_allclose([a[0] for a in taken[:4]], [0.0, 0.1, 0.2, 0.3])
    assert taken[4] is None
    assert taken[5] is None
    assert book.misses == 5


def test_a_late_plan_is_entered_at_its_second_action() -> None:
    book = PlanBook()
    book.decide(0)
    book.offer(0, plan(0.5))
    assert book.decide(1)[0] == pytest.approx(0.6)
    assert book.misses == 2


def test_an_older_plan_does_not_replace_a_newer() -> None:
    book = PlanBook()
    book.offer(3, plan(0.3))
    assert not book.offer(2, plan(0.9))
    assert book.decide(3)[0] == pytest.approx(0.3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_plan_with_a_bad_number_anywhere_is_refused(bad: float) -> None:
    book, broken = PlanBook(), plan(0.5)
    book.offer(0, plan(0.0))
    broken[3, 6] = bad
    assert not book.offer(1, broken)
    assert book.decide(1)[0] == pytest.approx(0.1)
    assert book.misses == 1
