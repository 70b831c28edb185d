"""egovcp-train --policy.push_to_hub and egovcp-push: from a run to a model on the Hub."""

import json
import re
import shlex
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from egovcp.artifact import load_artifact, save_artifact
from egovcp.checks import check_artifact
from egovcp.hub import RetryPolicy
from egovcp.manifest import PROCESSORS
from egovcp.plan import PlannerConfig
from egovcp.robot_spec import G1, RobotSpec
from egovcp.testing import toy_model
from egovcp_train import publish as publishing
from egovcp_train.publish import main as push
from egovcp_train.train import main as train
from tests.support.arguments import Arguments
from tests.support.hub import FakeHub, redirect_hub

REPO = "models/me/policy"
TO_HUB = ("--policy.push_to_hub", "--policy.repo_id=me/policy")
QUICK = ("--network.attempts=2", "--network.wait_s=0.01", "--network.timeout_s=20")


@pytest.fixture(autouse=True)
def logged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody is, and waits for nothing."""
    monkeypatch.setenv("HF_TOKEN", "hf_right")
    quick = RetryPolicy(attempts=2, wait_s=0.01, timeout_s=20)
    monkeypatch.setattr(publishing, "RETRY_POLICY", quick)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact without a run; tests must not change it."""
    path = tmp_path_factory.mktemp("artifact") / "pretrained_model"
    planner = PlannerConfig(samples=16, elites=4, iterations=1)
    save_artifact(path, toy_model(), planner, {"controller_id": "stance-1", "step": 7})
    return path


def _last(run: Path) -> Path:
    return run / "checkpoints" / "last" / "pretrained_model"


# --- a run ------------------------------------------------------------------------------
def test_a_run_is_published_in_one_commit_and_plans_from_there(
    hub: FakeHub, arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    argv = arguments(run, *TO_HUB, tensorboard="true", eval_freq=2, sampling__length=16)
    assert train(argv) == 0
    head = hub.store.commit(REPO, "main")
    assert hub.requests["commit"] == 1
    assert f"me/policy@main is now {head.sha}" in capsys.readouterr().out
    published = {path for path in head.files if path != ".gitattributes"}
    data = {"config.json", "model.safetensors", "manifest.json", *PROCESSORS}
    assert published == {*data, "README.md", "assets/training.png"}
    artifact = check_artifact("me/policy", head.sha)
    assert artifact.manifest == load_artifact(str(_last(run))).manifest
    config = json.loads((artifact.path / "config.json").read_text())
    assert not {"push_to_hub", "repo_id", "private"} & config["world_model"].keys()


def test_the_card_says_what_the_manifest_knows(
    hub: FakeHub, arguments: Arguments, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert train(arguments(run, *TO_HUB, sampling__length=16)) == 0
    card = (_last(run) / "README.md").read_text(encoding="utf-8")
    manifest = load_artifact(str(_last(run))).manifest
    front = yaml.safe_load(card.split("---")[1])
    assert (front["license"], front["pipeline_tag"]) == ("apache-2.0", "robotics")
    assert manifest["tasks"] == ["ball"]
    for fact in ("stance-test", "**ball**", *manifest["versions"].values(), "me/policy"):
        assert fact in card
    assert {"latent/kl", "value/slope"} <= manifest["heldout"].keys()
    for name, value in manifest["heldout"].items():
        assert f"| `{name}` | {value:.4g} |" in card
    assert "training.png" not in card, "nothing was recorded, so there is no picture"


def _card(path: Path, robot: RobotSpec, **provenance: Any) -> tuple[dict[str, Any], str]:
    """Front matter and text of the card of a policy."""
    facts = {"controller_id": "servo-1", "heldout": {"object_rmse_m": 0.1}, **provenance}
    save_artifact(path, toy_model(robot=robot), PlannerConfig(), facts)
    _, front, text = publishing.card_text(load_artifact(str(path)), "me/policy").split("---", 2)
    return yaml.safe_load(front), text


def test_the_card_of_another_robot_does_not_describe_the_g1(tmp_path: Path) -> None:
    front, text = _card(tmp_path / "arm", replace(G1, robot_type="arm"), tasks=["push the cube"])
    assert front["tags"] == ["egovcp", "LeRobot", "arm", "depth", "world-model"]
    assert "A policy for robot `arm`" in text
    for word in ("G1", "hands", "in simulation only", "--task=push"):
        assert word not in text
    front, text = _card(tmp_path / "g1", G1, tasks=["ball"])
    assert {"unitree_g1", "humanoid"} <= set(front["tags"])
    assert "A policy for the Unitree G1 humanoid" in text
    assert "--task=ball" in text


def test_the_card_credits_metrics_to_a_single_dataset_only(tmp_path: Path) -> None:
    one = {"repo_id": "me/a", "revision": "abc", "episodes": ""}
    front, text = _card(tmp_path / "one", G1, datasets=[one])
    (model,) = front["model-index"]
    assert model["results"][0]["dataset"]["name"] == "me/a"
    assert "| `object_rmse_m` | 0.1 | root mean squared error" in text
    both = [one, *({"repo_id": name, "revision": "", "episodes": ""} for name in ("", "me/c"))]
    options = {"datasets": [{"repo_id": "me/a"}, {"root": "data/local"}, {"repo_id": "me/c"}]}
    front, text = _card(tmp_path / "both", G1, datasets=both, train_config=options)
    assert "model-index" not in front
    assert "| dataset | a local folder, `local` |" in text
    assert "| dataset | `me/c`, in a local folder |" in text


def test_a_run_that_is_not_published_has_its_card_too(arguments: Arguments, tmp_path: Path) -> None:
    assert train(arguments(tmp_path / "run", steps=1)) == 0
    card = (_last(tmp_path / "run") / "README.md").read_text(encoding="utf-8")
    assert f'load_artifact("{_last(tmp_path / "run").resolve()}")' in card


def test_a_private_run_is_private(hub: FakeHub, arguments: Arguments, tmp_path: Path) -> None:
    assert train(arguments(tmp_path / "run", *TO_HUB, "--policy.private", steps=1)) == 0
    assert hub.store.refs(REPO).private


# --- refused before training ------------------------------------------------------------
def _refused(
    argv: list[str], run: Path, code: int, capsys: pytest.CaptureFixture[str], message: str
) -> None:
    assert train(argv) == code
    shown = capsys.readouterr().err
    assert re.search(message, shown), shown
    assert not run.exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--policy.push_to_hub"], "--policy.repo_id='': expected user/name"),
        (["--policy.push_to_hub", "--policy.repo_id=policy"], "'policy': expected user/name"),
        (["--policy.push_to_hub", "--policy.repo_id=me/../x"], "expected user/name"),
        (["--policy.repo_id=me/policy"], "without --policy.push_to_hub"),
    ],
)
def test_a_bad_id_is_refused_before_training(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flags: list[str],
    message: str,
) -> None:
    _refused(arguments(tmp_path / "run", *flags), tmp_path / "run", 2, capsys, message)


