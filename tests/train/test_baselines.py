"""The variants of the paper's table I, from the flags of egovcp-train to the artifact."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from egovcp.artifact import load_artifact
from egovcp.errors import EgovcpError
from egovcp.manifest import sealed
from egovcp.model import Batch
from egovcp_train.checkpoint import load_training_state
from egovcp_train.loop import Learner
from egovcp_train.train import main
from tests.support.arguments import Arguments

TD = {"policy__loss__q_target": "td", "policy__loss__td_decay": 0.5}
ARWM = {"policy__dynamics": "autoregressive", "policy__loss__autoregressive_steps": 4}
REWARD = {"policy__loss__reward": 1.0, "planner__objective": "td", "planner__horizon": 2}
WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"


def _weights(output: Path) -> dict[str, torch.Tensor]:
    return load_file(output / WEIGHTS)


def _target(output: Path) -> dict[str, torch.Tensor]:
    """The target network of Q in the last checkpoint."""
    found: dict[str, torch.Tensor] = load_training_state(output)["learner"]["target"]
    return found


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory, arguments: Arguments) -> Path:
    """A run with nothing changed; tests must not change it."""
    output = tmp_path_factory.mktemp("baselines") / "plain"
    assert main(arguments(output)) == 0
    return output


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(TD, id="td", marks=pytest.mark.slow),
        pytest.param(ARWM, id="arwm", marks=pytest.mark.slow),
        pytest.param(TD | ARWM | REWARD, id="all"),
    ],
)
def test_a_stopped_variant_that_is_resumed_equals_an_uninterrupted_one(
    arguments: Arguments,
    plain: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, Any],
) -> None:
    straight, halting = tmp_path / "straight", tmp_path / "halting"
    assert main(arguments(straight, **options)) == 0
    update = Learner.update

    def killed(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        if self.step == 4:
            raise RuntimeError("killed after the checkpoint of step 3")
        return update(self, batch, progress)

    with monkeypatch.context() as patched:
        patched.setattr(Learner, "update", killed)
        with pytest.raises(RuntimeError, match="killed"):
            main(arguments(halting, **options))
    assert main([f"--output_dir={halting}", "--resume"]) == 0
    one, two = _weights(straight), _weights(halting)
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)
    if "policy__loss__q_target" in options:
        first, second = _target(straight), _target(halting)
        assert all(torch.equal(first[name], second[name]) for name in first)
    assert any(not torch.equal(one[n], x) for n, x in _weights(plain).items() if n in one)


def test_target_network_is_in_the_checkpoint_and_not_in_the_policy(
    arguments: Arguments, plain: Path, tmp_path: Path
) -> None:
    assert main(arguments(tmp_path / "td", **TD)) == 0
    assert _weights(tmp_path / "td").keys() == _weights(plain).keys()
    assert "target" not in load_training_state(plain)["learner"]
    model = load_training_state(tmp_path / "td")["learner"]["model"]
    network = _target(tmp_path / "td")
    own = {name: model[name.replace("head.", "value_head.", 1)] for name in network}
    assert len(own) == sum(name.startswith("value_head.") for name in model)
    assert any(not torch.equal(network[name], x) for name, x in own.items())


def test_resume_with_td_needs_a_checkpoint_with_a_target_network(
    arguments: Arguments, plain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = [f"--output_dir={plain}", "--resume", "--steps=8", "--policy.loss.q_target=td"]
    assert main(argv) == 4
    assert "does not fit the options" in capsys.readouterr().err


def test_the_artifact_says_what_it_is_and_plans(arguments: Arguments, tmp_path: Path) -> None:
    options = {**TD, **ARWM, **REWARD, "returns__gamma": 0.9}
    assert main(arguments(tmp_path / "all", **options)) == 0
    artifact = load_artifact(str(tmp_path / "all/checkpoints/last/pretrained_model"))
    model = artifact.world_model
    assert (model.config.dynamics, model.config.loss.q_target) == ("autoregressive", "td")
    assert float(model.discount) == pytest.approx(0.9)
    assert artifact.planner.objective == "td"
    assert artifact.make_policy().prepare() is not None


def test_an_artifact_whose_planner_asks_for_rewards_it_does_not_know_is_refused(
    plain: Path, tmp_path: Path
) -> None:
    """As somebody may have written it by hand: egovcp-train refuses to."""
    folder = tmp_path / "policy"
    shutil.copytree(plain / "checkpoints/last/pretrained_model", folder)
    config = json.loads((folder / "config.json").read_text())
    config["planner"]["objective"] = "reward"
    (folder / "config.json").write_text(json.dumps(config))
    manifest = json.loads((folder / "manifest.json").read_text())
    digest = hashlib.sha256((folder / "config.json").read_bytes()).hexdigest()
    manifest["files"]["config.json"] = digest
    (folder / "manifest.json").write_text(json.dumps(sealed(manifest)))
    with pytest.raises(EgovcpError, match=r"objective=reward adds up predicted rewards") as caught:
        load_artifact(str(folder))
    assert caught.value.exit_code == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"planner__objective": "reward"}, "train it with --policy.loss.reward=1"),
        ({"planner__objective": "td"}, "train it with --policy.loss.reward=1"),
        (
            {"policy__loss__td_decay": 1.0},
            "--policy.loss.td_decay=1.0: expected at least 0 and less",
        ),
        ({"policy__dynamics": "autoregressive"}, "--sampling.length=6"),
        ({**ARWM, "planner__latent": "sample"}, "trains only its mean"),
        ({"policy__dynamics": "autoregresive"}, "autoregresive"),
        ({"policy__loss__q_target": "sarsa"}, "sarsa"),
    ],
)
def test_what_does_not_go_together_is_refused_before_anything_is_read(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: dict[str, Any],
    message: str,
) -> None:
    values = {"dataset__root": tmp_path / "nowhere", **options}
    assert main(arguments(tmp_path / "run", **values)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
