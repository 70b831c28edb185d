"""Tasks of other packages: found, configured, checked, and refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import egovcp.sim.config as sim_config
import egovcp.sim.tasks.registry as registry
from egovcp import packages
from egovcp.checks import ConformanceError, check_task
from egovcp.entry_point import EntryPoint
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.packages import MissingPackage
from egovcp.sim.base_env import Observation
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import Oracle
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import build_scene
from egovcp.sim.tasks import find_task, register_task, task_entries, task_names
from tests.support.plugins import ENTRY, SOURCE, install


@pytest.fixture
def post(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task ``post``, installed."""
    install(tmp_path, "post", SOURCE, ENTRY, monkeypatch)


def changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, entry: str = ENTRY
) -> None:
    assert old in SOURCE
    install(tmp_path, "post", SOURCE.replace(old, new), entry, monkeypatch)


def play(env: VectorEnv) -> None:
    env.reset([Scenario("post", 0, 0)])
    env.step(np.zeros((1, 7)))
    env.known_objects()


@pytest.mark.usefixtures("post")
def test_an_installed_task_is_found_and_has_options() -> None:
    assert task_names() == ("ball", "wall", "arch", "sequence", "post")
    assert task_names(training=True) == ("ball", "wall", "arch", "post")
    assert task_entries()[-1].origin == "egovcp-task-post 1.2"
    config = sim_config.EnvConfig()
    assert config.post.distance_range == (2.0, 3.0)
    assert sim_config.evaluation_config().post_episode.empty_probability == 0.0
    assert registry.select_tasks("wall, post") == ("wall", "post")
    assert registry.select_tasks("all") == task_names(training=True)


@pytest.mark.usefixtures("post")
def test_an_installed_task_plays_beside_the_others() -> None:
    env = VectorEnv(sim_config.evaluation_config(), 2)
    env.reset([Scenario("post", 0, 0), Scenario("ball", 0, 0)])
    result = env.step(np.zeros((2, 7)))
    assert result.reward_terms["touch"].tolist() == [0.25, 0.0]
    (solid,) = env.instances[0].task.solids()
    assert (solid.shape, solid.size) == ("box", (0.1, 0.1, 1.0))
    assert env.known_objects()[0, 0] == pytest.approx(env.parameters[0]["distance"], abs=0.01)
    with pytest.raises(UsageError, match="task post has no oracle"):
        Oracle().reset(env, [Scenario("post", 0, 0)])


@pytest.mark.usefixtures("post")
def test_its_random_streams_depend_on_its_name() -> None:
    streams = {Scenario(task, 3, 5).rng("geometry").integers(10**9) for task in task_names()}
    assert len(streams) == len(task_names())
    assert Scenario("post", 3, 5).rng("geometry").integers(10**6) == 796876


@pytest.mark.usefixtures("post")
def test_a_conforming_task_is_measured() -> None:
    report = check_task("post", episodes=2)
    assert report.success_rate == {"random": 1.0, "hold": 1.0}
    assert report.reward["hold"]["touch"] == 1.5
    assert report.ms_per_step > 0.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'self.sample("distance")',
            'self.sample("distance"); self.parameters["x"] = float(np.random.rand())',
            "task post, episode 0: its parameters differ in a second run; draw them with sample",
        ),
        ('{"touch": 0.25}', '{"touch": 0.25 + np.random.rand()}', "reward differs"),
        ('{"touch": 0.25}', '{"touch": 2000.0}', r"0\.04 s: reward term touch is 2000\.0"),
        (
            "    def rewards(self):",
            "    @property\n    def is_over(self):\n        return True\n\n    def rewards(self):",
            r"0\.04 s: the episode ended after 1 of 6 ticks",
        ),
        (
            "    def rewards(self):",
            "    def has_fallen(self):\n        return True\n\n    def rewards(self):",
            "the episode ended although the robot stands",
        ),
        (
            "self.robot.data.mocap_pos[-1].copy()",
            "np.array([1, np.nan, 0])",
            "position of its object",
        ),
    ],
)
def test_what_does_not_conform_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, message: str
) -> None:
    changed(tmp_path, monkeypatch, old, new)
    with pytest.raises(ConformanceError, match=message):
        check_task("post")


def test_a_failed_check_closes_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[VectorEnv] = []
    monkeypatch.setattr(VectorEnv, "close", lambda env: closed.append(env))
    changed(tmp_path, monkeypatch, '{"touch": 0.25}', '{"touch": 2000.0}')
    with pytest.raises(ConformanceError):
        check_task("post")
    assert len(closed) == 1


