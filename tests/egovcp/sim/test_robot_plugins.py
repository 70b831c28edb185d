"""Tasks of other packages for other robots than the G1."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp.errors import UsageError
from egovcp.sim.config import EnvConfig
from egovcp.sim.robot_env import controller_id_of, make_env
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks import register_task
from tests.support.plugins import SOURCE, install


def test_a_task_of_another_robot_needs_its_class(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = """
from egovcp.sim.tasks import MujocoRobot, RobotTask

class Robot(MujocoRobot):
    control_id = "x"

class Reach(RobotTask):
    name, description, terms = "reach", "reach", {}
    robot_class = Robot
    def add_objects(spec): ...
    place = rewards = object_w = achieved = None

class Nobody(Reach):
    name = "nobody"
    robot_class = None

class Text(Reach):
    name = "text"
    robot_class = "robot"
"""
    (tmp_path / "robot_tasks.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UsageError, match=r"lacks robot_class\.build, .*\.state, .*\.spec"):
        register_task("robot_tasks:Reach")
    with pytest.raises(UsageError, match="lacks robot_class;"):
        register_task("robot_tasks:Nobody")
    with pytest.raises(UsageError, match="robot_class is 'robot', expected a subclass of MujocoR"):
        register_task("robot_tasks:Text")


def test_a_task_of_another_robot_must_be_a_robot_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = """
from dataclasses import replace
from egovcp.robot_spec import G1
from post_task import PostTask

class ArmTask(PostTask):
    name = "arm"
    @classmethod
    def robot_spec(cls):
        return replace(G1, robot_type="arm")
"""
    (tmp_path / "post_task.py").write_text(SOURCE)
    (tmp_path / "arm_tasks.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UsageError, match="its robot is not the G1; derive it from"):
        register_task("arm_tasks:ArmTask")


def test_robots_of_equal_specification_and_other_classes_are_not_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their low-level control differs."""
    source = """
from arm_task import PlanarArm, ReachTask

class OtherArm(PlanarArm):
    control_id = "other"

class OtherTask(ReachTask):
    name = "other_reach"
    robot_class = OtherArm
"""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "examples" / "robots" / "arm"))
    install(tmp_path, "other", source, "other_reach = other_task:OtherTask", monkeypatch)
    register_task("arm_task:ReachTask")
    tasks = ("arm_reach", "other_reach")
    config = EnvConfig()
    message = "task other_reach is of robot class OtherArm, expected one of robot class PlanarArm"
    with pytest.raises(UsageError, match=message):
        controller_id_of(config, tasks)
    env = make_env(config, 2, tasks[:1])
    with pytest.raises(UsageError, match=message):
        env.reset([Scenario(task, 0, 0) for task in tasks])
