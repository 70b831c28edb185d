"""The policy that ships with egovcp, whatever it has learned."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from egovcp.artifact import PRETRAINED, WEIGHTS, Artifact, shipped_policies
from egovcp.checks import check_artifact
from egovcp.errors import ArtifactError
from egovcp.manifest import MANIFEST
from egovcp.policy_options import load_policy
from egovcp.robot.controllers import WALK, make_controller
from egovcp.robot.stance import StanceController

MOST_BYTES = 6_000_000


@pytest.fixture(scope="module")
def contact() -> Artifact:
    assert shipped_policies() == ["contact"], "make it with: make ship FROM=POLICY"
    return load_policy("contact")


def test_it_loads_in_single_precision_and_plans(contact: Artifact) -> None:
    assert {p.dtype for p in contact.world_model.parameters()} == {torch.float32}
    assert check_artifact("contact").path == contact.path == PRETRAINED / "contact"


def test_it_drives_only_the_walking_controller(contact: Artifact) -> None:
    contact.require_controller(make_controller(WALK).id)
    with pytest.raises(ArtifactError, match="with low-level controller"):
        contact.require_controller(StanceController().id)


def test_it_knows_all_tasks(contact: Artifact) -> None:
    assert set(contact.manifest["tasks"]) == {"ball", "wall", "arch"}


def test_it_is_small_and_in_half_precision(contact: Artifact) -> None:
    files = [path for path in contact.path.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES
    stored = load_file(contact.path / WEIGHTS)
    parameters = {name for name, _ in contact.world_model.named_parameters()}
    assert {stored[name].dtype for name in parameters} == {torch.float16}
    assert not any(name.startswith("object_head") for name in stored)


def test_its_card_names_it(contact: Artifact) -> None:
    card = (contact.path / "README.md").read_text(encoding="utf-8")
    assert "--policy.path=contact " in card
    assert contact.controller_id in card


def test_its_files_name_no_folder_of_the_machine_it_was_trained_on(contact: Artifact) -> None:
    texts = [(contact.path / name).read_text("utf-8") for name in ("README.md", MANIFEST)]
    home = str(Path.home())
    for text in texts:
        assert str(PRETRAINED.parents[1]) not in text
        assert f"{home}/" not in text
    command = json.loads(texts[1]).get("command", [])
    assert not [word for word in command if word.partition("=")[2].startswith("/")]
