"""egovcp-train on several datasets."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from egovcp.artefact import load_artefact
from egovcp_train.checkpoint import load_training_state
from egovcp_train.train import main

type Arguments = Callable[..., list[str]]


@pytest.fixture
def mixed(arguments: Arguments, dataset_root: Path, tmp_path: Path) -> Arguments:
    """Flags of a run on the dataset and a copy of it."""
    copy = shutil.copytree(dataset_root, tmp_path / "copy")

    def build(output: Path, *flags: str, weights: tuple[str, str] = ("2", "1")) -> list[str]:
        roots = zip((dataset_root, copy), weights, strict=True)
        given = ", ".join(f"{{root: {root}, weight: {weight}}}" for root, weight in roots)
        return [*arguments(output, dataset__root=None), f"--datasets=[{given}]", *flags]

    return build


def test_a_run_on_two_datasets_is_resumed_exactly(mixed: Arguments, tmp_path: Path) -> None:
    straight, resumed = tmp_path / "straight", tmp_path / "resumed"
    assert main(mixed(straight, "--sampling.tasks={ball: 2}")) == 0
    assert main(mixed(resumed, "--sampling.tasks={ball: 2}", "--steps=3")) == 0
    assert main([f"--output_dir={resumed}", "--resume", "--steps=6"]) == 0
    one, two = load_training_state(straight), load_training_state(resumed)
    assert one["stream"] == two["stream"]
    assert one["stream"]["mix"] == {"datasets": [2.0, 1.0], "tasks": {"ball": 2.0}}
    artefact = load_artefact(str(straight / "checkpoints" / "last" / "pretrained_model"))
    assert len(artefact.manifest["datasets"]) == 2
    assert all(torch.isfinite(w).all() for w in two["learner"]["model"].values())


@pytest.mark.parametrize(
    ("weights", "flags", "message"),
    [
        (("1", "null"), [], "every dataset a weight, or none"),
        (("1", "-1"), [], "a weight of -1.0"),
        (("1", "1"), ["--sampling.tasks={bal: 2}"], "did you mean 'ball'"),
        (("1", "1"), ["--dataset.root=x"], "--dataset and --datasets"),
    ],
)
def test_a_mixture_that_makes_no_sense_is_refused_before_anything_is_written(
    mixed: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    weights: tuple[str, str],
    flags: list[str],
    message: str,
) -> None:
    assert main(mixed(tmp_path / "run", *flags, weights=weights)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
