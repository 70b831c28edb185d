"""Several tasks in one episode: each as it is alone, one after the other, one object at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.sim.base_env import StepResult
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import EnvPolicy, Hold, Oracle
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import HEAD
from egovcp.sim.tasks.arch import ArchTask
from egovcp.sim.tasks.ball import BallConfig, BallTask
from egovcp.sim.tasks.sequence import SequenceConfig, SequenceTask
from egovcp.spec import ACTION_DIM

HOLD = np.zeros((1, ACTION_DIM))


@pytest.fixture(scope="module")
def sequences(config: EnvConfig) -> EnvConfig:
    """An arch, half a second later a box."""
    parts = SequenceConfig(("arch", "ball"), pause_ticks=12)
    return replace(config, ball=BallConfig(shape="box"), sequence=parts)


def begun(config: EnvConfig) -> tuple[VectorEnv, SequenceTask]:
    env = VectorEnv(config, 1, render_depth=False)
    env.reset([Scenario("sequence", 0, 0)])
    task = env.instances[0].task
    assert isinstance(task, SequenceTask)
    return env, task


def play(config: EnvConfig, policy: EnvPolicy, rows: int = 4) -> StepResult:
    env = VectorEnv(config, rows, render_depth=False)
    scenarios = [Scenario("sequence", 0, i) for i in range(rows)]
    env.reset(scenarios)
    policy.reset(env, scenarios)
    while not env.done.all():
        result = env.step(policy.act(env))
    return result


def test_the_oracle_achieves_all_parts_and_hold_does_not(sequences: EnvConfig) -> None:
    solved, held = play(sequences, Oracle()), play(sequences, Hold())
    assert solved.success.mean() >= 0.75
    assert not held.success.any()
    for result in (solved, held):
        assert [set(parts) for parts in result.parts] == [{"arch", "ball"}] * 4
        assert result.success.tolist() == [all(parts.values()) for parts in result.parts]


@pytest.mark.slow
def test_the_oracle_achieves_three_parts(sequences: EnvConfig) -> None:
    three = replace(sequences, sequence=SequenceConfig(("arch", "ball", "wall"), pause_ticks=12))
    result = play(three, Oracle())
    assert list(result.parts[0]) == ["arch", "ball", "wall"]
    for part in result.parts[0]:
        assert np.mean([parts[part] for parts in result.parts]) >= 0.75, part


def test_a_throw_comes_after_the_pause_that_follows_the_arch(sequences: EnvConfig) -> None:
    env, task = begun(sequences)
    oracle, seen = Oracle(), []
    while not env.done[0]:
        action = oracle.act(env)
        terms = env.step(action).reward_terms
        seen.append((task.current_name, terms["pass"][0], task.solids()))
    passed = [t for t, (_, passes, _) in enumerate(seen) if passes]
    first = next(t for t, (name, _, _) in enumerate(seen) if name == "ball")
    assert first == passed[0] + 12 + 1
    names = [tuple(solid.name for solid in solids) for _, _, solids in seen]
    assert all("arch_lintel" in there for there in names[:first])
    event = round(env.parameters[0]["ball.event_tick"])
    assert names[first : first + event] == [()] * event
    assert names[first + event] == ("ball",)


def test_only_the_present_object_is_near(sequences: EnvConfig) -> None:
    env, task = begun(sequences)

    def away() -> dict[str, bool]:
        data, model = env.instances[0].robot.data, env.instances[0].robot.model
        return {
            name: bool(np.linalg.norm(data.xpos[model.body(name).id]) > 10)
            for name in ("arch", "wall", "ball")
        }

    env.step(HOLD)
    assert away() == {"arch": False, "wall": True, "ball": True}
    oracle = Oracle()
    while task.current_name == "arch" or task.since_event < 0.2:
        env.step(oracle.act(env))
    assert away() == {"arch": True, "wall": True, "ball": False}


def test_a_part_has_the_parameters_of_its_own_scenario(sequences: EnvConfig) -> None:
    env, _ = begun(sequences)
    drawn = env.parameters[0]
    for task in ("arch", "ball"):
        alone = VectorEnv(sequences, 1, render_depth=False)
        alone.reset([Scenario(task, 0, 0)])
        own = alone.instances[0].task.parameters | {
            "event_tick": alone.instances[0].task.event_tick
        }
        assert {f"{task}.{name}": value for name, value in own.items()}.items() <= drawn.items()


def test_the_throw_is_aimed_at_the_robot_wherever_it_stands_by_then(sequences: EnvConfig) -> None:
    middle = BallConfig(aim_lateral_range=(0.0, 0.0), aim_height_range=(0.3, 0.3))
    env, task = begun(replace(sequences, ball=middle))
    oracle = Oracle()
    while task.current_name == "arch":
        env.step(oracle.act(env))
    env.instances[0].robot.data.qpos[0] += 1.5
    hits = 0.0
    for _ in range(40):
        hits += env.step(HOLD).reward_terms["hit"][0]
    assert hits < 0


def test_an_unfinished_part_lasts_as_long_as_its_own_episodes(
    sequences: EnvConfig,
) -> None:
    never = EpisodeConfig(ticks=9, event_ticks=(3, 3), empty_probability=1.0)
    env, task = begun(replace(sequences, arch_episode=never))
    names = []
    for _ in range(11):
        env.step(HOLD)
        names.append(task.current_name)
    assert names == ["arch"] * 9 + ["ball"] * 2
    assert task.parts == {"arch": True, "ball": False}
    assert task.ticks_limit == 9 + sequences.ball_episode.ticks


def test_the_last_part_ends_as_the_others_do(sequences: EnvConfig) -> None:
    long = replace(sequences.ball_episode, ticks=300)
    env, task = begun(replace(sequences, ball_episode=long))
    oracle, present, settled = Oracle(), [], []
    while not env.done[0]:
        env.step(oracle.act(env))
        present.append(task.current_name)
        settled.append(task._part.finished)
    assert env.instances[0].truncated
    assert sum(settled[present.index("ball") :]) == 12 + 1
    assert len(present) < task.ticks_limit

    walls = replace(sequences, sequence=SequenceConfig(("ball", "wall"), pause_ticks=12))
    env, task = begun(replace(walls, wall_episode=EpisodeConfig(ticks=9, event_ticks=(8, 8))))
    names = []
    while not env.done[0]:
        env.step(HOLD)
        names.append(task.current_name)
    assert names.count("wall") == 9


def test_what_has_not_begun_is_not_won(sequences: EnvConfig) -> None:
    """A wall that is not placed yet and so untouched."""
    env, task = begun(replace(sequences, sequence=SequenceConfig(("ball", "wall"))))
    env.step(HOLD)
    assert task.parts == {"ball": False, "wall": False}
    assert not task.success


def test_a_fall_is_held_against_the_part_it_ends(sequences: EnvConfig) -> None:
    env, task = begun(replace(sequences, sequence=SequenceConfig(("arch", "ball"), pause_ticks=0)))
    oracle = Oracle()
    while task.current_name == "arch":
        env.step(oracle.act(env))
    ball = task._part
    assert isinstance(ball, BallTask)
    ball._blocked_at = 0.0
    assert task.parts == {"arch": True, "ball": True}
    env.instances[0].robot.data.qvel[0] = 4.0
    while not env.done[0]:
        result = env.step(HOLD)
    assert result.terminated[0]
    assert result.parts[0] == {"arch": True, "ball": False}
    assert not result.success[0]


def test_rewards_and_contacts_are_those_of_the_present_part(sequences: EnvConfig) -> None:
    near = replace(sequences.arch, distance_range=(0.5, 0.6))
    env, task = begun(replace(sequences, arch=near))
    hit = np.zeros(1)
    while not hit.any():
        result = env.step(HOLD)
        hit = result.reward_terms["hit"]
    assert env.instances[0].task.forces[HEAD] > 0
    arch = task._part
    assert isinstance(arch, ArchTask)
    assert not arch.achieved
    assert not task.parts["arch"]
    assert hit[0] == -sequences.arch.hit_cost
    ball = task._parts[1]
    assert isinstance(ball, BallTask)
    assert not ball.hit


def test_the_walking_command_ends_before_the_throw(sequences: EnvConfig) -> None:
    env, task = begun(sequences)
    oracle = Oracle()
    commands: dict[str, list[NDArray[np.float64]]] = {"arch": [], "ball": []}
    while not env.done[0]:
        env.step(oracle.act(env))
        commands[task.current_name].append(task.velocity_command)
    assert np.max(commands["arch"]) == env.parameters[0]["arch.speed"]
    assert not np.any(commands["ball"])


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (("arch", "bal"), "did you mean 'ball'"),
        ((), "at least one task"),
        (("ball", "ball"), "at most once"),
        (("wall", "ball"), "wall only at the end"),
    ],
)
def test_parts_that_cannot_follow_each_other_are_refused(
    parts: tuple[str, ...], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        EnvConfig(sequence=SequenceConfig(parts))


def test_names_are_no_range(config: EnvConfig) -> None:
    """Two parts in descending order of the alphabet are not a range the wrong way round."""
    assert replace(config, sequence=SequenceConfig(("ball", "arch"))).sequence.parts[0] == "ball"


def test_a_pause_is_not_negative() -> None:
    with pytest.raises(UsageError, match="pause_ticks=-1"):
        SequenceConfig(pause_ticks=-1)
