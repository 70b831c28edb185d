"""What a training shows of its model: TensorBoard, pictures, the Rerun recording."""

import errno
from collections.abc import Callable
from pathlib import Path

import pytest

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

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"egovcp_train.train.{broken}", full)
    assert main(arguments(output, tensorboard="true")) == 5
    kept = [o / "checkpoints/last/pretrained_model/model.safetensors" for o in (whole, output)]
    assert kept[0].read_bytes() == kept[1].read_bytes()
