"""What a collection may go on from."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import draccus
import pytest

from egovcp.data import Provenance
from egovcp.errors import UsageError
from egovcp_collect.config import SHAPING, CollectConfig
from egovcp_collect.resume import require_same


def made(task: str = "ball") -> Provenance:
    settings: dict[str, Any] = draccus.encode(CollectConfig(task=task))
    return Provenance("walk", seed=0, config={name: settings[name] for name in SHAPING})


def test_an_option_newer_than_the_dataset_was_made_with_its_default() -> None:
    now = made()
    older: dict[str, Any] = copy.deepcopy(dict(now.config))
    del older["env"]["ball"]["shape"], older["step_ticks"]
    require_same(now, replace(now, config=older))
    other = copy.deepcopy(dict(now.config))
    other["env"]["ball"]["shape"] = "box"
    with pytest.raises(UsageError, match=r"--env\.ball\.shape was sphere, is box"):
        require_same(replace(now, config=other), replace(now, config=older))


def test_a_controller_may_lie_elsewhere_if_it_is_the_same() -> None:
    before, now = made(), copy.deepcopy(made())
    now.config["env"]["controller"] = "/elsewhere/walk.safetensors"
    require_same(now, before)
    with pytest.raises(UsageError, match="low-level controller was walk, is stance"):
        require_same(replace(now, controller_id="stance"), before)


@pytest.mark.parametrize("task", ["wall", "all"])
def test_no_wall_of_before_gets_rows_in_which_a_guard_has_a_price(task: str) -> None:
    now = made(task)
    older: dict[str, Any] = copy.deepcopy(dict(now.config))
    del older["env"]["wall"]["guard_cost"]
    with pytest.raises(UsageError, match=r"--env\.wall\.guard_cost was 0\.0, is 0\.27"):
        require_same(now, replace(now, config=older))
    free = copy.deepcopy(dict(now.config))
    free["env"]["wall"]["guard_cost"] = 0.0
    require_same(replace(now, config=free), replace(now, config=older))


def test_a_ball_of_before_goes_on_though_walls_have_changed() -> None:
    now = made("ball")
    older: dict[str, Any] = copy.deepcopy(dict(now.config))
    del older["env"]["wall"]["guard_cost"]
    require_same(now, replace(now, config=older))


def test_only_options_of_the_collected_task_are_listed() -> None:
    before, other = made("ball"), copy.deepcopy(dict(made("ball").config))
    other["env"]["wall"]["push_speed_range"] = [0.1, 0.2]
    other["env"]["ball"]["shape"] = "box"
    with pytest.raises(UsageError) as caught:
        require_same(replace(before, config=other), before)
    assert "--env.ball.shape was sphere, is box" in str(caught.value)
    assert "wall" not in str(caught.value)


def test_options_of_another_task_are_listed_if_nothing_else_differs() -> None:
    before, other = made("ball"), copy.deepcopy(dict(made("ball").config))
    other["env"]["wall"]["push_speed_range"] = [0.1, 0.2]
    with pytest.raises(UsageError, match=r"--env\.wall\.push_speed_range was"):
        require_same(replace(before, config=other), before)


def test_a_merged_or_converted_dataset_is_refused_without_listing_options() -> None:
    before = replace(made(), seed=None, config={"sources": []})
    with pytest.raises(UsageError, match="was merged or converted") as caught:
        require_same(made(), before)
    assert "--env" not in str(caught.value)
