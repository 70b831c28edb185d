"""The scripts in examples/ run, at a reduced size."""

import dataclasses
import importlib
import json
import runpy
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp.checks import ConformanceError, check_robot, check_task
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.log.mcap_reader import read_recording
from egovcp.model import WorldModel
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import resolve_config
from egovcp.sim.tasks import register_task, registry
from egovcp.sim.tasks.registry import select_tasks
from egovcp_collect.collect import main as collect_main
from egovcp_deploy.deploy import main as deploy_main
from egovcp_deploy.evaluate import main as eval_main
from egovcp_train.train import main as train_main
from tests.support.plugins import install

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
_ARM = EXAMPLES / "robots" / "arm"
_SHORT = """
from arm_task import ReachTask
from egovcp.sim.tasks import EpisodeConfig

class ShortTask(ReachTask):
    name = "short"
    episode = EpisodeConfig(ticks=24, event_ticks=(0, 2), empty_probability=0.0)
    short_episode = episode
"""
_SMALL = ["--preset=debug", "--steps=2", "--batch_size=2", "--eval_freq=0", "--threads=1"]


def test_examples_train_a_policy_and_imagine_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quickstart = runpy.run_path(str(EXAMPLES / "quickstart.py"))
    rate = quickstart["run"](tmp_path, episodes=2, scenarios=1, options=_SMALL)
    assert 0.0 <= rate <= 1.0
    capsys.readouterr()

    imagine = runpy.run_path(str(EXAMPLES / "imagine.py"))
    policy = tmp_path / "policy/checkpoints/last/pretrained_model"
    imagine["main"](str(policy), str(tmp_path / "dataset"))
    assert capsys.readouterr().out.count("Q = ") == 2
    empty = torch.zeros(1, 48, 64), torch.zeros(1, 74)
    monkeypatch.setattr(WorldModel, "decode", lambda self, carry: empty)
    imagine["main"](str(policy), str(tmp_path / "dataset"))
    assert capsys.readouterr().out.count("nothing in range") == 2
    monkeypatch.setattr("sys.argv", ["imagine.py", str(policy)])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(EXAMPLES / "imagine.py"), run_name="__main__")


@pytest.mark.parametrize("task", ["bag", "table"])
def test_example_tasks_conform_and_their_oracles_succeed(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = EXAMPLES / "tasks" / task
    source = (folder / f"{task}_task.py").read_text()
    assert len(source.splitlines()) <= 150
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    (entry,) = project["entry-points"]["egovcp.tasks"].items()
    install(tmp_path, task, source, " = ".join(entry), monkeypatch)
    report = check_task(task, episodes=1)
    assert report.success_rate["oracle"] == 1.0
    assert report.success_rate["hold"] == 0.0


def test_another_robot_conforms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(_ARM))
    report = check_robot("arm_robot:PlanarArm")
    assert (report.robot_type, report.valid_depth) == ("planar_arm", 1.0)
    arm = importlib.import_module("arm_robot").PlanarArm
    signs = (*[-1.0] * 9, -1.0, -1.0, 1.0)  # x of the tip does not change its sign
    mirror = dataclasses.replace(arm.spec.mirror, state_sign=signs)
    wrong = dataclasses.replace(arm.spec, mirror=mirror)
    with pytest.raises(ConformanceError, match=r"tip\.x differs"):
        check_robot(type("Wrong", (arm,), {"spec": wrong}))
    lagging = type("Lagging", (arm,), {"reset": lambda self, rng: None})
    with pytest.raises(ConformanceError, match="differs in a second run"):
        check_robot(lagging)
    models: list[object] = []
    forward = {"forward": lambda self: models.append(self.model) or arm.forward(self)}
    check_robot(type("Seen", (arm,), forward))
    assert len(set(map(id, models))) == 3, "each robot has its own model"
    with pytest.raises(ConformanceError, match="robot Nameless: it has no spec; describe"):
        check_robot(type("Nameless", (arm,), {"spec": None}))
    singular = {"__module__": __name__, "depth": lambda self: np.linalg.inv(np.zeros((2, 2)))}
    with pytest.raises(ConformanceError, match=r"Broken: LinAlgError in test_examples\.py, line "):
        check_robot(type("Broken", (arm,), singular))
    with pytest.raises(UsageError, match=r"expected package\.module:Class"):
        check_robot("arm_robot:Nothing")
    with pytest.raises(EnvironmentFailure, match=r"no camera 'front' \(found: depth\)"):
        type("Blind", (arm,), {"camera": "front"})(arm.build().compile())


