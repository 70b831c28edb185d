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


def motor_columns(ticks: Sequence[Tick]) -> Iterator[Columns]:
    """Torque, temperature, faults, lost packets, connection and state of the runner."""
    read = [(tick, tick.motors) for tick in ticks if tick.motors is not None]
    yield from _limbs(paths.MOTOR_TORQUE, [(tick, m.torque) for tick, m in read])
    hottest = [(tick, hottest_sensor(m)) for tick, m in read if m.temperature is not None]
    yield from _limbs(paths.MOTOR_TEMPERATURE, hottest)
    for path, pick in ((paths.MOTOR_FAULTS, _faults), (paths.MOTOR_LOST, _lost)):
        yield from named_columns(path, ticks, _nonzero(ticks, pick))
    yield from named_columns(paths.LINK, ticks, lambda tick: tick.link)
    yield from named_columns(paths.RUNNER, ticks, _mode)


def hottest_sensor(motors: MotorReadings) -> NDArray[np.float64]:
    """(29,) deg C, the hotter of a motor's sensors; not-a-number where none reports."""
    assert motors.temperature is not None, "only motors that report temperatures have a hottest"
    temperature = np.asarray(motors.temperature, np.float64)
    known = np.isfinite(temperature)
    hottest = np.where(known, temperature, -np.inf).max(axis=1)
    return np.where(known.any(axis=1), hottest, np.nan)


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
    ticks: Sequence[Tick], pick: Callable[[MotorReadings], NDArray[np.integer] | None]
) -> Callable[[Tick], Mapping[str, float]]:
    """Of each tick the values of the joints that are not zero throughout ``ticks``."""
    rows = [pick(tick.motors) for tick in ticks if tick.motors is not None]
    known = [row for row in rows if row is not None]
    shown = np.flatnonzero(np.any(known, axis=0)) if known else ()

    def values(tick: Tick) -> Mapping[str, float]:
        row = None if tick.motors is None else pick(tick.motors)
        return {} if row is None else {JOINT_NAMES[i]: float(row[i]) for i in shown}

    return values


def _faults(motors: MotorReadings) -> NDArray[np.integer] | None:
    return motors.faults


def _lost(motors: MotorReadings) -> NDArray[np.integer] | None:
    return motors.lost


def _mode(tick: Tick) -> Mapping[str, float]:
    return {mode: float(mode == tick.mode) for mode in MODES} if tick.mode else {}
