"""Motors and connection of a robot as Rerun curves: one entity per limb, one line per joint."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from egovcp.log import paths
from egovcp.log.rerun_columns import Columns, named_columns
from egovcp.log.signals import LIMBS, limb
from egovcp.log.tick import MODES, MotorReadings, Tick
from egovcp.spec import JOINT_NAMES

_JOINTS_OF: Final = {
    name: [i for i, joint in enumerate(JOINT_NAMES) if limb(joint) == name] for name in LIMBS
}


def log_motor_styles(stream: rr.RecordingStream) -> None:
    """Name the line of every joint, once per recording."""
    for name, joints in _JOINTS_OF.items():
        lines = rr.SeriesLines(names=[JOINT_NAMES[i].removesuffix("_joint") for i in joints])
        for path in (paths.MOTOR_TORQUE, paths.MOTOR_TEMPERATURE):
            stream.log(f"{path}/{name}", lines, static=True)


def motor_columns(ticks: Sequence[Tick], shown: dict[str, set[int]]) -> Iterator[Columns]:
    """Torque, temperature, faults, lost packets, connection and state of the runner.

    Args:
        shown: path -> joints that have a curve of faults or lost packets, which this extends: a
            curve that has begun goes on in later ticks.
    """
    read = [(tick, tick.motors) for tick in ticks if tick.motors is not None]
    yield from _limbs(paths.MOTOR_TORQUE, [(tick, m.torque) for tick, m in read])
    hottest = [
        (tick, np.fmax.reduce(m.temperature, axis=1))
        for tick, m in read
        if m.temperature is not None
    ]
    yield from _limbs(paths.MOTOR_TEMPERATURE, hottest)
    for path, pick in ((paths.MOTOR_FAULTS, _faults), (paths.MOTOR_LOST, _lost)):
        yield from named_columns(path, ticks, _nonzero(ticks, pick, shown.setdefault(path, set())))
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


def _nonzero(
    ticks: Sequence[Tick],
    pick: Callable[[MotorReadings], NDArray[np.integer] | None],
    shown: set[int],
) -> Callable[[Tick], Mapping[str, float]]:
    """Of each tick the values of the joints that have not been zero throughout."""
    rows = [pick(tick.motors) for tick in ticks if tick.motors is not None]
    known = [row for row in rows if row is not None]
    if known:
        shown.update(map(int, np.flatnonzero(np.any(known, axis=0))))

    def values(tick: Tick) -> Mapping[str, float]:
        row = None if tick.motors is None else pick(tick.motors)
        return {} if row is None else {JOINT_NAMES[i]: float(row[i]) for i in sorted(shown)}

    return values


def _faults(motors: MotorReadings) -> NDArray[np.integer] | None:
    return motors.faults


def _lost(motors: MotorReadings) -> NDArray[np.integer] | None:
    return motors.lost


def _mode(tick: Tick) -> Mapping[str, float]:
    return {mode: float(mode == tick.mode) for mode in MODES} if tick.mode else {}
