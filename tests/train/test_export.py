"""egovcp-export: the same policy up to rounding, in half the size."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from egovcp import spec
from egovcp.artifact import CONFIG, WEIGHTS, load_artifact, save_artifact
from egovcp.manifest import MANIFEST, PROCESSORS
from egovcp.model import PRESETS
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model
from egovcp_train import publish
from egovcp_train.export import SOURCE, main

PLANNER = PlannerConfig(samples=64, elites=8, horizon=4, iterations=2)
PROVENANCE = {
    "controller_id": "stance-1",
    "tasks": ["ball"],
    "command": ["/opt/venv/bin/egovcp-train", "--dataset.root=/home/me too/data/all", "--steps=2"],
    "train_config": {"dataset": {"root": "/home/me too/data/all"}, "output_dir": "runs/all"},
    "datasets": [{"repo_id": "me/ball", "revision": None, "episodes": ""}],
    "heldout": {"value/r2": 0.5},
}


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact as training writes it; tests must not change it."""
    path = tmp_path_factory.mktemp("artifact") / "single"
    model = toy_model(PRESETS["debug"])
    generator = torch.Generator().manual_seed(1)
    model.state_mean.uniform_(-1, 1, generator=generator)
    model.return_std.fill_(3e-6)  # less than float16 can represent with precision
    save_artifact(path, model, PLANNER, PROVENANCE)
    (path / "assets").mkdir()
    (path / publish.CURVES).write_bytes(b"curves")
    return path


@pytest.fixture(scope="module")
def half(single: Path) -> Path:
    path = single.with_name("half")
    assert main([f"--policy.path={single}", f"--output_dir={path}"]) == 0
    return path


def test_weights_are_rounded_and_statistics_are_not(single: Path, half: Path) -> None:
    stored = load_file(half / WEIGHTS)
    exact = load_artifact(str(single)).world_model
    loaded = load_artifact(str(half)).world_model
    parameters = {name for name, _ in exact.named_parameters()}
    for name, value in exact.state_dict().items():
        kept = loaded.state_dict()[name]
        assert kept.dtype is torch.float32
        assert stored[name].dtype is (torch.float16 if name in parameters else torch.float32)
        assert torch.equal(kept, value.half().float() if name in parameters else value), name
    small, large = ((path / WEIGHTS).stat().st_size for path in (half, single))
    assert small < 0.6 * large  # the header and the statistics are not halved


def test_plans_differ_by_rounding_only(single: Path, half: Path) -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(300, 5000, (2, spec.DEPTH_ROWS, spec.DEPTH_COLS)).astype(np.uint16)
    state = rng.normal(size=(2, spec.STATE_DIM)).astype(np.float32)
    a, b = (load_artifact(str(p)).make_policy(2, seed=4).act(depth, state) for p in (single, half))
    np.testing.assert_allclose(b.plan, a.plan, atol=0.02)
    np.testing.assert_allclose(b.value, a.value, rtol=0.02)
    assert not np.array_equal(a.value, b.value)


def test_options_and_provenance_are_kept_without_folders_of_the_machine(
    single: Path, half: Path
) -> None:
    before, after = (json.loads((path / MANIFEST).read_text()) for path in (single, half))
    assert after[SOURCE] == before["files"][WEIGHTS]
    assert after["command"] == ["egovcp-train", "--dataset.root=all", "--steps=2"]
    assert after["train_config"] == {"dataset": {"root": "all"}, "output_dir": "runs/all"}
    for name in ("controller_id", "tasks", "datasets", "heldout"):
        assert after[name] == before[name]
    for name in (CONFIG, *PROCESSORS):
        assert (half / name).read_bytes() == (single / name).read_bytes()


def test_it_has_a_card_and_the_curves_of_the_training(half: Path) -> None:
    card = (half / publish.CARD).read_text()
    assert f"egovcp-eval --policy.path={half} --task=ball" in card
    assert publish.CURVES in card
    assert (half / publish.CURVES).read_bytes() == b"curves"
    assert "/home/me" not in card


@pytest.mark.parametrize("output", ["contact", "~/contact"])
def test_the_card_describes_the_copy_even_if_its_folder_has_the_name_of_a_shipped_policy(
    single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main([f"--policy.path={single}", f"--output_dir={output}"]) == 0
    card = (tmp_path / "contact" / publish.CARD).read_text()
    assert f"--policy.path={tmp_path / 'contact'} --task=ball" in card


def test_the_card_of_a_shipped_policy_has_its_name(
    single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "PRETRAINED", tmp_path)
    output = tmp_path / "contact"
    assert main([f"--policy.path={single}", f"--output_dir={output}"]) == 0
    assert "egovcp-eval --policy.path=contact " in (output / publish.CARD).read_text()


def test_a_second_rounding_changes_nothing(half: Path, tmp_path: Path) -> None:
    output = tmp_path / "again"
    assert main([f"--policy.path={half}", f"--output_dir={output}"]) == 0
    for name in (MANIFEST, WEIGHTS):
        assert (output / name).read_bytes() == (half / name).read_bytes()


def test_a_link_to_an_empty_folder_is_followed(single: Path, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    assert main([f"--policy.path={single}", f"--output_dir={tmp_path / 'link'}"]) == 0
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / publish.CARD).is_file()


def test_a_failure_of_the_card_leaves_no_folder(
    single: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egovcp_train.export.card_text", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main([f"--policy.path={single}", f"--output_dir={tmp_path / 'half'}"])
    assert not list(tmp_path.iterdir())


def test_a_weight_beyond_the_range_is_refused_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = toy_model()
    model.decode_state.rest[-1].bias.data[0] = 1e5  # type: ignore[union-attr, operator]
    save_artifact(tmp_path / "large", model, PLANNER, {"controller_id": "stance-1"})
    output = tmp_path / "half"
    argv = [f"--policy.path={tmp_path / 'large'}", f"--output_dir={output}"]
    assert main(argv) == 4
    assert "decode_state" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["large"]