def test_an_error_of_the_check_is_not_the_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(_ARM))
    monkeypatch.setattr("egovcp.checks.robot.copy", lambda model: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        check_robot("arm_robot:PlanarArm")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("spec = wrong", r"robot Arm: tip\.x differs"),
        ("state = broken", "Arm: OSError in other_task.py, line .*: encoder"),
    ],
)
def test_a_check_of_a_task_checks_its_robot(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    body: str,
    message: str,
) -> None:
    source = f"""
from dataclasses import replace
from arm_task import PlanarArm, ReachTask

signs = (*[-1.0] * 9, -1.0, -1.0, 1.0)
wrong = replace(PlanarArm.spec, mirror=replace(PlanarArm.spec.mirror, state_sign=signs))

def broken(self):
    raise OSError("encoder offline")

class Arm(PlanarArm):
    {body}

class OtherTask(ReachTask):
    name = "other_reach"
    robot_class = Arm
"""
    monkeypatch.syspath_prepend(str(_ARM))
    install(tmp_path, "other", source, "other_reach = other_task:OtherTask", monkeypatch)
    with pytest.raises(ConformanceError, match=message):
        check_task("other_reach")


def test_constant_actions_of_another_robot_exclude_the_neutral_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(_ARM))
    actions = importlib.import_module("arm_task").ReachTask.constant_actions()
    assert len(set(actions)) == len(actions) == 3**3 - 1
    assert all(any(action) for action in actions)


@pytest.mark.parametrize("damped", [False, True])
def test_a_damped_robot_no_longer_follows(damped: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(_ARM))
    arm = importlib.import_module("arm_robot").PlanarArm
    robot = arm(arm.build().compile())
    if damped:
        robot.damp()
    robot.command(np.full(3, 0.5))
    for _ in range(100):
        robot.step()
    assert (np.abs(robot.data.qpos).max() < 1e-6) == damped


def test_the_commands_serve_another_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(_ARM))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("EGOVCP_TASKS", "")
    (tmp_path / "short_task.py").write_text(_SHORT)
    task = register_task("short_task:ShortTask")
    try:
        report = check_task(task, episodes=1)
        assert (report.success_rate["oracle"], report.success_rate["hold"]) == (1.0, 0.0)
        with pytest.raises(UsageError, match="is of robot planar_arm"):
            resolve_config(EnvConfig(), ("ball", task))
        assert task not in select_tasks("all")
        _play_through(tmp_path, task)
    finally:
        registry._found = [e for e in registry._found or [] if e.name != task]
    out = capsys.readouterr().out
    assert "planner" in out
    assert "rollout 0" in out


def _play_through(tmp_path: Path, task: str) -> None:
    """Collect, train, evaluate, deploy and replay at a small size."""
    data, run = f"--dataset.root={tmp_path / 'data'}", tmp_path / "run"
    collect = [f"--task={task}", "--episodes=6", "--num_workers=1", "--num_envs=3"]
    assert collect_main([data, *collect]) == 0
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    assert (info["fps"], info["robot"]["depth"]) == (20, [32, 32])
    small = [*_SMALL, "--sampling.length=8", "--returns.steps=5", "--eval_closed_loop=1"]
    assert train_main([data, f"--output_dir={run}", *small]) == 0
    policy = f"--policy.path={run / 'checkpoints/last/pretrained_model'}"
    play = [policy, f"--task={task}", "--episodes=1"]
    shown = ["--controllers=planner,random", "--num_workers=1", "--videos=1"]
    assert eval_main([*play, *shown, f"--output_dir={tmp_path / 'eval'}"]) == 0
    assert set(json.loads((tmp_path / "eval/eval.json").read_text())[task]) == {"planner", "random"}
    deployed = tmp_path / "deploy"
    assert deploy_main([*play, f"--output_dir={deployed}"]) == 0
    assert (deployed / "rollout-0.rrd").is_file()
    recording = read_recording(deployed / "rollout-0.mcap")
    assert (recording.info.robot.robot_type, recording.info.fps) == ("planar_arm", 20)
    first = recording.ticks[0]
    assert (len(recording.ticks), first.time_ns) == (24, 0)
    assert recording.ticks[1].time_ns == 50_000_000
    assert (first.depth.shape, first.action_sent.shape) == ((32, 32), (3,))
    assert first.plan is not None
    assert first.plan.shape[1] == 3
    assert first.depth_imagined is not None
    assert first.depth_imagined.shape[1:] == (32, 32)
    again = [policy, "--robot.type=replay", f"--robot.recordings={deployed}", "--episodes=1"]
    assert deploy_main([*again, f"--output_dir={tmp_path / 'replay'}"]) == 0
