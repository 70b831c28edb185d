"""Rerun curves of action, proprioception, outcome, motors and connection.

Each group of curves is one entity, so that sending a batch is one call per group.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from egovcp.log import paths
from egovcp.log.rerun_columns import Columns, named_columns
from egovcp.log.tick import MODES, Tick
from egovcp.robot_spec import RobotSpec
from egovcp.spec import ACTION_BOX, JOINT_NAMES

_LEG_JOINTS: Final = ("hip", "knee", "ankle")
LIMBS: Final = ("left_leg", "right_leg", "waist", "left_arm", "right_arm")


@dataclass(frozen=True)
class Signal:
    """The curves of one plot."""

    path: str
    names: tuple[str, ...]
    """One per line."""
    values: Callable[[Tick], Sequence[float] | NDArray[np.floating]]
    """Their values at a tick, in the order of ``names``."""


def limb(joint: str) -> str:
    """The limb of a joint, one of `LIMBS`."""
    side, _, rest = joint.partition("_")
    if side == "waist":
        return side
    return f"{side}_{'leg' if rest.startswith(_LEG_JOINTS) else 'arm'}"


_JOINTS_OF: Final = {
    name: [i for i, joint in enumerate(JOINT_NAMES) if limb(joint) == name] for name in LIMBS
}


def signals_of(robot: RobotSpec) -> Iterator[Signal]:
    """The signals of a robot: actions, each group of states, and outcome; of the G1 also the
    targets of hands and height, and the states of joints by limb."""
    yield Signal(f"{paths.ACTION}/normalised", robot.action_names, lambda tick: tick.action_sent)
    if robot.is_g1:
        yield Signal(f"{paths.ACTION}/left_hand", tuple("xyz"), lambda tick: _metric(tick)[:3])
        yield Signal(f"{paths.ACTION}/right_hand", tuple("xyz"), lambda tick: _metric(tick)[3:6])
        yield Signal(f"{paths.ACTION}/height", ("height",), lambda tick: _metric(tick)[6:])
    for group, part in robot.state_slices.items():
        if robot.is_g1 and group.startswith("joint_"):
            for name, joints in _JOINTS_OF.items():
                yield _state(robot, f"{group}/{name}", [part.start + i for i in joints])
        else:
            yield _state(robot, group, range(part.start, part.stop))
    yield Signal(
        paths.OUTCOME,
        ("done", "success"),
        lambda tick: (float(tick.terminated or tick.truncated), float(tick.success)),
    )


def _metric(tick: Tick) -> NDArray[np.float64]:
    return ACTION_BOX.to_metric(np.asarray(tick.action_sent))


def _state(robot: RobotSpec, path: str, indices: Sequence[int]) -> Signal:
    names = (robot.state_names[i].removeprefix(f"{path}.") for i in indices)
    lines = tuple(name.removeprefix("command.") for name in names)
    return Signal(f"{paths.STATE}/{path}", lines, lambda tick: tick.state[list(indices)])


def log_styles(stream: rr.RecordingStream, robot: RobotSpec) -> None:
    """Log the names of the lines of every signal, once per recording."""
    for signal in signals_of(robot):
        stream.log(signal.path, rr.SeriesLines(names=list(signal.names)), static=True)


def signal_columns(ticks: Sequence[Tick], robot: RobotSpec) -> Iterator[Columns]:
    for signal in signals_of(robot):
        values = np.array([signal.values(tick) for tick in ticks], np.float64)  # (n, lines)
        columns = rr.Scalars.columns(scalars=values.ravel())
        yield Columns(signal.path, ticks, columns.partition([len(signal.names)] * len(ticks)))


def log_motor_styles(stream: rr.RecordingStream) -> None:
    """Log the names of the lines of torque and temperature, once per recording."""
    for name, joints in _JOINTS_OF.items():
        lines = rr.SeriesLines(names=[JOINT_NAMES[i].removesuffix("_joint") for i in joints])
        for path in (paths.MOTOR_TORQUE, paths.MOTOR_TEMPERATURE):
            stream.log(f"{path}/{name}", lines, static=True)


def motor_columns(ticks: Sequence[Tick], faulty: set[int]) -> Iterator[Columns]:
    """Torque, temperature, faults, connection and state of the runner.

    ``faulty`` are the joints with a curve of faults. Joints with a first fault are added; they keep
    their curve in later batches.
    """
    read = [(tick, tick.motors) for tick in ticks if tick.motors is not None]
    yield from _limbs(paths.MOTOR_TORQUE, [(tick, m.torque) for tick, m in read])
    hottest = [
        (tick, np.fmax.reduce(m.temperature, axis=1))
        for tick, m in read
        if m.temperature is not None
    ]
    yield from _limbs(paths.MOTOR_TEMPERATURE, hottest)
    rows = {tick.index: m.faults for tick, m in read if m.faults is not None}
    faulty.update(int(joint) for row in rows.values() for joint in np.flatnonzero(row))

    def faults(tick: Tick) -> Mapping[str, float]:
        row = rows.get(tick.index)
        return {} if row is None else {JOINT_NAMES[i]: float(row[i]) for i in sorted(faulty)}

    yield from named_columns(paths.MOTOR_FAULTS, ticks, faults)
    yield from named_columns(paths.LINK, ticks, lambda tick: tick.link)
    yield from named_columns(paths.RUNNER, ticks, _mode)


def _limbs(path: str, rows: Sequence[tuple[Tick, NDArray[np.floating]]]) -> Iterator[Columns]:
    """One entity per limb from (29,) values at some ticks."""
    if not rows:
        return
    ticks = [tick for tick, _ in rows]
    values = np.array([row for _, row in rows], np.float64)
    for name, joints in _JOINTS_OF.items():
        columns = rr.Scalars.columns(scalars=values[:, joints].ravel())
        yield Columns(f"{path}/{name}", ticks, columns.partition([len(joints)] * len(ticks)))


def _mode(tick: Tick) -> Mapping[str, float]:
    return {mode: float(mode == tick.mode) for mode in MODES} if tick.mode else {}