def test_a_late_state_that_is_not_finite_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`check_env` plays the first ten ticks only."""
    observe = VectorEnv._observe

    def late_nan(env: VectorEnv) -> Observation:
        observation = observe(env)
        observation.state[[instance.tick >= 12 for instance in env.instances]] = np.nan
        return observation

    monkeypatch.setattr(VectorEnv, "_observe", late_nan)
    changed(tmp_path, monkeypatch, "ticks=6", "ticks=14")
    with pytest.raises(ConformanceError, match=r"episode 0, 0\.48 s: its state is not finite"):
        check_task("post")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '{"touch": 0.25}',
            '{"touch": float("nan")}',
            r"its reward term touch is nan after 0\.04 s",
        ),
        ('{"touch": 0.25}', '{"touch": None}', "its reward term touch is None .* finite number"),
        ('{"touch": 0.25}', '{"touch": np.ones(1)}', r"its reward term touch is \[1\.\] "),
        ('{"touch": 0.25}', "None", "its rewards are None; expected a dict, reward term -> number"),
        ("return True", "pass", "its achieved is None; expected True or False"),
        ('{"touch": 0.25}', "{}", "its rewards are fall, pose, action_rate; expected touch,"),
        ("size=[0.1, 1, 0]", "size=[0, 0, 0]", "its scene does not compile: .*size"),
        (
            "pos=[20, 0, 1])\n",
            "pos=[20, 0, 1]); 1 / 0\n",
            "its scene does not compile: division by zero",
        ),
        ('name="post", mocap', 'name="pelvis", mocap', "its scene does not compile: .*pelvis"),
        (
            "place(self):",
            "place(self):\n        1 / 0",
            r"ZeroDivisionError in post_task\.py, line 3",
        ),
        (
            '{"touch": 0.25}',
            '{"touch": touched}',
            r"NameError in .*: name 'touched' is not defined",
        ),
        ('sample("distance")', 'sample("size")', r"sample\('size'\), but .* has no size_range"),
        ("pos[-1].copy()", "pos[-1][:2]", r"its object_w has shape \(2,\), expected \(3,\)"),
    ],
)
def test_a_defective_task_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, message: str
) -> None:
    changed(tmp_path, monkeypatch, old, new)
    env = VectorEnv(sim_config.EnvConfig(), 1, render_depth=False)
    found = (
        rf"task post \(post_task:PostTask\): {message}.*; repair the class, then run egovcp-task"
    )
    with pytest.raises(EnvironmentFailure, match=found) as caught:
        play(env)
    assert "\n" not in str(caught.value)


def test_of_two_tasks_in_one_scene_the_one_that_does_not_compile_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed(tmp_path, monkeypatch, "size=[0.1, 1, 0]", "size=[0, 0, 0]")
    with pytest.raises(EnvironmentFailure, match=r"task post .*: its scene does not compile"):
        build_scene((find_task("post"), find_task("ball")), "points")


@pytest.mark.parametrize(
    ("old", "new", "entry", "message"),
    [
        (
            "import mujoco,",
            "import moojoco,",
            ENTRY,
            "ModuleNotFoundError: No module named 'moojoco'",
        ),
        ("class PostTask", "raise SystemError\nclass PostTask", ENTRY, "SystemError"),
        ("class PostTask", "class OtherTask", ENTRY, "has no attribute 'PostTask'"),
        (
            'name = "post"',
            'name = "ball"',
            "ball = post_task:PostTask",
            "its name, 'ball', is that of a task of egovcp ",
        ),
        ('name = "post"', 'name = "camera"', "camera = post_task:PostTask", "cannot be the name"),
        ('"touch": "block"', '"success": "block"', ENTRY, "'success' cannot be the name of a"),
        ('"touch": "block"', '"a,b": "block"', ENTRY, "'a,b' cannot be the name of a"),
        ('name = "post"', 'name = "pillar"', ENTRY, "is named 'pillar'; use one name"),
        ("def rewards", "def payment", ENTRY, "the class lacks rewards"),
        (
            '"touch": "block"',
            '"touch": "kick"',
            ENTRY,
            r"terms\['touch'\] is 'kick', expected one of",
        ),
        ("class PostTask(Task)", "class PostTask", ENTRY, "no subclass"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_reported_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    entry: str,
    message: str,
) -> None:
    changed(tmp_path, monkeypatch, old, new, entry)
    name = entry.partition(" ")[0]
    assert task_names() == ("ball", "wall", "arch", "sequence")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: task {name!r} of egovcp-task-post 1.2 cannot be used: ")
    assert line.endswith("; repair or uninstall it")
    if name != "ball":
        with pytest.raises(EnvironmentFailure, match=f"egovcp-task-post 1.2.*{message}"):
            Scenario(name, 0, 0)
    Scenario("ball", 0, 0)


def test_a_task_is_registered_by_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").mkdir()
    install(tmp_path, "post", SOURCE, "", monkeypatch)
    assert "post" not in task_names()
    with pytest.raises(UsageError, match=r"unknown task 'post'.*needs that package"):
        find_task("post")
    with pytest.raises(UsageError, match="give the flag --task=post_task:PostTask"):
        find_task("post_task:PostTask")
    assert register_task("post_task:PostTask") == "post" == register_task("post_task:PostTask")
    assert find_task("post").description == "leave a post alone"
    command = EntryPoint("egovcp-collect", "egovcp_collect.collect")
    arguments = command._with_task(["--task=ball,post_task:PostTask", "--seed=1"])
    assert arguments == ["--task=ball,post", "--seed=1"]
    monkeypatch.setattr(registry, "_found", None)  # as in a child process
    assert find_task("post").name == "post"
    with pytest.raises(UsageError, match=r"task post_task:Nothing .* no attribute .*; correct the"):
        register_task("post_task:Nothing")


@pytest.mark.usefixtures("post")
def test_a_reference_to_the_class_of_an_installed_task_is_that_task() -> None:
    assert register_task("post_task:PostTask") == "post"
    assert len([entry for entry in task_entries() if entry.name == "post"]) == 1


def test_of_two_tasks_in_one_module_the_defective_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = "\n\nclass ATask(PostTask):\n    name = 'a'\n"
    source = SOURCE.replace("place(self):", "place(self):\n        [][self.ticks_limit]") + other
    install(tmp_path, "post", source, f"a = post_task:ATask\n{ENTRY}", monkeypatch)
    env = VectorEnv(sim_config.EnvConfig(), 1, render_depth=False)
    with pytest.raises(EnvironmentFailure, match=r"task post \(post_task:PostTask\): IndexError"):
        env.reset([Scenario("post", 0, 0)])


def test_an_error_of_the_library_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    env = VectorEnv(sim_config.EnvConfig(), 1, render_depth=False)
    monkeypatch.setattr(VectorEnv, "_check", lambda env, scenarios: 1 // 0)
    with pytest.raises(ZeroDivisionError) as caught:
        env.reset([Scenario("ball", 0, 0)])
    assert caught.value.__cause__ is None


@pytest.mark.parametrize("result", ["[0.0] * 6", "[float('nan')] * 7", "1 / 0"])
def test_a_defective_oracle_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, result: str
) -> None:
    oracle = f"    def oracle(self):\n        return {result}\n\n    def rewards"
    changed(tmp_path, monkeypatch, "    def rewards", oracle)
    env = VectorEnv(sim_config.EnvConfig(), 1, render_depth=False)
    env.reset([Scenario("post", 0, 0)])
    found = r"task post \(post_task:PostTask\): (its oracle returns|ZeroDivisionError)"
    with pytest.raises(EnvironmentFailure, match=found):
        Oracle().act(env)


def test_a_reference_without_the_simulator_names_the_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "mujoco")
    monkeypatch.setattr(registry, "is_installed", lambda name: name != "mujoco")
    monkeypatch.setattr(registry, "_found", None)
    with pytest.raises(MissingPackage, match="--task=post_task:PostTask needs mujoco"):
        register_task("post_task:PostTask")


@pytest.mark.usefixtures("post")
def test_further_samples_continue_the_random_stream() -> None:
    env = VectorEnv(sim_config.EnvConfig(), 1)
    env.reset([Scenario("post", 0, 0)])
    first = env.parameters[0]["distance"]
    assert env.instances[0].task.sample("distance")["distance"] != first


def test_objects_with_names_like_parts_of_the_robot_are_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed(
        tmp_path, monkeypatch, 'body.add_geom(name="post"', 'body.add_geom(name="a_foot_collision"'
    )
    index = build_scene((find_task("post"),), "points").index
    (post,) = index.objects["post"]
    assert index.part[post] == -1
    assert post not in index.foot_geoms
