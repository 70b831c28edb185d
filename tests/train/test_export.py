"""egovcp-export: the networks say what the world model says, in another runtime."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from safetensors.torch import load_file, save_file

from egovcp import packages, spec
from egovcp.artifact import load_artifact, save_artifact
from egovcp.errors import ArtifactError
from egovcp.model import PRESETS, Carry, WorldModel
from egovcp.model.depth import nearness
from egovcp.plan import PlannerConfig
from egovcp_train import export as module
from egovcp_train.export import (
    GOLDEN,
    NETWORKS,
    REPORT,
    TOLERANCE,
    golden_inputs,
    main,
    networks_of,
    pooled_nearness,
    verify,
)

type Run = Callable[..., list[Any]]

NAMES = NETWORKS.keys() - {"reward"}
FILES = {*(f"{name}.onnx" for name in NAMES), GOLDEN, REPORT}


def _lively(model: WorldModel) -> WorldModel:
    """Heads that start at zero would agree by saying nothing."""
    generator = torch.Generator().manual_seed(3)
    for value in model.parameters():
        value.data += 0.05 * torch.randn(value.shape, generator=generator)
    model.state_mean.uniform_(-1, 1, generator=generator)
    model.state_std.uniform_(0.5, 2, generator=generator)
    model.return_mean.fill_(-3.0)
    model.return_std.fill_(2.0)
    model.min_return.fill_(-9.0)
    return model.eval()


@pytest.fixture(scope="module")
def artifact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("artifact") / "policy"
    torch.manual_seed(0)
    planner = PlannerConfig(samples=16, elites=4)
    save_artifact(path, _lively(WorldModel(PRESETS["debug"])), planner, {"controller_id": "s-1"})
    return path


@pytest.fixture(scope="module")
def exported(artifact: Path) -> Path:
    """An export; tests must not change it."""
    output = artifact.parent / "onnx"
    assert main([f"--policy.path={artifact}", f"--output_dir={output}"]) == 0
    return output


@pytest.fixture(scope="module")
def run(exported: Path) -> Run:
    """Run a network on named arrays."""
    sessions = {n: onnxruntime.InferenceSession(exported / f"{n}.onnx") for n in NAMES}

    def answer(name: str, **inputs: Any) -> list[Any]:
        arrays = {key: np.asarray(value) for key, value in inputs.items()}
        found: list[Any] = sessions[name].run(None, arrays)
        return found

    return answer


def test_the_golden_vectors_hold_in_another_runtime(exported: Path, run: Run) -> None:
    golden = load_file(exported / GOLDEN)
    model = load_artifact(str(exported.parent / "policy")).world_model
    for name, network in networks_of(model).items():
        found = run(name, **{key: golden[f"inputs/{key}"] for key in network.inputs})
        for key, value in zip(network.outputs, found, strict=True):
            expected = golden[f"outputs/{name}/{key}"].numpy()
            np.testing.assert_allclose(value, expected, atol=TOLERANCE, rtol=TOLERANCE)
            assert expected.std() > 1e-3, "they would not show a difference"


@pytest.mark.parametrize("batch", [1, 3, 64])
def test_any_batch_of_other_inputs_agrees(artifact: Path, run: Run, batch: int) -> None:
    model = load_artifact(str(artifact)).world_model
    inputs = golden_inputs(model, batch, seed=11)
    carry = Carry(inputs["h"], inputs["z"])
    with torch.no_grad():
        value = model.value(carry, inputs["action"])
        seen = model.observe(
            carry,
            inputs["action"],
            inputs["depth"].to(torch.int32),
            inputs["state"],
            inputs["is_first"],
        )
    named = {key: inputs[key] for key in ("h", "z", "action")}
    np.testing.assert_allclose(run("value", **named)[0], value, atol=1e-4)
    for found, expected in zip(run("observe", **inputs), seen, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4, rtol=1e-4)


def test_a_first_tick_heals_a_broken_memory(artifact: Path, run: Run) -> None:
    inputs = golden_inputs(load_artifact(str(artifact)).world_model, 1)
    healthy = run("observe", **inputs)
    broken = inputs | {"h": torch.full_like(inputs["h"], torch.nan)}
    for a, b in zip(run("observe", **broken), healthy, strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_episode_filtered_and_imagined_stays_together(artifact: Path, run: Run) -> None:
    """Errors do not grow with the recurrence."""
    model = load_artifact(str(artifact)).world_model
    carry = model.initial(2)
    memory = {name: np.asarray(part) for name, part in carry._asdict().items()}
    with torch.no_grad():
        for tick in range(20):
            inputs = golden_inputs(model, 2, seed=tick) | {
                "is_first": torch.tensor([tick == 0] * 2)
            }
            depth = inputs["depth"].to(torch.int32)
            carry = model.observe(
                carry, inputs["action"], depth, inputs["state"], inputs["is_first"]
            )
            memory = dict(zip(memory, run("observe", **(inputs | memory)), strict=True))
        carry = model.imagine(carry, inputs["action"])
    for found, expected in zip(
        run("imagine", **memory, action=inputs["action"]), carry, strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-4, rtol=1e-4)


def test_pooling_closes_holes_as_training_does() -> None:
    generator = torch.Generator().manual_seed(0)
    depth = torch.randint(0, 7000, (4, spec.DEPTH_ROWS, spec.DEPTH_COLS), generator=generator)
    depth[torch.rand(depth.shape, generator=generator) < 0.3] = 0
    expected = nearness(depth.int(), 5.0)
    torch.testing.assert_close(pooled_nearness(depth.float(), 5.0), expected, atol=1e-6, rtol=0)


def test_the_description_fits_the_files(exported: Path, artifact: Path) -> None:
    assert {path.name for path in exported.iterdir()} == FILES
    report = json.loads((exported / REPORT).read_text())
    assert report["controller_id"] == "s-1"
    assert report["min_return"] == -9.0
    assert report["features"] == load_artifact(str(artifact)).manifest["features"]
    for name, entry in report["networks"].items():
        path = exported / entry["file"]
        assert entry["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
        graph = onnx.load(path).graph
        for side, there in (("inputs", graph.input), ("outputs", graph.output)):
            shapes = {
                v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim]
                for v in there
            }
            assert shapes == {key: value["shape"] for key, value in entry[side].items()}, name


def test_the_preset_paper_is_exported_too(tmp_path: Path) -> None:
    """Its Q is a number, not a distribution over bins."""
    torch.manual_seed(0)
    config = PRESETS["paper"]
    small = type(config)(**{**vars(config), "hidden": 16, "latent": 4, "units": 16})
    save_artifact(
        tmp_path / "policy", _lively(WorldModel(small)), PlannerConfig(), {"controller_id": "s-1"}
    )
    argv = [f"--policy.path={tmp_path / 'policy'}", f"--output_dir={tmp_path / 'onnx'}"]
    assert main(argv) == 0
    assert max(verify(tmp_path / "onnx").values()) <= TOLERANCE


# --- refusals ---------------------------------------------------------------------------
def test_a_network_that_says_something_else_is_refused(exported: Path, tmp_path: Path) -> None:
    for path in exported.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    golden = load_file(tmp_path / GOLDEN)
    golden["outputs/value/value"][3] += 1e-2
    save_file(golden, tmp_path / GOLDEN)
    with pytest.raises(ArtifactError, match=r"value\.onnx differs from the original by"):
        verify(tmp_path)


def test_a_failed_export_leaves_nothing(
    artifact: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(module, "TOLERANCE", 0.0)
    assert main([f"--policy.path={artifact}", f"--output_dir={tmp_path / 'onnx'}"]) == 4
    assert "the export is wrong" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        ([], 2, "--policy.path and --output_dir are needed"),
        (["--policy.path=absent"], 2, "--policy.path and --output_dir are needed"),
        (["--policy.path=absent", "--output_dir=new"], 4, "no such folder: 'absent'"),
        (["--policy.path=absent", "--output_dir=."], 2, "exists and is not empty"),
    ],
)
def test_misuse_is_explained(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flags: list[str],
    code: int,
    message: str,
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    assert main(flags) == code
    assert message in capsys.readouterr().err


def test_without_the_packages_it_says_what_to_install(
    artifact: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "onnx")
    assert main([f"--policy.path={artifact}", f"--output_dir={tmp_path / 'onnx'}"]) == 5
    assert "egovcp-export needs onnx, which is not installed" in capsys.readouterr().err
    assert not list(tmp_path.glob("*onnx*"))


# --- options ----------------------------------------------------------------------------
def test_a_reward_is_exported(tmp_path: Path) -> None:
    config = PRESETS["debug"]
    loss = dataclasses.replace(config.loss, reward=1.0)
    config = dataclasses.replace(config, loss=loss)
    torch.manual_seed(0)
    model = _lively(WorldModel(config))
    save_artifact(tmp_path / "policy", model, PlannerConfig(), {"controller_id": "s-1"})
    argv = [f"--policy.path={tmp_path / 'policy'}", f"--output_dir={tmp_path / 'onnx'}"]
    assert main(argv) == 0
    errors = verify(tmp_path / "onnx")
    assert errors.keys() == NETWORKS.keys()
    assert json.loads((tmp_path / "onnx" / REPORT).read_text())["networks"].keys() == errors.keys()


def test_a_planner_that_draws_latents_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = WorldModel(PRESETS["debug"])
    provenance = {"controller_id": "s-1"}
    save_artifact(tmp_path / "policy", model, PlannerConfig(latent="sample"), provenance)
    argv = [f"--policy.path={tmp_path / 'policy'}", f"--output_dir={tmp_path / 'onnx'}"]
    assert main(argv) == 4
    assert "latent=mean" in capsys.readouterr().err
    assert not (tmp_path / "onnx").exists()
