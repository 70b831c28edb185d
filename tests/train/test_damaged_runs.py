"""What a run is resumed from is refused, with one line that names the file, if it is damaged."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from egovcp.errors import ArtifactError
from egovcp.files import sha256
from egovcp_train.checkpoint import (
    CONFIG_FILE,
    DIGEST_FILE,
    STATE_FILE,
    load_training_state,
    new_checkpoint,
)
from egovcp_train.train import main


def _checkpoint(output: Path) -> None:
    with new_checkpoint(output, 1, {"step": 1}):
        pass


class _Bomb:
    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return (pytest.fail, ("a pickle was executed",))


def _state_file(output: Path) -> Path:
    return output / "checkpoints" / "last" / "training_state" / STATE_FILE


def _refuses_to_load(output: Path, reason: str) -> None:
    with pytest.raises(ArtifactError, match=rf"state\.pt: cannot be read \({reason}") as caught:
        load_training_state(output)
    assert "\n" not in str(caught.value)


def test_the_training_state_is_read_without_executing_code(tmp_path: Path) -> None:
    _checkpoint(tmp_path)
    file = _state_file(tmp_path)
    torch.save({"step": _Bomb()}, file)
    _refuses_to_load(tmp_path, "its SHA-256")
    file.with_name(DIGEST_FILE).write_text(f"{sha256(file)}  {STATE_FILE}\n")
    _refuses_to_load(tmp_path, "not a training state")


def test_a_training_state_without_digest_is_refused(tmp_path: Path) -> None:
    _checkpoint(tmp_path)
    _state_file(tmp_path).with_name(DIGEST_FILE).unlink()
    _refuses_to_load(tmp_path, "No such file")


def test_a_changed_training_state_is_refused(tmp_path: Path) -> None:
    _checkpoint(tmp_path)
    file = _state_file(tmp_path)
    content = bytearray(file.read_bytes())
    content[content.index(b"step")] ^= 1
    file.write_bytes(content)
    _refuses_to_load(tmp_path, "its SHA-256")


@pytest.mark.parametrize("name", [STATE_FILE, DIGEST_FILE])
@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "loop"])
def test_a_training_state_that_is_no_regular_file_is_refused(
    tmp_path: Path, name: str, kind: str
) -> None:
    _checkpoint(tmp_path)
    path = _state_file(tmp_path).with_name(name)
    path.unlink()
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "loop":
            path.symlink_to(path.name)
    _refuses_to_load(tmp_path, "a FIFO|a device|a folder|Too many levels")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[1]", "holds a list; expected options"),
        (b"a: " + b"[" * 3000, "holds no options"),
        (b"output_dir: run\nsteps: many", "--steps=many: expected int"),
        (b"output_dir: run\nsurprise: 1", "unknown option --surprise"),
        (b"output_dir: run\nplanner: {samples: 1000000}", "planner.samples=1000000"),
        (b"\xff", "not UTF-8"),
        (b"a" * (1 << 20), "too large"),
        (None, "a FIFO, expected a regular file"),
    ],
)
def test_damaged_options_of_a_run_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None, message: str
) -> None:
    if content is None:
        os.mkfifo(tmp_path / CONFIG_FILE)
    else:
        (tmp_path / CONFIG_FILE).write_bytes(content)
    assert main([f"--output_dir={tmp_path}", "--resume"]) == 4
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert CONFIG_FILE in lines[0]
    assert message in lines[0]
