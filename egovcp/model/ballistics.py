"""Free flight, fitted: x(t) = p + v t + g t^2 / 2, one axis at a time, with a prior.

    argmin_{p, v}  sum_i w_i |p + v t_i - (x_i - g t_i^2 / 2)|^2  +  prior(p, v)

`egovcp.model.flight` says what is seen when, and from where.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from egovcp.model.config import FlightConfig
from egovcp.model.kept import constant

GRAVITY: Final = 9.81  # m/s^2
_LEAST_SPEED: Final = 1.0  # m/s towards the robot


def time_left(p: Tensor, v: Tensor, t: Tensor, heading: Tensor, plane: float) -> Tensor:
    """(N,) s until a path that is at time ``t`` crosses the plane before (N, 2) the heading."""
    x = (torch.addcmul(p, v, t[:, None])[:, :2] * heading).sum(-1)
    speed = (v[:, :2] * heading).sum(-1)
    return ((plane - x) / speed.clamp_max(-_LEAST_SPEED)).clamp(-1.0, 1.5)


def fallen(place: Tensor, t: Tensor, sign: float) -> Tensor:
    """(N, 3) with (``sign`` 1) the fall of (N,) s taken out, or (-1) put in."""
    fall = sign * 0.5 * GRAVITY * t * t
    return torch.cat([place[:, :2], place[:, 2:] + fall[:, None]], -1)


def solve(sums: Tensor, places: Tensor, moments: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Place and velocity (N, 3) at the first sighting."""
    place, speed, a, b, c = prior.unbind(-1)  # (3,) each
    m00, m01, m11 = (sums[..., None] + prior[:, 2:].T).unbind(-2)
    r0, r1 = places + (a * place + b * speed), moments + (b * place + c * speed)
    det = m00 * m11 - m01 * m01
    return (m11 * r0 - m01 * r1) / det, (m00 * r1 - m01 * r0) / det


def crossing(p: Tensor, v: Tensor, t: Tensor, left: Tensor, yaw: Tensor) -> Tensor:
    """(N, 2): y and z (m) of the path (N,) s after time ``t``."""
    back = about_vertical(-yaw)
    now = (back @ fallen(p + v * t[:, None], t, -1.0)[..., None])[..., 0]
    speed = (back @ v[..., None])[..., 0]
    y = now[:, 1] + speed[:, 1] * left
    z = now[:, 2] + (speed[:, 2] - GRAVITY * t) * left - 0.5 * GRAVITY * left * left
    return torch.stack([y, z], -1)


def variance(sums: Tensor, prior: Tensor, t: Tensor) -> Tensor:
    """(N, 2) m^2 of y and z at (N,) s after the first sighting."""
    m00, m01, m11 = (
        s[:, None] + x for s, x in zip(sums.unbind(-1), prior[1:, 2:].unbind(-1), strict=True)
    )
    t = t[:, None]
    variance: Tensor = (m11 - 2 * t * m01 + t * t * m00) / (m00 * m11 - m01 * m01)
    return variance


def believed(crossing: Tensor, variance: Tensor, config: FlightConfig) -> tuple[Tensor, Tensor]:
    """How sure a crossing (N, 2) is, (N, 1), and where, drawn towards the mean of all throws."""
    mean, deviation = constant(config.aim, crossing).unbind(-1)
    sure = 1.0 / (1.0 + config.doubt * variance / deviation.square())
    return sure[:, :1], mean + sure * (crossing - mean).clamp(-1.0, 1.0)


def about_vertical(angle: Tensor) -> Tensor:
    """(N,) rad -> (N, 3, 3)."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
