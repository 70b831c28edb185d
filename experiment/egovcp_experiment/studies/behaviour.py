"""Behaviour of a policy with and without events.

ball   distance of the hands from their start in empty scenes, and before and after a throw
wall   contact in undisturbed scenes; contact of the hands after a push, whether they return, and
       the value that the model sees in the oracle's bracing pose, compared with the neutral pose
arch   height of the pelvis near an arch and far from it
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch

from egovcp.artifact import Artifact
from egovcp.eval_scores import Array, bootstrap, wilson
from egovcp.model import Carry
from egovcp.plan import held_value
from egovcp.sim.config import EnvConfig
from egovcp.spec import PLANNER_DT, PLANNER_HZ
from egovcp_experiment.config import TASKS
from egovcp_experiment.studies import study

#: A robot has recovered when its pelvis is slower than this for half a second.
AT_REST_MPS: Final = 0.10
_REST_TICKS: Final = PLANNER_HZ // 2
NEAR_START_M: Final = 0.10  # distance at which a hand is back at its start
BACK_TICKS: Final = 2 * PLANNER_HZ
STANDING_M: Final = 0.70
FAR_M: Final = 0.9  # distance at which an arch needs no crouch


@dataclass(frozen=True)
class BehaviourConfig(study.SimStudyConfig):
    """Measure the behaviour of a policy with and without events."""


@dataclass
class BehaviourTrace:
    """One episode, a value per tick."""

    since_event_s: list[float] = field(default_factory=list)
    hands: list[Array] = field(default_factory=list)
    """(2, 3) palms in the pelvis frame, m."""
    action: list[Array] = field(default_factory=list)
    """(7,) sent."""
    pelvis: list[float] = field(default_factory=list)
    """m above ground."""
    speed: list[float] = field(default_factory=list)
    """Horizontal, m/s."""
    object_x_m: list[float] = field(default_factory=list)
    """In the pelvis frame."""
    hands_on: list[bool] = field(default_factory=list)
    """Whether a hand touches the object."""
    bracing: list[tuple[float, float]] = field(default_factory=list)
    """While the oracle braces: Q of its pose, and J of holding it, minus those of the neutral pose,
    in standard deviations of the return."""
    touched: bool = False
    """Whether the robot has touched the object."""
    push_is_away: bool = False
    """Whether the push is away from the wall."""
    fallen: bool = False

    @property
    def hand_distance_m(self) -> Array:
        """(T,) distance of the further hand from its start."""
        hands = np.stack(self.hands)
        distance: Array = np.linalg.norm(hands - hands[0], axis=-1).max(axis=-1)
        return distance

    @property
    def hands_back(self) -> bool | None:
        """Whether both hands are back at some time in the two seconds after recovery from the push;
        None if the robot falls or the episode ends earlier."""
        slow = (np.array(self.speed) < AT_REST_MPS) & (np.array(self.since_event_s) > 0)
        rest = np.convolve(slow, np.ones(_REST_TICKS), "valid") >= _REST_TICKS
        if self.fallen or not rest.any():
            return None
        start = int(rest.argmax())
        window = self.hand_distance_m[start : start + BACK_TICKS]
        back = bool((window < NEAR_START_M).any())
        return back if back or len(window) == BACK_TICKS else None

    @property
    def contact_s(self) -> float | None:
        """Time from the push to the first contact of a hand, s; None without."""
        ticks = zip(self.since_event_s, self.hands_on, strict=True)
        times = [s for s, on in ticks if on and s >= 0]
        return times[0] + PLANNER_DT if times else None


type Traces = list[BehaviourTrace]


def measure(config: BehaviourConfig) -> None:
    """Play scenes with and without an event, and write the metrics."""
    config.require_task(TASKS)
    artifact = config.load()
    eventful = _traces(artifact, config.env, config)
    empty = _traces(artifact, config.empty_scenes(), config)
    found = {"ball": _ball, "wall": _wall, "arch": _arch}[config.task](config, eventful, empty)
    config.write({"task": config.task, "episodes": config.episodes, **found})


def _traces(artifact: Artifact, env_config: EnvConfig, config: BehaviourConfig) -> Traces:
    """One trace per episode."""
    traces = [BehaviourTrace() for _ in range(config.episodes)]
    oracle: dict[int, Array] = {}  # of an episode, in its present state
    for step in study.play_episodes(artifact, env_config, config):
        state = step.state
        for row in step.live:
            episode, instance = step.scenarios[row].episode, step.env.instances[row]
            trace = traces[episode]
            if config.task == "wall":
                if episode in oracle and oracle[episode].any():
                    trace.bracing.append(_bracing(artifact, step.carry.row(row), oracle[episode]))
                oracle[episode] = instance.task.oracle()
            trace.since_event_s.append(float(state.since_event[row]))
            trace.hands.append(state.hands_b[row])
            trace.action.append(step.result.sent_action[row].copy())
            trace.pelvis.append(float(state.pelvis_w[row, 2]))
            trace.speed.append(float(np.hypot(*state.pelvis_velocity_w[row, :2])))
            trace.object_x_m.append(float(state.object_b[row, 0]))
            bearing = step.env.parameters[row].get("push_bearing", 0.0)
            trace.push_is_away = abs(bearing) > np.pi / 2
            trace.hands_on.append(instance.contacts()["hands"])
            trace.touched |= bool(instance.task.forces.any())
            trace.fallen = bool(step.result.terminated[row])
    return traces


@torch.no_grad()
def _bracing(artifact: Artifact, carry: Carry, pose: Array) -> tuple[float, float]:
    """(Q, J) of a pose (7,) minus those of the neutral pose, see `BehaviourTrace.bracing`."""
    model = artifact.world_model
    poses = torch.as_tensor(np.stack([pose, np.zeros_like(pose)])[None]).to(carry.h)
    q = model.value(model.expand_candidates(carry), poses)[0]
    j = held_value(model, carry, poses, artifact.planner)[0]
    scale = float(model.return_std)
    return float(q[0] - q[1]) / scale, float(j[0] - j[1]) / scale


def _ball(config: BehaviourConfig, eventful: Traces, empty: Traces) -> dict[str, Any]:
    return {
        "empty_scene": _means([t.hand_distance_m for t in empty]),
        "before_throw": _means(
            [t.hand_distance_m[np.array(t.since_event_s) < 0] for t in eventful]
        ),
        "after_throw": _means([t.hand_distance_m[np.array(t.since_event_s) > 0] for t in eventful]),
        "empty_scene_effort": _means([np.square(np.stack(t.action)).mean(-1) for t in empty]),
    }


def _wall(config: BehaviourConfig, eventful: Traces, empty: Traces) -> dict[str, Any]:
    pushed = [trace for trace in eventful if not trace.push_is_away]
    back = [flag for trace in pushed if (flag := trace.hands_back) is not None]
    times = [trace.contact_s for trace in pushed]
    values = [np.array(trace.bracing) for trace in pushed if trace.bracing]
    return {
        "hand_contact": _share([time is not None for time in times]),
        "contact_s": _means([np.array([time]) for time in times if time is not None]),
        "bracing_q": _means([each[:, 0] for each in values]),
        "bracing_j": _means([each[:, 1] for each in values]),
        "undisturbed_without_contact": _share([not trace.touched for trace in empty]),
        "braced_for_s": config.env.wall.disturbed_time,
        "hands_back": _share(back),
        "pushed": len(pushed),
        "recovered": len(back),
        "empty_scene": _means([t.hand_distance_m for t in empty]),
    }


def _far(trace: BehaviourTrace) -> Any:
    """(T,) whether the arch is further than `FAR_M` from the pelvis."""
    return np.abs(trace.object_x_m) > FAR_M


def _arch(config: BehaviourConfig, eventful: Traces, empty: Traces) -> dict[str, Any]:
    heights = [np.array(t.pelvis)[_far(t)] for t in [*eventful, *empty]]
    return {
        "pelvis_far": _means(heights),
        "standing_far": _means([(part > STANDING_M).astype(float) for part in heights]),
        "pelvis_near": _means([np.array(t.pelvis)[~_far(t)] for t in eventful]),
    }


def _share(flags: Sequence[bool]) -> dict[str, Any]:
    if not flags:
        return {"share": None, "ci95": None, "episodes": 0}
    share, interval = sum(flags) / len(flags), wilson(sum(flags), len(flags))
    return {"share": share, "ci95": list(interval), "episodes": len(flags)}


def _means(parts: Sequence[Array]) -> dict[str, Any]:
    """Mean over episodes of their means, with its interval; empty parts do not count."""
    means = np.array([part.mean() for part in parts if len(part)])
    if not len(means):
        return {"mean": None, "ci95": None, "episodes": 0}
    interval = bootstrap(lambda i: means[i].mean(axis=1), len(means))
    return {"mean": float(means.mean()), "ci95": list(interval), "episodes": len(means)}


main = study.make_main("behaviour", BehaviourConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
