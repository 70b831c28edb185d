"""Conformance check of a robot of another kind than the G1: shapes, limits, repeats, symmetry."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import ConformanceError, EgovcpError, UsageError
from egovcp.packages import import_class
from egovcp.robot_spec import RobotSpec
from egovcp.spec import ACTION_RATE_LIMIT

if TYPE_CHECKING:
    from egovcp.sim.mujoco_robot import MujocoRobot

_TICKS: Final = 40  # of each run
_NEEDED: Final = {"spec": "describe the robot", "control_id": "name its control and model"}
_MOST_ASYMMETRY: Final = 0.25  # in standard deviations of a value, beside twice the noise

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class RobotReport:
    """What `check_robot` measured."""

    robot_type: str
    ms_per_tick: float
    """Physics, proprioception and depth image of a planner tick, ms."""
    valid_depth: float
    """Share of pixels with a depth; 0: the camera sees nothing."""


def check_robot(robot: type[MujocoRobot] | str) -> RobotReport:
    """Move a robot at random, without a task, and check every planner tick.

    Proprioception and depth have the shape, type and range of its description. The same generator
    gives the same episode, bit for bit. The physics stays valid under any action. If it has a
    mirror, reflected actions give reflected observations, within the noise of its sensors.

    Args:
        robot: the class, or ``package.module:Class``.

    Raises:
        ConformanceError: names the robot, the tick and the problem, or the error of its class.
        UsageError: there is no such class.
        EnvironmentFailure: its timestep does not divide the planner tick, or it has no camera.
    """
    kind = _load(robot) if isinstance(robot, str) else robot
    try:
        return _check(kind)
    except EgovcpError:
        raise
    except Exception as error:
        modules = {base.__module__ for base in kind.__mro__}
        for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
            module = str(frame.f_globals.get("__name__", ""))
            if module in modules and not module.startswith("egovcp."):
                where = f"{os.path.basename(frame.f_code.co_filename)}, line {line}"
                raise ConformanceError(
                    f"robot {kind.__name__}: {type(error).__name__} in {where}: {error}"
                ) from error
        raise  # an error of this check


def _check(kind: type[MujocoRobot]) -> RobotReport:
    name = kind.__name__
    for attribute, remedy in _NEEDED.items():
        if not getattr(kind, attribute, None):
            raise ConformanceError(f"robot {name}: it has no {attribute}; {remedy}")
    spec, model = kind.spec, kind.build().compile()
    body = kind(copy(model))
    rng = np.random.default_rng(0)
    steps = rng.uniform(-ACTION_RATE_LIMIT, ACTION_RATE_LIMIT, (_TICKS, spec.action_dim))
    actions = np.clip(steps.cumsum(0), -1, 1)
    began = time.perf_counter()
    run = _play(body, actions, 0)
    ms = 1e3 * (time.perf_counter() - began) / _TICKS
    again = _play(body, actions, 0)
    for what, first, second in (("state", run[0], again[0]), ("depth", run[1], again[1])):
        same = np.equal(first, second).reshape(_TICKS, -1).all(1)
        if not same.all():
            raise ConformanceError(
                f"robot {name}, tick {int(np.argmin(same))}: {what} differs in a second run with "
                "the same actions; use only self.rng, and set everything in reset"
            )
    if spec.mirror is not None:
        noisy = _play(kind(copy(model)), actions, 1)
        mirrored = _play(kind(copy(model)), spec.mirrored_action(actions), 1)
        _check_mirror(name, spec.state_names, run[0], noisy[0], spec.mirrored_state(mirrored[0]))
        off = _difference(run[1], mirrored[1][..., ::-1])
        if off > 2 * _difference(run[1], noisy[1]) + 0.02 * 1000 * spec.depth_max_m:
            raise ConformanceError(
                f"robot {name}: the depth image under reflected actions is not the reflected one "
                f"({off:.0f} mm off); mount the camera in the plane of symmetry, its columns "
                "along y, or leave out the mirror"
            )
    return RobotReport(spec.robot_type, ms, float((run[1] > 0).mean()))


def _load(reference: str) -> type[MujocoRobot]:
    from egovcp.sim.mujoco_robot import MujocoRobot

    try:
        return import_class(reference, MujocoRobot, "egovcp.sim.tasks.MujocoRobot")  # type: ignore[type-abstract]
    except (ImportError, AttributeError, ValueError) as error:
        raise UsageError(
            f"no robot {reference!r} ({error}); expected package.module:Class"
        ) from error


def _play(robot: MujocoRobot, actions: Array, seed: int) -> tuple[Array, NDArray[np.uint16]]:
    """States (T, S) and depth images (T, H, W) after each of the actions (T, A)."""
    spec, name = robot.spec, type(robot).__name__
    steps = robot.physics_clock(float(robot.model.opt.timestep))
    robot.reset(np.random.default_rng(seed))
    robot.forward()
    states, images = [], []
    for t, action in enumerate(actions):
        robot.command(spec.action_box.to_metric(action))
        for _ in range(steps):
            robot.step()
        robot.forward()
        if robot.diverged:
            raise ConformanceError(
                f"robot {name}, tick {t}: the physics diverged; use a smaller timestep"
            )
        state, depth = np.asarray(robot.state(), np.float64), np.asarray(robot.depth())
        for problem in _problems(spec, state, depth):
            raise ConformanceError(f"robot {name}, tick {t}: {problem}")
        states.append(state)
        images.append(depth)
    return np.array(states), np.array(images)


def _problems(spec: RobotSpec, state: Array, depth: NDArray[Any]) -> Iterator[str]:
    """What is wrong with an observation."""
    if state.shape != (spec.state_dim,):
        yield f"state is {state.shape}, expected {(spec.state_dim,)}"
    if not np.isfinite(state).all():
        yield "state is not finite"
    found, expected = f"{depth.dtype} {depth.shape}", f"uint16 {spec.depth}"
    if found != expected:
        yield f"depth is {found}, expected {expected}"
    elif depth.max() > 1000 * spec.depth_max_m:
        yield f"depth is {depth.max() / 1000} m, expected at most {spec.depth_max_m}; give 0 there"


def _check_mirror(
    robot: str, names: tuple[str, ...], run: Array, noisy: Array, mirrored: Array
) -> None:
    """Compare the states of a run with those of the reflected run, reflected back."""
    allowed = _MOST_ASYMMETRY * run.std(0) + 2 * np.abs(run - noisy).mean(0) + 1e-6
    error = np.abs(run - mirrored).mean(0)
    if (error > allowed).any():
        worst = int(np.argmax(error / allowed))
        raise ConformanceError(
            f"robot {robot}: {names[worst]} differs by {error[worst]:.3g} between a run and the "
            f"reflection of a run with reflected actions, expected at most {allowed[worst]:.3g}; "
            "correct the signs and sources of the mirror, or leave it out"
        )


def _difference(a: NDArray[np.uint16], b: NDArray[np.uint16]) -> float:
    """Mean absolute difference of depth images, mm."""
    return float(np.abs(a.astype(np.int64) - b).mean())
