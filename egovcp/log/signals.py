"""The numbers of a tick as curves: action, proprioception and outcome, in groups of a few.

Each group is one entity with one line per number: a batch of many costs as much as one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from egovcp.log import paths
from egovcp.log.colour import LEFT
from egovcp.log.rerun_columns import Columns
from egovcp.log.tick import Tick
from egovcp.spec import ACTION_BOX, ACTION_NAMES, JOINT_NAMES, STATE_NAMES, STATE_SLICES

_LEG_JOINTS: Final = ("hip", "knee", "ankle")
_AXES: Final = {"x": (224, 80, 72), "y": (98, 184, 92), "z": (82, 138, 230)}
_COLOURS: Final = _AXES | {"done": LEFT, "success": (98, 184, 92)}
LIMBS: Final = ("left_leg", "right_leg", "waist", "left_arm", "right_arm")


@dataclass(frozen=True)
class Signal:
    """A few numbers of a tick that belong into one plot."""

    path: str
    names: tuple[str, ...]
    """One per line."""
    values: Callable[[Tick], Sequence[float] | NDArray[np.floating]]
    """Their values at a tick, in the order of ``names``."""

    @property
    def colours(self) -> list[tuple[int, int, int]] | None:
        """One per line, the same for the same axis everywhere; None: the viewer's choice."""
        known = [_COLOURS[name] for name in self.names if name in _COLOURS]
        return known if len(known) == len(self.names) else None


def limb(joint: str) -> str:
    """Which of the five limbs a joint belongs to, such as ``left_arm``."""
    side, _, rest = joint.partition("_")
    if side == "waist":
        return side
    return f"{side}_{'leg' if rest.startswith(_LEG_JOINTS) else 'arm'}"


def _metric(tick: Tick) -> NDArray[np.float64]:
    return ACTION_BOX.to_metric(np.asarray(tick.action_sent))


def _actions() -> Iterator[Signal]:
    yield Signal(f"{paths.ACTION}/normalised", ACTION_NAMES, lambda tick: tick.action_sent)
    yield Signal(f"{paths.ACTION}/left_hand", tuple("xyz"), lambda tick: _metric(tick)[:3])
    yield Signal(f"{paths.ACTION}/right_hand", tuple("xyz"), lambda tick: _metric(tick)[3:6])
    yield Signal(f"{paths.ACTION}/height", ("height",), lambda tick: _metric(tick)[6:])


def _states() -> Iterator[Signal]:
    for group, part in STATE_SLICES.items():
        if not group.startswith("joint_"):
            yield _state(group, group, range(part.start, part.stop))
    for group in ("joint_position", "joint_velocity"):
        first = STATE_SLICES[group].start
        for name in LIMBS:
            joints = [i for i, joint in enumerate(JOINT_NAMES) if limb(joint) == name]
            yield _state(f"{group}/{name}", "", [first + i for i in joints])


def _state(path: str, prefix: str, indices: Sequence[int]) -> Signal:
    names = tuple(
        STATE_NAMES[i].removeprefix(f"{prefix}.").removeprefix("command.") for i in indices
    )
    return Signal(f"{paths.STATE}/{path}", names, lambda tick: tick.state[list(indices)])


def _outcomes() -> Iterator[Signal]:
    yield Signal(
        paths.OUTCOME,
        ("done", "success"),
        lambda tick: (float(tick.terminated or tick.truncated), float(tick.success)),
    )


SIGNALS: Final = (*_actions(), *_states(), *_outcomes())


def log_styles(stream: rr.RecordingStream) -> None:
    """Name the lines of every signal, once per recording."""
    for signal in SIGNALS:
        lines = rr.SeriesLines(names=list(signal.names), colors=signal.colours)
        stream.log(signal.path, lines, static=True)


def signal_columns(ticks: Sequence[Tick]) -> Iterator[Columns]:
    """Every signal at every tick."""
    for signal in SIGNALS:
        values = np.array([signal.values(tick) for tick in ticks], np.float64)  # (n, lines)
        columns = rr.Scalars.columns(scalars=values.ravel())
        yield Columns(signal.path, ticks, columns.partition([len(signal.names)] * len(ticks)))
