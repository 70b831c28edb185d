"""Where a hand is worth most, in its x-z plane, as the ball comes nearer (figure 7a).

Maps are taken before the throw and when given shares of the flight have passed, of the hand on
whose side the ball will arrive. One episode is kept whole; of all of them the spread of the map
(best minus worst) and the distance from its best point to where the ball will pass are averaged:
a model that sees the ball coming has a map that changes, and whose best point moves to it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.plan import hand_grid, value_map
from egovcp.sim.scenario import Scenario
from egovcp.spec import PLANNER_DT
from egovcp_experiment.studies.study import finish
from egovcp_experiment.studies.watching import Moment, WatchConfig, Watcher, watch

PROG: Final = "python -m egovcp_experiment.studies.value_maps"
#: When a map is taken: seconds before the throw, and shares of the flight since.
BEFORE_S: Final = 0.4
SHARES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
MOMENTS: Final = ("before", *(f"{share:.0%}" for share in SHARES))


@dataclass(frozen=True)
class ValueMapsConfig(WatchConfig):
    """Value maps of a hand while the ball flies."""


@dataclass(frozen=True)
class _Map:
    """One robot at one moment."""

    episode: int
    moment: str
    tick: int
    hand: Literal["left", "right"]
    values: NDArray[np.float64]  # (n, m) over z, x
    target: tuple[float, float]  # planned hand target, x and z, box units
    ball: tuple[float, float] | None  # x, z before the pelvis, m


class _Maps(Watcher):
    """Takes the maps when their moment has come."""

    def __init__(self) -> None:
        self.maps: list[_Map] = []
        self.aims: dict[int, tuple[float, float]] = {}

    def begin(self, scenarios: Sequence[Scenario]) -> None:
        self._episodes = [scenario.episode for scenario in scenarios]
        self._taken: list[set[str]] = [set() for _ in scenarios]

    def before(self, moment: Moment) -> None:
        truth = moment.env.privileged_state()
        for row in np.flatnonzero(moment.live).tolist():
            facts = moment.env.parameters[row]
            self.aims[self._episodes[row]] = (facts["aim_lateral"], facts["aim_height"])
            name = self._due(float(truth.since_event[row]), facts["flight"], self._taken[row])
            if name:
                self._taken[row].add(name)
                self.maps.append(self._map(moment, row, name, truth.object_b[row]))

    @staticmethod
    def _due(since: float, flight: float, taken: set[str]) -> str:
        """The moment that has just come, if one has and was not taken yet."""
        times = {"before": -BEFORE_S} | {f"{s:.0%}": s * flight for s in SHARES}
        for name, at in times.items():
            if name not in taken and at - 1e-6 <= since < at + PLANNER_DT - 1e-6:
                return name
        return ""

    def _map(self, moment: Moment, row: int, name: str, ball: NDArray[np.float64]) -> _Map:
        hand: Literal["left", "right"] = (
            "left" if moment.env.parameters[row]["aim_lateral"] > 0 else "right"
        )
        carry = moment.policy.carry.row(row)
        action = torch.as_tensor(moment.step.action[row : row + 1]).to(carry.h)
        values = value_map(moment.policy.model, carry, action, hand, hand_grid(hand))
        first = 0 if hand == "left" else 3
        target = moment.step.action[row, [first, first + 2]]
        return _Map(
            self._episodes[row],
            name,
            int(moment.env.tick[row]),
            hand,
            values[0].double().cpu().numpy(),
            (float(target[0]), float(target[1])),
            (float(ball[0]), float(ball[2])) if np.isfinite(ball).all() else None,
        )


def measure(config: ValueMapsConfig) -> None:
    """Play, and write the maps."""
    if config.task != "ball":
        raise UsageError(f"--task={config.task}: expected ball, the task with something to meet")
    artifact = config.artifact()
    maps = _Maps()
    watch(artifact, config.env, config, maps)
    scale = float(artifact.world_model.return_std)
    finish(config, {"summary": _summary(maps, scale), **_shown(maps), "return_std": scale})


def _summary(maps: _Maps, scale: float) -> dict[str, dict[str, Any]]:
    """Moment -> means over episodes."""
    out: dict[str, dict[str, Any]] = {}
    for name in MOMENTS:
        found = [m for m in maps.maps if m.moment == name]
        if found:
            spread = [float(np.ptp(m.values)) / scale for m in found]
            height = [abs(_best(m)[1] - maps.aims[m.episode][1]) for m in found]
            out[name] = {
                "episodes": len(found),
                "spread": float(np.mean(spread)),
                "height_error_m": float(np.mean(height)),
            }
    return out


def _best(found: _Map) -> tuple[float, float]:
    """x and z of the best point of a map, m."""
    grid = hand_grid(found.hand)
    z, x = np.unravel_index(int(found.values.argmax()), found.values.shape)
    return float(grid.x[x]), float(grid.z[z])


def _shown(maps: _Maps) -> dict[str, Any]:
    """The maps of the episode in which they change most."""
    episodes = {m.episode for m in maps.maps}
    if not episodes:
        return {"maps": []}
    last = {m.episode: float(np.ptp(m.values)) for m in maps.maps}
    chosen = max(sorted(episodes), key=lambda e: last[e])
    shown = [m for m in maps.maps if m.episode == chosen]
    grid = hand_grid(shown[0].hand)
    return {
        "x": grid.x.tolist(),
        "z": grid.z.tolist(),
        "aim": list(maps.aims[chosen]),
        "maps": [
            {
                "moment": m.moment,
                "tick": m.tick,
                "hand": m.hand,
                "values": m.values.tolist(),
                "best": _best(m),
                "ball": m.ball,
            }
            for m in shown
        ],
    }


CONFIG = ValueMapsConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CONFIG, measure, argv, prog=PROG)


if __name__ == "__main__":
    sys.exit(main())
