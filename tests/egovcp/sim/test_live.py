"""The robot under motor commands: the same physics as in `VectorEnv`, driven from outside."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.robot.geometry import rotate, rotation_matrix
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.live import LiveRobot, Measurement, Phase, ServoCommand
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_BOX, ACTION_TERMS, COMMAND_SLICE, STATE_DIM, STATE_SLICES

NEUTRAL = np.concatenate([np.zeros(3), ACTION_BOX.neutral])
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def live(config: EnvConfig) -> LiveRobot:
    return LiveRobot(config)


class Loop:
    """The low-level controller at 50 Hz on what the live robot measures."""

    def __init__(self, live: LiveRobot) -> None:
        self.live = live
        self.controller = make_controller(live.config.controller)
        self.controller.reset(self.state(live.measure())[None])

    def state(self, seen: Measurement) -> NDArray[np.float64]:
        state = np.empty(STATE_DIM)
        state[STATE_SLICES["angular_velocity"]] = seen.angular_velocity
        state[STATE_SLICES["projected_gravity"]] = rotate(
            rotation_matrix(seen.quaternion_w).T, DOWN
        )
        state[STATE_SLICES["joint_position"]] = seen.joint_position
        state[STATE_SLICES["joint_velocity"]] = seen.joint_velocity
        state[COMMAND_SLICE] = NEUTRAL
        return state

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 50)):
            target = self.controller.step(self.state(self.live.measure())[None])[0]
            self.live.drive(ServoCommand(target, STIFFNESS, DAMPING))
            self.live.advance(4)


@pytest.mark.parametrize(
    "task",
    ["ball", "sequence", *(pytest.param(t, marks=pytest.mark.slow) for t in ("wall", "arch"))],
)
def test_it_is_the_episode_of_the_environment(
    live: LiveRobot, config: EnvConfig, task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = Scenario(task, 3, 1)
    env = VectorEnv(config, 1, render_depth=False)
    env.reset([scenario])
    live.start(scenario)
    live.begin()
    step, total = env.controller.step, 0.0

    def follow(state: NDArray[np.floating]) -> NDArray[np.float64]:
        target = step(state)
        live.drive(ServoCommand(target[0], STIFFNESS, DAMPING))
        live.advance(4)
        return target

    monkeypatch.setattr(env.controller, "step", follow)
    names: set[str] = set()
    while not env.done[0]:
        result = env.step(np.zeros((1, 7)))
        terms = {k: v[0] for k, v in result.reward_terms.items() if k not in ACTION_TERMS}
        total += sum(terms.values())
        names |= set(terms)
        np.testing.assert_allclose(
            live.robot.data.qpos, env.instances[0].robot.data.qpos, atol=1e-6, rtol=0
        )
    assert live.phase is Phase.OVER
    assert live.outcome.ticks == env.tick[0]
    assert live.outcome.success == result.success[0]
    assert live.outcome.fallen == result.terminated[0]
    assert sum(live.outcome.reward_terms[name] for name in names) == pytest.approx(total, abs=1e-5)


def test_the_controller_takes_it_from_the_gantry_and_stands(live: LiveRobot) -> None:
    live.start(Scenario("ball", 0, 0))
    assert live.phase is Phase.HELD
    loop = Loop(live)
    loop.run(1.0)
    live.release()
    loop.run(2.0)
    assert live.phase is Phase.FREE
    assert live.robot.pelvis_height > 0.7
    live.begin()
    loop.run(0.5)
    assert live.phase is Phase.EPISODE
    assert live.outcome.ticks == 12


def test_without_commands_the_gantry_holds_it_and_then_it_falls(live: LiveRobot) -> None:
    live.start(Scenario("wall", 0, 0))
    live.advance(200)
    assert live.robot.pelvis_height > 0.7
    live.release()
    live.advance(600)
    assert live.phase is Phase.OVER
    assert live.outcome.fallen
    assert not live.outcome.success


def test_the_same_commands_give_the_same_bits(live: LiveRobot) -> None:
    def play() -> list[NDArray[np.float64]]:
        live.start(Scenario("ball", 5, 2))
        loop = Loop(live)
        loop.run(0.2)
        live.release()
        live.begin()
        loop.run(0.4)
        seen = live.measure()
        return [*vars(seen).values(), live.depth_image[1], live.robot.data.qpos.copy()]

    for a, b in zip(play(), play(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_quaternion_carries_the_noise_of_gravity(live: LiveRobot) -> None:
    live.start(Scenario("ball", 1, 0))
    std = live.config.sensors.gravity
    true = live.robot.rotation.T @ DOWN
    off = []
    for _ in range(500):
        seen = live.measure()
        gravity = rotation_matrix(seen.quaternion_w).T @ DOWN
        np.testing.assert_allclose(-seen.acceleration / 9.81, gravity, atol=20 * std**2)
        off.append(gravity - true)
    assert 0.8 * std < np.std(off, axis=0)[:2].mean() < 1.2 * std


def test_motors_apply_commanded_torque_up_to_their_limit(live: LiveRobot) -> None:
    live.start(Scenario("ball", 0, 0))
    zero = np.zeros(29)
    live.drive(ServoCommand(zero, zero, zero, torque=np.linspace(-4.0, 4.0, 29)))
    live.advance()
    np.testing.assert_allclose(live.measure().torque, np.linspace(-4.0, 4.0, 29))
    live.drive(ServoCommand(zero, zero, zero, torque=np.full(29, 900.0)))
    live.advance()
    limit = live.robot.model.actuator_forcerange[:, 1]
    np.testing.assert_array_equal(live.measure().torque, limit)


def test_depth_images_are_delayed(live: LiveRobot) -> None:
    live.start(Scenario("arch", 2, 0))
    live.release()
    taken = []
    for _ in range(60):
        live.advance()
        taken.append(live.steps - live.depth_image[0])
    late = 4 * max(0, live.instance.image_age - 1)
    assert min(taken[20:]) == late
    assert max(taken[20:]) == late + 5
