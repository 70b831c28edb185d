"""Plays a skill with many robots at once, measures the outcome, and records a robot."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import SimulationDiverged, UsageError
from egovcp.log.tick import RunInfo, Tick
from egovcp.robot.arms import nearest_reachable
from egovcp.robot.controllers import LowLevelController
from egovcp.robot.g1 import EFFORT_LIMIT, WAIST
from egovcp.robot.geometry import heading_rotation, rotation_matrix, rotation_vector
from egovcp.robot.kinematics import torso_rotation
from egovcp.robot.mjcf import FootModel
from egovcp.robot_spec import G1
from egovcp.sim.config import SensorConfig
from egovcp.sim.robot import MAX_SPEED, noise_std
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_SLICE,
    CONTROLLER_HZ,
    CONTROLLER_TICKS_PER_PLAN,
    PLANNER_HZ,
    STATE_DIM,
    STATE_SLICES,
)
from egovcp_train.lowlevel import sensing
from egovcp_train.lowlevel.commands import horizontal
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.physics import (
    BatchPhysics,
    PhysicsOptions,
    Snapshot,
    neutral_qpos,
    random_delays,
)
from egovcp_train.lowlevel.sensing import heading, measure, to_heading_xy
from egovcp_train.lowlevel.skills import HOLD, SETTLED, Skill

Array = NDArray[np.float64]
_FALLEN_TILT: Final = 1.0  # rad
_FALLEN_HEIGHT: Final = 0.35  # m
_PUSH_TICK: Final = CONTROLLER_HZ
_STRIDE: Final = 40  # ticks over which velocities are averaged: the pelvis swings with each step
_WARM_UP: Final = 2 * CONTROLLER_HZ  # ticks of ramp and transition that do not count in walking
_LAGS: Final = 25  # ticks, the longest lag looked for


@dataclass(frozen=True)
class SkillOutcome:
    """Metrics per robot, (N,); NaN where there was nothing to measure.

    After ``survived``, the names are those in lowlevel.json, which has the means.
    """

    survived: NDArray[np.bool_]
    hand_error_m: Array  # mean distance to the nearest reachable target
    hand_lag_s: Array  # by which the hands follow best
    height_error_m: Array  # mean
    velocity_error_mps: Array  # mean over strides
    turning_error_radps: Array  # mean over strides
    head_top_m: Array  # highest in walking
    stepping_share: Array  # of the ticks
    camera_px_per_step: Array  # (N, 3) up, across, by roll; mean rotation per planner step
    camera_px_8_steps: Array  # (N, 3) per 8 planner steps
    torque_rms_relative: Array  # (N, 29) RMS torque of each joint, relative to the motor's peak


def _observe(x: Snapshot, command: Array, stepping: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
    """What is measured in a tick, (N, ...); hands and targets in the heading frame."""
    turn = rotation_matrix(x.quaternion)
    forward = heading(turn)
    pelvis = heading_rotation(-turn[:, 2])
    palms = x.palms - x.position[:, None]
    hands = command[:, 3:9].reshape(-1, 2, 3)
    planar = to_heading_xy(x.velocity, forward)
    return {
        "hands": np.concatenate([to_heading_xy(palms, forward), palms[..., 2:]], axis=-1),
        "targets": nearest_reachable(hands, pelvis, torso_rotation(pelvis, x.joints[:, WAIST])),
        "height": x.position[:, 2].copy(),
        "velocity": np.concatenate([planar, x.angular_velocity[:, 2:]], axis=1),
        "head": x.head_top,
        "stepping": stepping.copy(),
        "torso": np.nan_to_num(sensing.torso(x)),
        "torque": x.torque.copy(),
    }


def play(
    controller: LowLevelController,
    skill: Skill,
    robots: int,
    seed: int,
    disturbances: DisturbanceConfig,
    sensors: SensorConfig,
    feet: FootModel = "stock",
    threads: int = 1,
    stopped: Callable[[], bool] = lambda: False,
    options: PhysicsOptions | None = None,
    on_tick: Callable[[Snapshot, Array], None] | None = None,
) -> SkillOutcome:
    """Run ``skill`` once with each of ``robots`` robots of different physical parameters.

    ``on_tick`` gets the state of all robots and their commands (N, 10) after each tick.

    Raises:
        SimulationDiverged: the velocities of a robot that has not fallen are unphysical.
        KeyboardInterrupt: ``stopped`` has returned true.
    """
    rng = np.random.default_rng([seed, 1])
    commands = skill.script(skill.ticks, robots, rng)
    qpos = neutral_qpos(robots)
    std, ticks = noise_std(sensors), list[dict[str, NDArray[Any]]]()
    alive = np.ones((skill.ticks, robots), dtype=bool)
    with closing(BatchPhysics(robots, feet, disturbances, threads, seed, options)) as physics:
        physics.place(np.arange(robots), qpos, qpos[:, 7:])
        delay = random_delays(robots, disturbances, rng, physics.options.timestep)
        x = physics.snapshot()
        controller.reset(measure(x, commands[0], std, rng))
        for tick, command in enumerate(commands):
            if stopped():
                raise KeyboardInterrupt
            if skill.push and tick == _PUSH_TICK:
                physics.qvel[:, :2] += horizontal(skill.push, _directions(skill, robots, rng))
            state = measure(x, command, std, rng)
            physics.step(controller.step(state), delay)
            x = physics.snapshot()
            _require_valid(physics, alive[tick], f"skill {skill.name}, seed {seed}, tick {tick}")
            alive[tick:] &= ~_fallen(x)
            ticks.append(_observe(x, command, controller.stepping))
            if on_tick:
                on_tick(x, command)
    series = {name: np.array([values[name] for values in ticks]) for name in ticks[0]}
    return _measure(skill, commands, series, alive)


def _directions(skill: Skill, robots: int, rng: np.random.Generator) -> Array:
    """(N,) rad from the direction that the robots face."""
    if skill.push_any_direction:
        return rng.uniform(-np.pi, np.pi, robots)
    return np.asarray(rng.choice([0.0, np.pi], robots))


def _require_valid(physics: BatchPhysics, alive: NDArray[np.bool_], where: str) -> None:
    speed = np.abs(physics.qvel).max(axis=1)
    valid = np.isfinite(physics.state).all(axis=1) & (speed <= MAX_SPEED)
    for robot in np.flatnonzero(alive & ~valid):
        found = f"greatest velocity {speed[robot]:.3g} per second, expected at most {MAX_SPEED:g}"
        raise SimulationDiverged(
            f"the simulation diverged in {where}, robot {robot}: {found}; choose narrower ranges "
            "of --disturbances, or another controller"
        )


def _fallen(x: Snapshot) -> NDArray[np.bool_]:
    upright = rotation_matrix(x.quaternion)[:, 2, 2]
    out: NDArray[np.bool_] = (upright < np.cos(_FALLEN_TILT)) | x.broken
    return out | (x.position[:, 2] < _FALLEN_HEIGHT)


def _measure(
    skill: Skill, commands: Array, series: dict[str, NDArray[Any]], alive: NDArray[np.bool_]
) -> SkillOutcome:
    hands, targets, velocity = series["hands"], series["targets"], series["velocity"]
    torso = series["torso"][::CONTROLLER_TICKS_PER_PLAN]
    moves = commands[..., :3].any()
    reaches = np.ptp(commands[..., 3:9], axis=0).any() and not skill.settled_only
    counted = alive.copy()
    if skill.settled_only:
        counted &= (np.arange(len(commands)) % HOLD >= SETTLED)[:, None]
    elif moves:
        counted[:_WARM_UP] = False
    planned = (counted if moves else alive)[::CONTROLLER_TICKS_PER_PLAN]
    none = np.full(alive.shape[1], np.nan)
    return SkillOutcome(
        survived=alive[-1],
        hand_error_m=_mean(np.linalg.norm(hands - targets, axis=-1).mean(axis=-1), counted),
        hand_lag_s=_lag(hands, targets, counted) if reaches else none,
        height_error_m=_mean(np.abs(series["height"] - commands[..., -1]), counted),
        velocity_error_mps=_velocity_error(velocity[..., :2], commands[..., :2], counted)
        if moves
        else none,
        turning_error_radps=_velocity_error(velocity[..., 2:], commands[..., 2:3], counted)
        if moves
        else none,
        head_top_m=_highest(series["head"], counted) if moves else none,
        stepping_share=_mean(series["stepping"], alive),
        camera_px_per_step=_rotation(torso, planned, 1),
        camera_px_8_steps=_rotation(torso, planned, 8),
        torque_rms_relative=_torque_rms(series["torque"], alive),
    )


def _torque_rms(torque: Array, counted: NDArray[np.bool_]) -> Array:
    """(T, N, 29) N m -> (N, 29) relative to the motor's peak, for which Unitree publishes no
    continuous rating. Winding losses, which heat a motor, grow with the square of the torque."""
    return np.sqrt(_mean((torque / EFFORT_LIMIT) ** 2, counted))


def _mean(series: Array, counted: NDArray[np.bool_]) -> Array:
    """(T, N, ...) -> (N, ...) over the counted ticks (T, N); NaN where there are none."""
    counted = counted.reshape(*counted.shape, *[1] * (series.ndim - 2))
    number = counted.sum(axis=0)
    total = np.where(counted, np.nan_to_num(series), 0.0).sum(axis=0)
    return np.asarray(np.where(number > 0, total / np.maximum(number, 1), np.nan))


def _rotation(torso: Array, counted: NDArray[np.bool_], apart: int) -> Array:
    """Attitudes (P, N, 3, 3) at planner ticks -> (N, 3) px, mean rotation over ``apart`` ticks."""
    if len(torso) <= apart:
        return np.full((counted.shape[1], 3), np.nan)
    turned = np.abs(sensing.pixels(rotation_vector(torso[:-apart], torso[apart:])))
    return _mean(turned, counted[:-apart] & counted[apart:])


def _highest(series: Array, counted: NDArray[np.bool_]) -> Array:
    top = np.where(counted, np.nan_to_num(series), -np.inf).max(axis=0)
    return np.where(np.isfinite(top), top, np.nan)


def _velocity_error(velocity: Array, wanted: Array, counted: NDArray[np.bool_]) -> Array:
    """Distance of the mean velocity of each stride to the mean of what was commanded."""
    if len(velocity) <= _STRIDE:
        return np.full(counted.shape[1], np.nan)
    kernel = np.cumsum(np.concatenate([np.zeros_like(velocity[:1]), velocity - wanted]), axis=0)
    mean = (kernel[_STRIDE:] - kernel[:-_STRIDE]) / _STRIDE
    return _mean(np.linalg.norm(mean, axis=-1), counted[_STRIDE - 1 :])


def _lag(hands: Array, targets: Array, counted: NDArray[np.bool_]) -> Array:
    """The delay (s) of the targets at which the hands are nearest to them."""
    errors = []
    for lag in range(_LAGS):
        shifted = np.linalg.norm(hands[lag:] - targets[: len(targets) - lag], axis=-1).mean(-1)
        errors.append(_mean(shifted, counted[lag:]))
    table = np.array(errors)
    best = np.argmin(np.where(np.isnan(table), np.inf, table), axis=0) / CONTROLLER_HZ
    return np.where(np.isnan(table).all(axis=0), np.nan, best)


class SkillRecorder:
    """Collects every second tick of a robot, and writes ``NAME.gif`` and ``NAME.rrd``.

    There is no camera, so the depth images are empty.
    """

    def __init__(self, name: str, folder: Path) -> None:
        """Choose the files.

        Raises:
            UsageError: one of them exists.
        """
        self._name, self._stem = name, folder / name
        self._seen = 0
        self._ticks: list[Tick] = []
        for suffix in (".gif", ".rrd"):
            if (path := self._stem.with_suffix(suffix)).exists():
                raise UsageError(f"--videos: {path} exists; choose another --output_dir")

    def add(self, x: Snapshot, command: Array) -> None:
        """Add a tick of the controller: the state of all robots and their commands (N, 10)."""
        self._seen += 1
        if self._seen % CONTROLLER_TICKS_PER_PLAN != 1:
            return
        index = len(self._ticks)
        state = np.zeros(STATE_DIM)
        state[COMMAND_SLICE] = command[0]
        state[STATE_SLICES["joint_position"]] = x.joints[0]
        action = ACTION_BOX.to_normalised(command[0, 3:])
        self._ticks.append(
            Tick(
                index,
                index * 10**9 // PLANNER_HZ,
                np.zeros(G1.depth, np.uint16),
                state,
                action_planned=action,
                action_sent=action,
                base=np.concatenate([x.position[0], x.quaternion[0]]),
            )
        )

    def write(self) -> None:
        """Write the files."""
        from egovcp.log.rerun import RerunSink
        from egovcp.log.rollout_video import RolloutVideoSink

        for sink in (
            RolloutVideoSink(self._stem.with_suffix(".gif")),
            RerunSink(self._stem.with_suffix(".rrd")),
        ):
            sink.open(RunInfo(self._name))
            for tick in self._ticks:
                sink.write(tick)
            sink.close()
