"""J over the x-z plane of a hand's target while the ball approaches (figure 7a).

J is Q minus the planner's cost of holding the pose (`egovcp.plan.held_value`). Maps are taken
before the throw and at shares of the flight, of the hand on whose side the ball arrives. Those of
one episode are kept, with what the rate limit can reach from the last action: Q was fitted to such
actions only. Over all episodes the spread of the map (best minus worst) and the height between its
best point and the ball's aim are averaged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.eval_scores import Array
from egovcp.plan import hand_grid, value_map
from egovcp.plan.value_map import HAND_AXES
from egovcp.spec import ACTION_BOX, ACTION_RATE_LIMIT, PLANNER_DT
from egovcp_experiment.studies import study

BEFORE_S: Final = 0.4  # time of the first map before the throw
SHARES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the flight
MOMENTS: Final = ("before", *(f"{share:.0%}" for share in SHARES))


@dataclass(frozen=True)
class ValueMapsConfig(study.SimStudyConfig):
    """Value maps of a hand while the ball flies."""


@dataclass(frozen=True)
class _Map:
    """A map of one robot."""

    episode: int
    moment: str
    tick: int
    hand: Literal["left", "right"]
    values: NDArray[np.float64]  # (n, m) over z, x
    best: tuple[float, float]  # x and z of the largest value, m
    reach: tuple[list[float], list[float]]  # least and largest x, and z, within the rate limit, m


type Aims = dict[int, tuple[float, float]]
"""Episode -> y and z of the ball's aim, m."""


def _record(artifact: Artifact, config: ValueMapsConfig) -> tuple[list[_Map], Aims]:
    """Each map once per episode."""
    maps: dict[tuple[int, str], _Map] = {}
    aims: Aims = {}
    for step in study.play_episodes(artifact, config.env, config):
        for row in step.live:
            episode, facts = step.scenarios[row].episode, step.env.parameters[row]
            aims[episode] = (facts["aim_lateral"], facts["aim_height"])
            name = _due(float(step.state.since_event[row]), facts["flight"])
            if name and (episode, name) not in maps:
                hand: Literal["left", "right"] = "left" if facts["aim_lateral"] > 0 else "right"
                grid, carry = hand_grid(hand), step.carry.row(row)
                action = torch.as_tensor(step.decision.action[row : row + 1]).to(carry.h)
                model, planner = artifact.world_model, artifact.planner
                values = value_map(model, carry, action, hand, grid, planner)[0]
                found = values.double().cpu().numpy()
                z, x = np.unravel_index(int(found.argmax()), found.shape)
                best = (float(grid.x[x]), float(grid.z[z]))
                reach = _reach(step.sent_before[row], hand)
                tick = int(step.tick[row])
                maps[episode, name] = _Map(episode, name, tick, hand, found, best, reach)
    return list(maps.values()), aims


def _reach(last: Array, hand: Literal["left", "right"]) -> tuple[list[float], list[float]]:
    """Least and largest x, and z, m, of a hand one step after the action ``last`` (7,)."""
    ends = np.clip([last - ACTION_RATE_LIMIT, last + ACTION_RATE_LIMIT], -1.0, 1.0)
    x, _, z = HAND_AXES[hand]
    metric = ACTION_BOX.to_metric(ends)
    return metric[:, x].tolist(), metric[:, z].tolist()


def _due(since: float, flight: float) -> str:
    """The map that is due in this tick, or nothing."""
    for name, at in zip(MOMENTS, (-BEFORE_S, *(s * flight for s in SHARES)), strict=True):
        if at - 1e-6 <= since < at + PLANNER_DT - 1e-6:
            return name
    return ""


def measure(config: ValueMapsConfig) -> None:
    """Play, and write the maps."""
    config.require_task(("ball",))
    artifact = config.load()
    maps, aims = _record(artifact, config)
    scale = float(artifact.world_model.return_std)
    config.write(
        {"summary": _summary(maps, aims, scale), **_shown(maps, aims), "return_std": scale}
    )


def _summary(maps: list[_Map], aims: Aims, scale: float) -> dict[str, dict[str, Any]]:
    """Moment -> means over episodes."""
    summary: dict[str, dict[str, Any]] = {}
    for name in MOMENTS:
        found = [m for m in maps if m.moment == name]
        if found:
            spread = [float(np.ptp(m.values)) / scale for m in found]
            height = [abs(m.best[1] - aims[m.episode][1]) for m in found]
            summary[name] = {
                "episodes": len(found),
                "spread": float(np.mean(spread)),
                "height_error_m": float(np.mean(height)),
            }
    return summary


def _shown(maps: list[_Map], aims: Aims) -> dict[str, Any]:
    """The maps of the episode whose last map has the largest spread."""
    if not maps:
        return {"maps": []}
    spread = {m.episode: float(np.ptp(m.values)) for m in maps}  # the last map counts
    chosen = max(sorted(spread), key=spread.__getitem__)
    shown = [m for m in maps if m.episode == chosen]
    grid = hand_grid(shown[0].hand)
    names = ("moment", "tick", "hand", "best", "reach")
    return {
        "x": grid.x.tolist(),
        "z": grid.z.tolist(),
        "aim": list(aims[chosen]),
        "maps": [
            {"values": m.values.tolist(), **{name: getattr(m, name) for name in names}}
            for m in shown
        ],
    }


main = study.make_main("value_maps", ValueMapsConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
