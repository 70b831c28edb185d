"""Does a policy act for a reason? What it does where nothing happens, and afterwards.

ball   empty scenes: how far the hands leave the neutral pose, beside scenes with a throw
wall   undisturbed scenes: does anything touch the wall? After a push: are the hands back?
arch   how high the pelvis stands while no arch is near
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.intervals import bootstrap, wilson
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import StepResult, resolve_config
from egovcp.sim.scenario import Scenario
from egovcp.spec import PLANNER_HZ, TASKS
from egovcp_experiment.studies.study import finish
from egovcp_experiment.studies.watching import Moment, WatchConfig, Watcher, watch

PROG: Final = "python -m egovcp_experiment.studies.behaviour"
AT_REST_MPS: Final = (
    0.10  # a pelvis slower than this has recovered, if it stays so for half a second
)
_REST_TICKS: Final = PLANNER_HZ // 2
NEAR_NEUTRAL_M: Final = 0.10  # a hand so close to where it was at the start is back
BACK_TICKS: Final = 2 * PLANNER_HZ
STANDING_M: Final = 0.70
_PASSED_M: Final = 0.9  # an arch so far behind has been passed, whatever its depth

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class BehaviourConfig(WatchConfig):
    """What a policy does where nothing happens, and after something has."""


@dataclass
class Track:
    """What one robot did."""

    since: list[float]
    """s since the event."""
    hands: list[Array]
    """(2, 3) palms in the pelvis frame, m."""
    action: list[Array]
    """(7,) sent."""
    pelvis: list[float]
    """m above ground."""
    speed: list[float]
    """Horizontal, m/s."""
    ahead: list[float]
    """Object before the pelvis, m."""
    touched: bool = False
    """Whether anything has met the object."""
    away: bool = False
    """A push away from the wall."""
    fallen: bool = False


class _Tracks(Watcher):
    """Follows every robot."""

    def __init__(self) -> None:
        self.tracks: list[Track] = []

    def begin(self, scenarios: Sequence[Scenario]) -> None:
        self._group = [Track([], [], [], [], [], []) for _ in scenarios]
        self.tracks += self._group

    def before(self, moment: Moment) -> None:
        truth = moment.env.privileged_state()
        for row in np.flatnonzero(moment.live).tolist():
            track = self._group[row]
            track.since.append(float(truth.since_event[row]))
            track.hands.append(truth.hands_b[row])
            track.pelvis.append(float(truth.pelvis_w[row, 2]))
            track.speed.append(float(np.hypot(*truth.pelvis_velocity_w[row, :2])))
            track.ahead.append(float(truth.object_b[row, 0]))
            track.away = abs(moment.env.parameters[row].get("push_bearing", 0.0)) > np.pi / 2

    def after(self, moment: Moment, result: StepResult) -> None:
        force = moment.env.privileged_state().contact_force
        for row in np.flatnonzero(moment.live).tolist():
            track = self._group[row]
            track.action.append(result.sent_action[row].copy())
            track.touched |= bool(force[row].any())
            track.fallen = bool(result.terminated[row])


def measure(config: BehaviourConfig) -> None:
    """Play scenes with and without an event, and write what was done in them."""
    if config.task not in TASKS:
        raise UsageError(f"--task={config.task}: expected one of {', '.join(TASKS)}")
    artifact = config.artifact()
    eventful = _tracks(artifact, config.env, config)
    empty = _tracks(artifact, config.empty(), config)
    found = {"ball": _ball, "wall": _wall, "arch": _arch}[config.task](config, eventful, empty)
    finish(config, {"task": config.task, "episodes": config.episodes, **found})


def _tracks(artifact: Artifact, env: EnvConfig, config: BehaviourConfig) -> list[Track]:
    tracks = _Tracks()
    watch(artifact, env, config, tracks)
    return tracks.tracks


def _ball(config: BehaviourConfig, eventful: list[Track], empty: list[Track]) -> dict[str, Any]:
    after = [hands_away(t)[np.array(t.since) > 0] for t in eventful]
    flights = [part for part in after if len(part)]
    return {
        "empty_scene": _means([hands_away(t) for t in empty]),
        "before_throw": _means([hands_away(t)[np.array(t.since) < 0] for t in eventful]),
        "after_throw": _means(flights),
        "empty_scene_effort": _means([effort(t) for t in empty]),
    }


def _wall(config: BehaviourConfig, eventful: list[Track], empty: list[Track]) -> dict[str, Any]:
    untouched = [not track.touched for track in empty]
    back = [b for t in eventful if not t.away and (b := hands_back(t)) is not None]
    pushed = [track for track in eventful if not track.away]
    return {
        "undisturbed_without_contact": _share(untouched),
        "braced_for_s": resolve_config(config.env).wall.disturbed_time,
        "hands_back": _share(back),
        "pushed": len(pushed),
        "recovered": len(back),
        "empty_scene": _means([hands_away(t) for t in empty]),
    }


def _arch(config: BehaviourConfig, eventful: list[Track], empty: list[Track]) -> dict[str, Any]:
    near = config.env.arch.near
    heights = [np.array(t.pelvis)[_far(t, near)] for t in [*eventful, *empty]]
    heights = [part for part in heights if len(part)]
    under = [np.array(t.pelvis)[~_far(t, near)] for t in eventful]
    return {
        "pelvis_far": _means(heights),
        "standing_far": _means([(part > STANDING_M).astype(float) for part in heights]),
        "pelvis_near": _means([part for part in under if len(part)]),
    }


def _far(track: Track, near: float) -> NDArray[np.bool_]:
    """Ticks in which the arch is further ahead than ``near``, or well behind."""
    ahead = np.array(track.ahead)
    far: NDArray[np.bool_] = (ahead > near) | (ahead < -_PASSED_M)
    return far


def hands_away(track: Track) -> Array:
    """(T,) how far the further hand is from where it was at the start, m."""
    hands = np.stack(track.hands)
    away: Array = np.linalg.norm(hands - hands[0], axis=-1).max(axis=-1)
    return away


def effort(track: Track) -> Array:
    """(T,) mean squared action: what the tasks charge for."""
    squares: Array = np.square(np.stack(track.action)).mean(-1)
    return squares


def hands_back(track: Track) -> bool | None:
    """Whether both hands are back within two seconds of recovery from the push; None: it fell, or
    the episode ended before that could be seen."""
    slow = (np.array(track.speed) < AT_REST_MPS) & (np.array(track.since) > 0)
    rest = np.convolve(slow, np.ones(_REST_TICKS), "valid") >= _REST_TICKS
    if track.fallen or not rest.any():
        return None
    start = int(rest.argmax())
    window = hands_away(track)[start : start + BACK_TICKS]
    back = bool((window < NEAR_NEUTRAL_M).any())
    return back if back or len(window) == BACK_TICKS else None


def _share(flags: Sequence[bool]) -> dict[str, Any]:
    if not flags:
        return {"share": None, "ci95": None, "episodes": 0}
    count = sum(flags)
    return {
        "share": count / len(flags),
        "ci95": list(wilson(count, len(flags))),
        "episodes": len(flags),
    }


def _means(parts: Sequence[Array]) -> dict[str, Any]:
    """Mean over episodes of their means, with its interval."""
    means = np.array([part.mean() for part in parts if len(part)])
    if not len(means):
        return {"mean": None, "ci95": None, "episodes": 0}
    interval = bootstrap(lambda i: means[i].mean(axis=1), len(means))
    return {"mean": float(means.mean()), "ci95": list(interval), "episodes": len(means)}


CONFIG = BehaviourConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CONFIG, measure, argv, prog=PROG)


if __name__ == "__main__":
    sys.exit(main())
