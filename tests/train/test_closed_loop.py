"""Playing in simulation at evaluations."""

import sys
from pathlib import Path

import pytest

from egovcp.artifact import load_artifact
from egovcp.errors import UsageError
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model
from egovcp_train.closed_loop import ClosedLoop
from egovcp_train.train import main
from tests.support.arguments import Arguments

PLANNER = PlannerConfig(samples=8, elites=2, iterations=1)


def test_the_same_scenarios_are_played_each_time() -> None:
    pytest.importorskip("mujoco")
    from egovcp.robot.controllers import make_controller

    controller = make_controller("stance").id
    one, two = (ClosedLoop(["ball"], 2, 0, controller).play(toy_model(), PLANNER) for _ in range(2))
    assert one == two
    assert one.keys() == {"ball/return", "ball/success"}
    assert 0.0 <= one["ball/success"] <= 1.0


def test_a_run_records_what_it_played(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Played(ClosedLoop):
        def __init__(self, *given: object) -> None:
            assert given == (["ball"], 3, 0, "stance-test")

        def play(self, *given: object) -> dict[str, float]:
            return {"ball/return": 1.5, "ball/success": 0.5}

    monkeypatch.setattr("egovcp_train.train.ClosedLoop", Played)
    argv = arguments(tmp_path / "run", eval_closed_loop=3, steps=1, tensorboard="true")
    assert main(argv) == 0
    folder = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    found = load_artifact(str(folder)).manifest["closed_loop"]
    assert found == {"ball/return": 1.5, "ball/success": 0.5}
    (events,) = (tmp_path / "run" / "tensorboard").iterdir()
    assert b"closed_loop/ball/return" in events.read_bytes()


def test_a_controller_that_is_not_shipped_is_named() -> None:
    with pytest.raises(UsageError, match=r"--eval_closed_loop: .* 'walker-7'"):
        ClosedLoop(["ball"], 1, 0, "walker-7")


@pytest.mark.parametrize("package", ["mujoco", "mjlab"])
def test_without_the_simulator_it_is_refused_before_training(
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    package: str,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert main(arguments(tmp_path / "run", eval_closed_loop=1)) == 5
    assert f"--eval_closed_loop needs {package}, which is not installed" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
