"""Which existing collections --resume continues."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import draccus
import pytest

from egovcp.data import Provenance
from egovcp.data.provenance import ScenarioKeys
from egovcp.errors import UsageError
from egovcp_collect.config import EPISODE_OPTIONS, CollectConfig
from egovcp_collect.provenance import make_provenance, require_compatible


def provenance(task: str = "ball") -> Provenance:
    settings: dict[str, Any] = draccus.encode(CollectConfig(task=task))
    return Provenance("walk", seed=0, config={name: settings[name] for name in EPISODE_OPTIONS})


def test_a_missing_option_counts_as_its_default() -> None:
    now = provenance()
    older: dict[str, Any] = copy.deepcopy(dict(now.config))
    del older["env"]["ball"]["shape"], older["step_ticks"]
    require_compatible(now, replace(now, config=older))
    other = copy.deepcopy(dict(now.config))
    other["env"]["ball"]["shape"] = "box"
    with pytest.raises(UsageError, match=r"--env\.ball\.shape was sphere, is box"):
        require_compatible(replace(now, config=other), replace(now, config=older))


def test_what_is_collected_is_recorded_as_simulated() -> None:
    recorded = make_provenance(CollectConfig(task="ball"), "egovcp-collect")
    assert recorded.origin == "simulated"
    older = replace(recorded, origin="")
    facts = {"episode": 3}  # a scenario of an earlier version is the same one
    assert ScenarioKeys(recorded).key("ball", facts) == ScenarioKeys(older).key("ball", facts)


def test_versions_of_packages_are_compared_but_not_that_of_python() -> None:
    now = replace(provenance(), versions={"python": "3.12.9", "mujoco": "3.4"})
    require_compatible(now, replace(now, versions={"python": "3.12.3", "mujoco": "3.4"}))
    with pytest.raises(UsageError, match=r"version of mujoco was 3\.3, is 3\.4"):
        require_compatible(now, replace(now, versions={"python": "3.12.9", "mujoco": "3.3"}))


def test_controllers_are_compared_by_id() -> None:
    before, now = provenance(), copy.deepcopy(provenance())
    now.config["env"]["controller"] = "/elsewhere/walk.safetensors"
    require_compatible(now, before)
    with pytest.raises(UsageError, match="low-level controller was walk, is stance"):
        require_compatible(replace(now, controller_id="stance"), before)


def test_changed_options_are_listed() -> None:
    before, other = provenance("ball"), copy.deepcopy(dict(provenance("ball").config))
    other["env"]["wall"]["push_speed_range"] = [0.1, 0.2]
    other["env"]["ball"]["shape"] = "box"
    with pytest.raises(UsageError) as caught:
        require_compatible(replace(before, config=other), before)
    assert "--env.ball.shape was sphere, is box" in str(caught.value)
    assert "--env.wall.push_speed_range was" in str(caught.value)


def test_a_merged_or_converted_dataset_is_refused_without_listing_options() -> None:
    before = replace(provenance(), seed=None, config={"sources": []})
    with pytest.raises(UsageError, match="was merged or converted") as caught:
        require_compatible(provenance(), before)
    assert "--env" not in str(caught.value)