def test_a_missing_login_is_refused_before_training(
    hub: FakeHub,
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.setattr("egovcp_train.train.open_readers", lambda _: pytest.fail("reads data"))
    run = tmp_path / "run"
    _refused(arguments(run, *TO_HUB), run, 5, capsys, "not logged in.*hf auth login")


def test_a_token_that_may_not_write_is_refused_before_training(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    with (
        FakeHub(tmp_path / "hub", token="hf_other") as hub,
        redirect_hub(hub.endpoint, tmp_path / "home"),
    ):
        _refused(arguments(run, *TO_HUB), run, 5, capsys, "write access to models of me")


# --- a push that fails ------------------------------------------------------------------
def test_a_failed_push_keeps_the_run_and_names_the_command_that_repeats_it(
    hub: FakeHub, arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "a run"
    hub.fail("lfs_batch", 503)
    assert train(arguments(run, *TO_HUB, "--policy.private")) == 5
    shown = capsys.readouterr()
    assert "done at step 6" in shown.out
    assert shown.err.splitlines()[-1].startswith("egovcp-train: error: ")
    assert check_artifact(str(_last(run))).manifest["step"] == 6
    assert hub.requests["commit"] == 0
    hub.reset()
    name, *again = shlex.split(shown.err.strip().rpartition("repeat that with: ")[2])
    assert name == "egovcp-push"
    assert push(again) == 0
    assert load_artifact("me/policy").manifest["step"] == 6
    assert hub.store.refs(REPO).private


def test_a_run_that_is_stopped_is_not_published(
    hub: FakeHub, arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = nullcontext([15])  # as if a signal had come
    monkeypatch.setattr("egovcp_train.train.stop_on_signal", lambda *_: stopped)
    assert train(arguments(tmp_path / "run", *TO_HUB)) == 130
    assert hub.requests["commit"] == 0


def test_a_resumed_run_is_published_as_it_was_told_at_first(
    hub: FakeHub, arguments: Arguments, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    hub.fail("commit", 503)
    assert train(arguments(run, *TO_HUB)) == 5
    hub.reset()
    assert train([f"--output_dir={run}", "--resume"]) == 0
    assert hub.requests["commit"] == 1
    assert load_artifact("me/policy").manifest["step"] == 6


# --- egovcp-push ------------------------------------------------------------------------
def test_pushing_again_changes_nothing(hub: FakeHub, policy: Path, tmp_path: Path) -> None:
    report = tmp_path / "push.json"
    argv = [f"--policy.path={policy}", "--repo_id=me/policy", f"--json={report}", *QUICK]
    assert push([*argv, "--tag=v1"]) == 0
    first = json.loads(report.read_text())
    head = hub.store.commit(REPO, "main").sha
    assert (first["commit"], first["new"], first["tag"]) == (head, True, "v1")
    assert hub.store.refs(REPO).tags == {"v1": head}
    assert push(argv) == 0
    assert json.loads(report.read_text())["new"] is False
    assert hub.store.commit(REPO, "main").sha == head
    assert load_artifact("me/policy", "v1").path.name == head


def test_only_the_artifact_and_its_card_are_published(hub: FakeHub, policy: Path) -> None:
    (policy / "notes.txt").write_text("mine")
    assert push([f"--policy.path={policy}", "--repo_id=me/policy", *QUICK]) == 0
    assert "notes.txt" not in hub.store.commit(REPO, "main").files
    assert "me/policy" in hub.store.blob(
        hub.store.commit(REPO, "main").files["README.md"].sha256
    ).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("path", "repo_id", "code", "message"),
    [
        ("", "me/policy", 2, "expected the folder"),
        ("absent", "me/policy", 2, "expected the folder"),
        (None, "policy", 2, "expected user/name"),
        (".", "me/policy", 4, "not a policy artifact"),
    ],
)
def test_misuse_is_explained(
    policy: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    path: str | None,
    repo_id: str,
    code: int,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = policy if path is None else path
    assert push([f"--policy.path={folder}", f"--repo_id={repo_id}"]) == code
    assert message in capsys.readouterr().err
