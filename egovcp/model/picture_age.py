"""How much older than the proprioception beside it a picture is, from the floor it shows.

A camera's latency differs from one robot and driver to the next, and half a picture's time matters:
a robot that sways by 0.3 rad/s sees a ball 3 m away 2 cm beside its place for each 20 ms. So there
are several guesses, `FlightConfig.picture_ages`. Under the right one the floor lies still, whatever
the robot does; its height h_t under each guess is measured in two halves of each picture, and the
squared deviations from its mean, forgotten with time, share the belief among the guesses:

    share_a  ~  exp(-S_a / (2 sigma^2)),   S_a = sum_t lambda^(now - t) (h_t - mean)^2

Where no floor is seen all of them are believed alike.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor

from egovcp import spec
from egovcp.model.config import AGES, FlightConfig
from egovcp.model.floor import LEVEL, Floor
from egovcp.model.kept import constant

SIZE: Final = 1 + 2 + 2 * 2 * AGES
"""Numbers of the evidence: ticks since the episode began, up to two; for each half of a picture how
often the floor was seen, and for each age and half the sums of its height and of its square."""
_COUNTS: Final = slice(1, 3)
_HEIGHTS: Final = slice(3, 3 + 2 * AGES)
_SQUARES: Final = slice(3 + 2 * AGES, SIZE)


class Poses(NamedTuple):
    """Of the camera when (N, T) pictures were taken, for each age."""

    axes: Tensor  # (N, T, A, 3, 3) in the frame that stays put
    position: Tensor  # (N, T, A, 3) m

    def place(self, point: Tensor) -> Tensor:
        """(N, T, 3) m, camera frame -> (N, T, A, 3) in the frame that stays put."""
        seen: Tensor = (self.axes @ point[..., None, :, None])[..., 0] + self.position
        return seen


def at_ages(poses: Tensor, config: FlightConfig) -> Poses:
    """Interpolated from (N, T, 3, 12), axes and position of now, a tick ago and two ticks ago."""
    ticks = (age / spec.PLANNER_DT for age in config.picture_ages)
    parts = tuple((1 - t, t, 0.0) if t <= 1 else (0.0, 2 - t, t - 1) for t in ticks)
    then = constant(parts, poses) @ poses  # (N, T, A, 12)
    axes = then[..., :9]
    return Poses(axes.reshape(*axes.shape[:-1], 3, 3), then[..., 9:])


def gathered(
    evidence: Tensor, then: Poses, floor: Floor, first: Tensor, config: FlightConfig
) -> Tensor:
    """The evidence (N, T, `SIZE`) after each of T pictures, (N, `SIZE`) before the first of them.

    Args:
        evidence: of the tick before.
        then: where the camera was.
        floor: (N, T, ...) what it showed.
        first: (N, T) bool, an episode begins.
        config: of the filter.
    """
    # (N, T, A, 2): height of the floor in either half, above where it should be
    up = then.axes[..., None, 2, :]
    height = (up * floor.point[:, :, None]).sum(-1) + then.position[..., 2:] - LEVEL
    seen = floor.seen[:, :, None]
    new = torch.cat([seen, height * seen, height.square() * seen], 2).flatten(2)
    ticks, sums = evidence[:, :1], evidence[:, 1:]
    found = []
    for begins, more in zip(first.unbind(1), new.unbind(1), strict=True):
        ticks = (ticks + 1.0).clamp_max(2.0).masked_fill(begins[:, None], 0.0)
        known = ticks >= 2.0  # the pose of two ticks ago is one of this episode
        sums = config.age_memory * sums.masked_fill(begins[:, None], 0.0) + more * known
        found.append(torch.cat([ticks, sums], -1))
    return torch.stack(found, 1)


def shares(evidence: Tensor, config: FlightConfig) -> Tensor:
    """How far each age is believed, (..., A), sum 1, from (..., `SIZE`)."""
    count = evidence[..., _COUNTS].clamp_min(1e-6)[..., None, :]
    total, squares = (
        evidence[..., part].reshape(*evidence.shape[:-1], AGES, 2) for part in (_HEIGHTS, _SQUARES)
    )
    deviation = (squares - total.square() / count).sum(-1)
    return torch.softmax(-deviation / (2 * config.age_deviation**2), -1)
