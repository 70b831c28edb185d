"""Policies that ship with the package are found by name; here a copy of a toy policy."""

import shutil
from pathlib import Path

import pytest

from egovcp import artifact as module
from egovcp.artifact import load_artifact, policy_folder, shipped_policies
from egovcp.errors import ArtifactError, UsageError
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from tests.support.hub import FakeHub

from .conftest import PLANNER


@pytest.fixture
def shipped(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the only shipped policy, `toy`; the working directory is empty."""
    folder = Path(shutil.copytree(original, tmp_path / "pretrained" / "toy"))
    (tmp_path / "pretrained" / "unfinished").mkdir()
    monkeypatch.setattr(module, "PRETRAINED", tmp_path / "pretrained")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return folder


def test_a_shipped_policy_is_loaded_by_name_without_network(hub: FakeHub, shipped: Path) -> None:
    assert shipped_policies() == ["toy"]
    assert load_artifact("toy").path == policy_folder("toy") == shipped
    assert load_policy("toy").planner == PLANNER
    changed = load_policy("toy", PlannerOptions(samples=16))
    assert (changed.planner.samples, changed.planner.horizon) == (16, PLANNER.horizon)
    assert load_policy(PolicyOptions("toy"), PlannerOptions()).planner == PLANNER
    assert not hub.requests


def test_a_folder_of_that_name_is_meant_only_with_a_slash(original: Path, shipped: Path) -> None:
    shutil.copytree(original, "toy")
    assert load_artifact("toy").path == shipped
    for path in ("./toy", "toy/", str(Path("toy").resolve())):
        assert load_artifact(path).path.resolve() == Path("toy").resolve()


def test_a_shipped_policy_has_no_revision(shipped: Path) -> None:
    with pytest.raises(UsageError, match="toy is a policy that ships with egovcp, and revision v1"):
        load_artifact("toy", "v1")


def test_an_unknown_name_is_answered_with_the_known_ones(shipped: Path) -> None:
    with pytest.raises(ArtifactError, match=r"no such folder: 'tyo'.* or 'toy', which ships"):
        load_artifact("tyo")


def test_without_shipped_policies_a_name_is_a_folder(
    shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PRETRAINED", tmp_path / "absent")
    with pytest.raises(ArtifactError, match="no such folder: 'toy'"):
        load_artifact("toy")
