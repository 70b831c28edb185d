"""What a training shows of its model: TensorBoard, pictures, the Rerun recording."""

import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from egovcp.artifact import load_artifact
from egovcp_train.train import main

type Arguments = Callable[..., list[str]]


def test_scalars_and_pictures_go_to_tensorboard(arguments: Arguments, tmp_path: Path) -> None:
    assert main(arguments(tmp_path / "run", tensorboard="true", eval_freq=2, steps=4)) == 0
    (events,) = (tmp_path / "run" / "tensorboard").iterdir()
    content = events.read_bytes()
    for name in (b"loss/total", b"loss/value", b"heldout/latent/kl", b"grad_norm"):
        assert name in content
    for name in (b"depth_valid_h16", b"state_joint_position_repeat_h4", b"latent_active"):
        assert b"heldout/ball/" + name in content
    assert b"heldout/open_loop_ball" in content
    assert b"PNG" in content


def test_the_recording_of_open_loop_prediction_lies_in_the_run(
    arguments: Arguments, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    assert main(arguments(tmp_path / "run", steps=1)) == 0
    assert (tmp_path / "run" / "open_loop.rrd").read_bytes()[:4] == b"RRF2"


@pytest.mark.parametrize("broken", ["record", "draw"])
def test_pictures_that_fail_do_not_take_the_finished_model_with_them(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    whole, output = tmp_path / "whole", tmp_path / "broken"
    assert main(arguments(whole, tensorboard="true")) == 0

    monkeypatch.setattr(f"egovcp_train.train.{broken}", _full)
    assert main(arguments(output, tensorboard="true")) == 5
    assert _weights(output) == _weights(whole)


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
