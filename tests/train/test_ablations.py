"""benchmarks/ablations.py: cells run once, are kept, and become a table."""

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

type Ablate = Callable[..., int]

FLAGS = {
    "preset": "debug",
    "batch_size": 2,
    "sampling.length": 6,
    "returns.steps": 5,
    "value_fit.steps": 2,
    "value_fit.rows": 16,
    "planner.samples": 16,
    "planner.elites": 4,
    "tensorboard": "false",
    "threads": 1,
    "device": "cpu",
}


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Benchmarks are scripts beside each other, not a package."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("ablations")


@pytest.fixture
def ablate(module: ModuleType, dataset_root: Path, tmp_path: Path) -> Ablate:
    """Run cells of two steps; returns the exit code."""

    def run(cells: str, *flags: str, steps: int = 2, call: object = None) -> int:
        extra = [f"--{name}={value}" for name, value in FLAGS.items()]
        argv = ["--root", str(dataset_root), "--output", str(tmp_path / "out"), "--cells", cells]
        argv += ["--steps", str(steps), *flags, "--", *extra]
        code: int = module.main(argv, call or module.in_this_process)
        return code

    return run


def _refuse(module: str, argv: list[str]) -> int:
    raise AssertionError(f"{module} {argv}: this cell was complete")


def test_cells_are_trained_once_and_become_a_table(ablate: Ablate, tmp_path: Path) -> None:
    cells = "default,two_hot,per_task_returns"
    assert ablate(cells) == 0
    out = tmp_path / "out"
    results = json.loads((out / "ablations.json").read_text())["results"]
    assert [result["cell"] for result in results] == cells.split(",")
    for result in results:
        assert result["tasks"]["ball"]["value"]["rows"] > 0
    run = out / "runs" / "two_hot-0" / "checkpoints" / "last" / "pretrained_model"
    config = json.loads((run / "config.json").read_text())
    assert config["world_model"]["value_loss"] == "two_hot"
    table = (out / "ablations.md").read_text()
    assert "| two_hot | `policy.value_loss=two_hot` |" in table
    assert len({line.count("|") for line in table.splitlines() if line.startswith("|")}) == 1
    assert ablate(cells, call=_refuse) == 0
    assert (out / "ablations.md").read_text() == table


def test_a_cell_that_fails_does_not_spoil_those_that_are_done(
    ablate: Ablate, module: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(name: str, argv: list[str]) -> int:
        last = argv[-1]
        return 3 if "kl_posterior" in last else module.in_this_process(name, argv)

    assert ablate("default,kl_equal", call=failing) == 5
    assert "cell kl_equal, seed 0" in capsys.readouterr().err
    assert (tmp_path / "out" / "default-0.json").exists()
    assert not (tmp_path / "out" / "kl_equal-0.json").exists()
    assert ablate("default,kl_equal") == 0


def test_results_of_other_settings_are_not_mixed(
    ablate: Ablate, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ablate("default") == 0
    assert ablate("default", steps=3, call=_refuse) == 2
    assert "name another --output" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--cells", "defualt", "--root", "x"], "did you mean 'default'"),
        ([], "--root is missing"),
        (["--set", "planner"], "--policy is missing"),
    ],
)
def test_misuse_is_explained(
    module: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flags: list[str],
    message: str,
) -> None:
    assert module.main(["--output", str(tmp_path / "out"), *flags], _refuse) == 2
    assert message in capsys.readouterr().err


def test_planner_cells_change_how_one_artefact_is_used(module: ModuleType, tmp_path: Path) -> None:
    asked: list[list[str]] = []

    def play(name: str, argv: list[str]) -> int:
        assert name == "egovcp_deploy.evaluate"
        asked.append(argv)
        folder = Path(next(a.partition("=")[2] for a in argv if a.startswith("--output_dir=")))
        folder.mkdir()
        figures = {
            "success_rate": 0.5,
            "success_ci95": [0.4, 0.6],
            "reward_mean": -1.0,
            "plan_ms_p50": 30.0,
        }
        (folder / "eval.json").write_text(json.dumps({"ball": {"planner": figures}}))
        return 0

    argv = ["--set", "planner", "--policy", "me/ball", "--output", str(tmp_path / "out")]
    assert module.main(argv, play) == 0
    changes = [flags[-1] for flags in asked]
    assert "--planner.latent=sample" in changes
    assert "--planner.termination_rule=survival" in changes
    assert all("--policy.path=me/ball" in flags for flags in asked)
    assert (
        "| ensemble_min | `planner.ensemble=min` | 0.5 |"
        in (tmp_path / "out" / "ablations.md").read_text()
    )


def test_every_flag_of_a_cell_is_one_that_the_command_takes(module: ModuleType) -> None:
    from egovcp.cli import parse_config
    from egovcp_deploy.evaluate import EvalConfig
    from egovcp_train.config import TrainConfig
    from egovcp_train.train import option_defaults

    for flags in module.SETS["training"].values():
        parse_config(TrainConfig, ["--output_dir=x", *flags], "train", "", option_defaults)
    for flags in module.SETS["planner"].values():
        parse_config(EvalConfig, list(flags), "eval")
