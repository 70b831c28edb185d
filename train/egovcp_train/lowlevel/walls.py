"""Walls at which robots are pushed in training; most of them brace with their hands."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.geometry import rotation_matrix
from egovcp.spec import ACTION_BOX, CONTROLLER_HZ
from egovcp_train.lowlevel.commands import Commands, between, horizontal
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.physics import NO_WALL, Snapshot
from egovcp_train.lowlevel.sensing import heading, to_heading_xy

Array = NDArray[np.float64]

NO_WALL_DISTANCE: Final = 2.0
"""m, what the critic gets as the distance of a wall that is farther or absent."""
_DISTANCE: Final = (0.55, 0.80)  # m, from the pelvis to the wall at the push
_CLEARANCE: Final = 0.08  # m, at least, from the foremost palm to the wall at the push
_BRACING: Final = 0.7  # share of the robots that brace; the hands of the others move on
_REACTION: Final = (0.08, 0.20)  # s from the push until the hands are commanded to the wall
_RELEASE: Final = (0.8, 4.0)  # s from the push until they are commanded back
_REST: Final = (1.0, 2.0)  # s from then until the wall is removed
_BEARING: Final = 0.25  # rad off straight ahead, of the push
_YAW: Final = 0.15  # rad, of the wall
_ASIDE: Final = (0.12, 0.28)  # m, hand targets left and right
_UP: Final = (-0.05, 0.25)  # m, hand targets above the pelvis
_PRESS: Final = (0.0, 0.08)  # m, hand targets behind the wall's surface


class Walls:
    """One wall per robot, in the scene from a push until some seconds after it."""

    def __init__(
        self,
        robots: int,
        config: DisturbanceConfig,
        commands: Commands,
        rng: np.random.Generator,
    ) -> None:
        self._config, self._commands, self._rng = config, commands, rng
        self.position: Array = np.tile(np.asarray(NO_WALL), (robots, 1))
        """(N, 3) m, a point of the surface on the floor, world frame."""
        self.yaw: Array = np.zeros(robots)
        """(N,) rad, of the horizontal normal that points into the wall."""
        self._since = np.zeros(robots)  # s since the push
        self._times = np.zeros((robots, 3))  # s since the push: hands go, return, wall goes
        self._hands = np.zeros((robots, 3))  # m, aside, up, press
        self.active: NDArray[np.bool_] = np.zeros(robots, dtype=np.bool_)
        """(N,) robots before a wall."""

    def remove(self, rows: NDArray[np.intp]) -> None:
        """Take the walls of ``rows`` away."""
        self.active[rows] = False
        self.position[rows] = NO_WALL

    def push(
        self, rows: NDArray[np.intp], x: Snapshot, difficulty: float
    ) -> tuple[NDArray[np.bool_], Array]:
        """Put walls before some of the standing robots of ``rows``.

        Returns:
            (n,) which of ``rows`` are pushed at a wall; (n, 2) the velocity in m/s to add to those.
        """
        rng, n = self._rng, len(rows)
        chosen = self._commands.standing[rows] & (rng.random(n) < self._config.wall)
        chosen &= ~self.active[rows]
        ahead = heading(rotation_matrix(x.quaternion[rows]))
        facing = np.arctan2(ahead[:, 1], ahead[:, 0])
        palms = to_heading_xy(x.palms[rows] - x.position[rows][:, None], ahead)[..., 0].max(axis=1)
        distance = np.maximum(rng.uniform(*_DISTANCE, n), palms + _CLEARANCE)
        chosen &= np.isfinite(distance)
        surface = np.concatenate(
            [x.position[rows, :2] + distance[:, None] * ahead, np.zeros((n, 1))], axis=1
        )
        yaw = facing + rng.uniform(-_YAW, _YAW, n)
        speed = rng.uniform(*between(*self._config.wall_push, difficulty), n)
        kick = horizontal(speed, facing + rng.uniform(-_BEARING, _BEARING, n))
        go = np.where(rng.random(n) < _BRACING, rng.uniform(*_REACTION, n), np.inf)
        back = rng.uniform(*_RELEASE, n)
        times = np.stack([go, back, back + rng.uniform(*_REST, n)], axis=1)
        hands = np.stack([rng.uniform(*r, n) for r in (_ASIDE, _UP, _PRESS)], axis=1)
        at = rows[chosen]
        self.position[at], self.yaw[at] = surface[chosen], yaw[chosen]
        self._times[at], self._hands[at] = times[chosen], hands[chosen]
        self._since[at], self.active[at] = 0.0, True
        self._commands.keep_commands(at, times[chosen, 2])
        return chosen, kick

    def advance(self, x: Snapshot) -> None:
        """One controller tick: command bracing hands, remove walls that have been there enough."""
        if not self.active.any():
            return
        rows = np.flatnonzero(self.active)
        before = self._since[rows]
        self._since[rows] = since = before + 1 / CONTROLLER_HZ
        go, back, end = self._times[rows].T
        presses = (since >= go) & (since < back)
        returns = (since >= back) & (before < back) & np.isfinite(go)
        if presses.any():
            at = rows[presses]
            self._commands.move_hands(at, self._targets(at, x))
        if returns.any():
            self._commands.move_hands(rows[returns], np.zeros((int(returns.sum()), 6)))
        self.remove(rows[since >= end])

    def _targets(self, rows: NDArray[np.intp], x: Snapshot) -> Array:
        """(n, 6) hand targets on the walls, normalised."""
        ahead = heading(rotation_matrix(x.quaternion[rows]))
        normal = self._normal[rows]
        forward = (
            self._gap(x)[rows] / np.maximum((ahead * normal).sum(axis=1), 0.1)
            + self._hands[rows, 2]
        )
        aside, up = self._hands[rows, 0], self._hands[rows, 1]
        metric = np.tile(np.asarray(ACTION_BOX.neutral), (len(rows), 1))
        metric[:, :6] = np.stack([forward, aside, up, forward, -aside, up], axis=1)
        normalised = ACTION_BOX.to_normalised(np.nan_to_num(metric))[:, :6]
        return np.asarray(np.clip(normalised, -1.0, 1.0))

    def distance(self, x: Snapshot) -> Array:
        """(N,) m from pelvis to wall; `NO_WALL_DISTANCE` if it is farther or absent."""
        near = np.clip(self._gap(x), 0.0, NO_WALL_DISTANCE)
        return np.where(self.active, near, NO_WALL_DISTANCE)

    @property
    def _normal(self) -> Array:
        """(N, 2) horizontal unit vectors into the walls."""
        return np.stack([np.cos(self.yaw), np.sin(self.yaw)], axis=1)

    def _gap(self, x: Snapshot) -> Array:
        """(N,) m from pelvis to wall; meaningless where there is none."""
        return np.asarray(((self.position[:, :2] - x.position[:, :2]) * self._normal).sum(axis=1))
