"""Every command that takes a policy refuses a damaged one with exit code 4 and names the file."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import egovcp_deploy.deploy
import egovcp_deploy.evaluate
import egovcp_train.export
import egovcp_train.heldout.command
import egovcp_train.publish
from egovcp.artifact import CONFIG, save_artifact
from egovcp.data import DatasetWriter, Provenance
from egovcp.errors import ArtifactError
from egovcp.plan import PlannerConfig
from egovcp.testing import random_episode, toy_model
from tests.support.policy_mutations.editing import edit_json, edit_tensors

type RunCommand = Callable[[str, str], int]

COMMANDS: dict[str, RunCommand] = {
    "eval": lambda policy, out: egovcp_deploy.evaluate.main([policy, "--task=ball", out]),
    "deploy": lambda policy, out: egovcp_deploy.deploy.main([policy, "--task=ball", out]),
    "export": lambda policy, out: egovcp_train.export.main([policy, out]),
    "push": lambda policy, _: egovcp_train.publish.main([policy, "--repo_id=me/policy"]),
    "eval-model": lambda policy, out: egovcp_train.heldout.command.main(
        [policy, out, f"--dataset.root={Path(out.partition('=')[2]).parent / 'data'}"]
    ),
}


def _nan(folder: Path) -> str:
    return edit_tensors(folder, lambda tensors: tensors["state_mean"].fill_(torch.nan))


def _huge_plan(folder: Path) -> str:
    return edit_json(folder, CONFIG, lambda config: config["planner"].update(samples=10**9))


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "policy"
    save_artifact(path, toy_model(), PlannerConfig(), {"controller_id": "stance-1"})
    return path


@pytest.fixture
def data(tmp_path: Path) -> None:
    """A dataset in ``data``, which `egovcp-eval-model` opens before the policy."""
    with DatasetWriter(tmp_path / "data", Provenance("stance-1", 0, "egovcp-collect")) as writer:
        writer.add(random_episode(0, 20, task="ball"))


@pytest.mark.usefixtures("data")
@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("damage", [_nan, _huge_plan])
def test_a_damaged_policy_is_refused_by_every_command(
    original: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    damage: Callable[[Path], str],
) -> None:
    folder = Path(shutil.copytree(original, tmp_path / "policy"))
    file = damage(folder)
    code = COMMANDS[name](f"--policy.path={folder}", f"--output_dir={tmp_path / 'out'}")
    lines = capsys.readouterr().err.splitlines()
    assert code == 4
    assert len(lines) == 1
    assert str(folder / file) in lines[0]
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize("damage", [_nan, _huge_plan])
def test_a_damaged_policy_is_refused_by_lerobot(
    original: Path, tmp_path: Path, damage: Callable[[Path], str]
) -> None:
    modeling = pytest.importorskip("lerobot_policy_egovcp.modeling_egovcp")
    folder = Path(shutil.copytree(original, tmp_path / "policy"))
    file = damage(folder)
    with pytest.raises(ArtifactError, match=file):
        modeling.EgovcpPolicy.from_pretrained(folder)


@pytest.mark.usefixtures("data")
@pytest.mark.parametrize("name", COMMANDS)
def test_the_folder_of_a_run_is_refused_with_the_folder_of_its_policy(
    original: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    inner = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    shutil.copytree(original, inner)
    code = COMMANDS[name](f"--policy.path={tmp_path / 'run'}", f"--output_dir={tmp_path / 'out'}")
    assert code == 4
    assert f"its policy is {inner}" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["samples", "horizon", "iterations"])
@pytest.mark.parametrize("value", [10**6, 10**9])
def test_a_huge_plan_that_a_flag_asks_for_is_a_usage_error(
    original: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: int
) -> None:
    flags = [f"--policy.path={original}", "--task=ball", f"--output_dir={tmp_path / 'out'}"]
    code = egovcp_deploy.evaluate.main([*flags, f"--planner.{option}={value}"])
    assert code == 2
    assert f"planner.{option}={value}" in capsys.readouterr().err
