"""Loggers of a run: TensorBoard, images, the Rerun recording, Weights & Biases, Trackio."""

import errno
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egovcp.artifact import load_artifact
from egovcp_train.train import main
from tests.support.arguments import Arguments


def test_scalars_and_pictures_go_to_tensorboard(arguments: Arguments, tmp_path: Path) -> None:
    assert main(arguments(tmp_path / "run", tensorboard="true", eval_freq=2, steps=4)) == 0
    (events,) = (tmp_path / "run" / "tensorboard").iterdir()
    content = events.read_bytes()
    for name in (b"loss/total", b"loss/value", b"heldout/latent/kl", b"grad_norm"):
        assert name in content
    for name in (b"depth_valid_h16", b"state_joint_position_repeat_h4", b"latent_active_share"):
        assert b"heldout/ball/" + name in content
    assert b"heldout/open_loop_ball" in content
    assert b"PNG" in content


def test_the_recording_of_open_loop_prediction_lies_in_the_run(
    arguments: Arguments, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    assert main(arguments(tmp_path / "run", steps=1)) == 0
    assert (tmp_path / "run" / "open_loop.rrd").read_bytes()[:4] == b"RRF2"


@pytest.mark.parametrize("broken", ["record", pytest.param("draw", marks=pytest.mark.slow)])
def test_pictures_that_fail_do_not_take_the_finished_model_with_them(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    whole, output = tmp_path / "whole", tmp_path / "broken"
    assert main(arguments(whole, tensorboard="true")) == 0

    monkeypatch.setattr(f"egovcp_train.train.{broken}", _full)
    assert main(arguments(output, tensorboard="true")) == 5
    assert _weights(output) == _weights(whole)


@pytest.mark.slow
def test_pictures_that_fail_in_the_middle_cost_nothing_of_what_was_to_be_saved_there(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, output = tmp_path / "whole", tmp_path / "broken"
    options = {"steps": 6, "save_freq": 3, "eval_freq": 3, "tensorboard": "true"}
    assert main(arguments(whole, **options)) == 0
    with monkeypatch.context() as patch:
        patch.setattr("egovcp_train.train.draw", _full)
        assert main(arguments(output, **options)) == 5
    assert (output / "checkpoints" / "last").resolve().name == "000003"
    kept = load_artifact(str(output / "checkpoints/last/pretrained_model"))
    assert "value/slope" in kept.manifest["heldout"]
    assert main([f"--output_dir={output}", "--resume"]) == 0
    assert _weights(output) == _weights(whole)


def _full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def _weights(run: Path) -> bytes:
    return (run / "checkpoints/last/pretrained_model/model.safetensors").read_bytes()


# --- Weights & Biases, with a stand-in for the package -------------------------------
class _Run:
    def __init__(self, run_id: str) -> None:
        self.id = run_id
        self.logged: list[tuple[int, dict[str, Any]]] = []
        self.artifacts: list[Any] = []
        self.finished = False

    def log(self, values: dict[str, Any], step: int) -> None:
        self.logged.append((step, values))

    def log_artifact(self, artifact: Any) -> None:
        self.artifacts.append(artifact)

    def finish(self) -> None:
        self.finished = True


class _Wandb(ModuleType):
    """What egovcp uses of the package."""

    class Error(Exception):
        pass

    def __init__(self) -> None:
        super().__init__("wandb")
        self.__spec__ = ModuleSpec("wandb", None)
        self.runs: list[_Run] = []
        self.asked: list[dict[str, Any]] = []
        self.refuses = False

    def init(self, **options: Any) -> _Run:
        if self.refuses:
            raise self.Error("api_key not configured")
        self.asked.append(options)
        self.runs.append(_Run(options["id"] or "abc123"))
        return self.runs[-1]

    def Image(self, pixels: Any) -> Any:  # noqa: N802
        return SimpleNamespace(pixels=np.asarray(pixels))

    def Artifact(self, name: str, type: str) -> Any:  # noqa: A002, N802
        folders: list[str] = []
        return SimpleNamespace(name=name, type=type, folders=folders, add_dir=folders.append)


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> _Wandb:
    fake = _Wandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


def test_scalars_pictures_and_the_policy_go_there_and_a_resumed_run_goes_on(
    arguments: Arguments, tmp_path: Path, wandb: _Wandb
) -> None:
    output = tmp_path / "run"
    flags = ["--wandb.enable", "--wandb.project=hands", "--wandb.mode=offline"]
    assert main(arguments(output, *flags)) == 0
    (run,), (asked,) = wandb.runs, wandb.asked
    assert (asked["project"], asked["mode"], asked["id"]) == ("hands", "offline", None)
    assert asked["config"]["steps"] == 6
    logged = {name: step for step, values in run.logged for name in values}
    assert logged["loss/total"] == 6
    assert logged["heldout/latent/kl"] == 6
    assert "heldout/value_ball" in logged
    steps = [step for step, _ in run.logged]
    assert steps == sorted(steps)  # wandb drops what goes back in time
    (artifact,) = run.artifacts
    assert artifact.folders == [str(output / "checkpoints" / "000006" / "pretrained_model")]
    assert run.finished

    argv = [f"--output_dir={output}", "--resume", "--steps=8", "--wandb.disable_artifact"]
    assert main(argv) == 0
    assert wandb.asked[-1]["id"] == "abc123"
    assert wandb.runs[-1].artifacts == []


def test_trackio_has_scalars_and_pictures_and_a_resumed_run_goes_on(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, run, output = list[tuple[str, str, str]](), _Run(""), tmp_path / "run"

    def init(project: str, name: str, config: dict[str, Any], resume: str) -> _Run:
        started.append((project, name, resume))
        return run

    fake: Any = SimpleNamespace(init=init, Image=np.asarray)
    fake.__spec__ = ModuleSpec("trackio", None)
    monkeypatch.setitem(sys.modules, "trackio", fake)
    assert main(arguments(output, "--trackio=hands")) == 0
    assert main(arguments(tmp_path / "other" / "run", "--trackio=hands", steps=1)) == 0
    assert main([f"--output_dir={output}", "--resume", "--steps=8"]) == 0
    own, other, resumed = started
    assert own == resumed  # trackio continues the newest run of a name
    assert own != other
    assert all(name.startswith("run-") for _, name, _ in started)
    assert {(project, resume) for project, _, resume in started} == {("hands", "allow")}
    logged = [(name, step) for step, values in run.logged for name in values]
    assert {("loss/total", 6), ("heldout/value_ball", 6), ("loss/total", 8)} <= set(logged)
    assert run.finished


@pytest.mark.parametrize(
    ("package", "flag"), [("wandb", "--wandb.enable"), ("trackio", "--trackio=hands")]
)
def test_without_the_package_it_is_refused_before_anything_is_written(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    package: str,
    flag: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert main(arguments(tmp_path / "run", flag)) == 5
    assert f"pip install 'egovcp-train[{package}]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_server_that_refuses_is_a_matter_of_the_surroundings(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str], wandb: _Wandb
) -> None:
    wandb.refuses = True
    assert main(arguments(tmp_path / "run", "--wandb.enable")) == 5
    assert "wandb: api_key not configured" in capsys.readouterr().err
