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
