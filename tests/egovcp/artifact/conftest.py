"""An artifact, and ways to tamper with a copy of it."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from egovcp.artifact import CONFIG, WEIGHTS, save_artifact
from egovcp.hub import RetryPolicy
from egovcp.manifest import MANIFEST, PROCESSORS, sealed
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model

PLANNER = PlannerConfig(samples=32, elites=4, iterations=1, termination_rule="survival")
QUICK = RetryPolicy(attempts=2, wait_s=0.01, timeout_s=20)
PROVENANCE = {"controller_id": "stance-1", "datasets": [{"repo_id": "me/ball"}]}

FILES = {CONFIG, WEIGHTS, MANIFEST, *PROCESSORS}

type Json = dict[str, Any]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact that tests must not change."""
    path = tmp_path_factory.mktemp("artifact") / "policy"
    model = toy_model()
    model.state_mean.uniform_(-1, 1)
    model.min_return.fill_(-7.0)
    save_artifact(path, model, PLANNER, PROVENANCE)
    return path


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy to tamper with."""
    return Path(shutil.copytree(original, tmp_path / "copy"))


def edit(path: Path, change: Callable[[Json], object]) -> None:
    """A manifest is sealed again: what is wrong with its content is found all the same."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(sealed(content) if path.name == MANIFEST else content))


def sign(folder: Path) -> None:
    """Make the manifest agree with whatever the files now hold."""
    hashes = {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in (CONFIG, WEIGHTS)
    }
    edit(folder / MANIFEST, lambda m: m["files"].update(hashes))
