"""The path of what is thrown at the robot, followed from picture to picture.

What flies free moves as x(t) = p + v t + g t^2 / 2. A recurrent network has to learn this, and to
take the robot's own turning and swaying out of what it sees; it does so slowly (docs/log.md). Here
both are written down. The encoder says where in each picture the thing is
(`WorldModel.sight`); the pixels around that place say it to a fraction of a pixel; proprioception
says where the camera was (`egovcp.model.camera_pose`); and the sums of a weighted least-squares fit
with a prior are the memory:

    argmin_{p, v}  sum_i w_i |p + v t_i - (x_i - g t_i^2 / 2)|^2  +  prior(p, v)

one axis at a time. Nothing here is trained but the prior's statistics; nothing passes gradients.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import torch
from torch import Tensor

from egovcp import spec
from egovcp.model.camera_pose import CameraPose
from egovcp.model.config import FlightConfig

GRAVITY: Final = 9.81  # m/s^2
TOLD: Final = slice(0, 4)
"""What a memory (..., `SIZE`) tells: how sure its path is (0: nothing is on its way; 1: quite);
y and z (m) where it will cross the plane before the pelvis, heading frame, z from the neutral
height of the pelvis; time left (s). What is unsure lies near the mean of all throws."""
_SEEN, _SINCE, _LOST, _YAW = range(4, 8)  # sightings; s since the first and last; rad
_AXES, _POSITION = slice(8, 17), slice(17, 20)  # of the camera at the last tick
_SUMS, _PLACES, _MOMENTS = slice(20, 23), slice(23, 26), slice(26, 29)
SIZE: Final = 29
_DT: Final = spec.PLANNER_DT
_MIN_PIXELS: Final = 2
_MANY: Final = 32  # pictures among which it pays to pick; graphs are traced with fewer
_LEAST_SPEED: Final = 1.0  # m/s towards the robot
_BEHIND: Final = -0.08  # s, the time left at which it has passed


class Sighting(NamedTuple):
    """What N pictures show."""

    point: Tensor  # (N, 3) m, camera frame (forward, left, up), the middle of the thing; else 0
    weight: Tensor  # (N,) 1 / m^2; 0: nothing is seen


def sighting(near: Tensor, sight: Tensor, max_m: float, config: FlightConfig) -> Sighting:
    """Where a thing is, from where the encoder sees it and the pixels around that place.

    Args:
        near: (N, H, W) nearness.
        sight: (N, 4), see `WorldModel.sight`.
        max_m: depth at which nearness is 0, m.
        config: of the filter.
    """
    seen = torch.sigmoid(sight[:, 3]) > 0.5
    if len(sight) < _MANY:
        found = _measured(near, sight, max_m, config)
        point = torch.where(seen[:, None], found.point, 0.0)
        return Sighting(point, torch.where(seen, found.weight, 0.0))
    point, weight = sight.new_zeros(len(sight), 3), sight.new_zeros(len(sight))
    rows = seen.nonzero()[:, 0]  # most pictures show nothing that flies
    point[rows], weight[rows] = _measured(near[rows], sight[rows], max_m, config)
    return Sighting(point, weight)


def _measured(near: Tensor, sight: Tensor, max_m: float, config: FlightConfig) -> Sighting:
    """The thing that each picture is held to show."""
    height, width = near.shape[-2:]
    focal = height / 2 / config.camera.half_height
    row, col = _slopes(height, focal, near.device)[:, None], _slopes(width, focal, near.device)
    x = (1 - sight[:, 2]).clamp(0.05, 1.0) * max_m + config.radius
    left = -sight[:, 0] * (width - 1) / 2 / focal * x
    up = -sight[:, 1] * (height - 1) / 2 / focal * x
    guess = torch.stack([x, left, up], -1)
    x, left, up = (v[:, None, None] for v in (x, left, up))
    z = (1 - near) * max_m + config.radius
    away = (col * x + left).square() + (row * x + up).square()
    own = (near > 0) & ((z - x).abs() < config.search) & (away < config.search**2)
    own = own.to(near.dtype)
    count = own.sum((1, 2))
    mean = [(own * v).sum((1, 2)) / count.clamp_min(1) for v in (z, -z * col, -z * row)]
    cut = own[:, [0, -1]].sum((1, 2)) + own[:, :, [0, -1]].sum((1, 2))  # its middle is lost
    found = (count >= _MIN_PIXELS) & (cut == 0)
    point = torch.where(found[:, None], torch.stack(mean, -1), guess)
    deviation = config.deviation * point[:, 0].clamp_min(1.0) * torch.where(found, 1.0, 2.5)
    return Sighting(point, torch.sigmoid(sight[:, 3]) / deviation.square())


@cache
def _slopes(pixels: int, focal: float, device: torch.device) -> Tensor:
    """(pixels,) by how much each one's ray leads sideways per metre ahead."""
    with torch.inference_mode(False):  # what is kept may be wanted elsewhere
        return (torch.arange(pixels, device=device) - (pixels - 1) / 2) / focal


def follow(
    memory: Tensor,
    pose: CameraPose,
    seen: Sighting,
    first: Tensor,
    config: FlightConfig,
) -> Tensor:
    """One tick: the memory (N, `SIZE`) after a picture; N rows of what `follow_all` takes."""
    poses = CameraPose(*(x[:, None] for x in pose))
    pictures = Sighting(*(x[:, None] for x in seen))
    return follow_all(memory, poses, pictures, first[:, None], config)[:, 0]


def follow_all(
    memory: Tensor,
    pose: CameraPose,
    seen: Sighting,
    first: Tensor,
    config: FlightConfig,
) -> Tensor:
    """The memories (N, T, `SIZE`) after each of T pictures.

    Only the sums go from tick to tick; what does not depend on them is computed for all ticks at
    once, since N is small and what an operation costs is mostly its call.

    Args:
        memory: (N, `SIZE`) of the tick before.
        pose: (N, T, ...) of the camera; the picture is `FlightConfig.picture_age` older.
        seen: (N, T, ...) what the pictures show.
        first: (N, T) bool, an episode begins: nothing is remembered.
        config: of the filter.
    """
    yaw = _turned_by(memory[:, _YAW], pose.yaw_rate, first)
    turn = _about_vertical(yaw.flatten()).view(*yaw.shape, 3, 3)
    axes = (turn @ pose.axes).flatten(-2)
    position = (turn @ pose.position[..., None])[..., 0]
    then_axes = _at_picture(axes, memory[:, _AXES], first, config)
    then_position = _at_picture(position, memory[:, _POSITION], first, config)
    turned = (then_axes.view(*yaw.shape, 3, 3) @ seen.point[..., None])[..., 0]
    place = turned + then_position

    tracks, on = _tracks(memory, place, seen.weight, first, yaw, config)
    told = _told(tracks.flatten(0, 1), yaw.flatten(), config).view(*yaw.shape, 4)
    told = torch.where(on[..., None], told, 0.0)
    marks, sums = tracks[..., 1:4], tracks[..., 4:]
    return torch.cat([told, marks, yaw[..., None], axes, position, sums], -1)


def _turned_by(yaw: Tensor, rate: Tensor, first: Tensor) -> Tensor:
    """Heading (N, T), rad, since the episode began or the memory, from what it was (N,)."""
    found = []
    for step, new in zip((rate * _DT).unbind(1), first.unbind(1), strict=True):
        yaw = (yaw + step).masked_fill(new, 0.0)
        found.append(yaw)
    return torch.stack(found, 1)


def _at_picture(x: Tensor, before: Tensor, first: Tensor, config: FlightConfig) -> Tensor:
    """What (N, T, k) was when the pictures were taken, from it and from the (N, k) of the tick
    before the first."""
    before = torch.cat([before[:, None], x[:, :-1]], 1)
    before = torch.where(first[..., None], x, before)
    return x + config.picture_age / _DT * (before - x)


def _tracks(
    memory: Tensor,
    place: Tensor,
    weight: Tensor,
    first: Tensor,
    yaw: Tensor,
    config: FlightConfig,
) -> tuple[Tensor, Tensor]:
    """What goes from tick to tick, of places (N, T, 3) that are seen with a weight (N, T).

    Returns:
        (N, T, 13) time left, sightings, time since the first and since the last of them, and the
        sums of the fit; and (N, T) bool, whether anything is on its way.
    """
    prior = memory.new_tensor(config.prior)  # (3, 5)
    tick = memory.new_tensor([-_DT, 0.0, _DT, _DT, *[0.0] * 9])
    fall = memory.new_tensor([0.0, 0.0, 0.5 * GRAVITY])
    heading = torch.stack([yaw.cos(), yaw.sin()], -1)
    track = torch.cat([memory[:, 3:4], memory[:, _SEEN : _LOST + 1], memory[:, _SUMS.start :]], -1)
    p, v = _solve(memory[:, _SUMS], memory[:, _PLACES], memory[:, _MOMENTS], prior)
    found, coming = [], []
    for new, now, gain, ahead in zip(
        *(x.unbind(1) for x in (first, place, weight, heading)), strict=True
    ):
        track = track.masked_fill(new[:, None], 0.0) + tick
        left, count, since, lost = track[:, :4].unbind(-1)
        over = (count > 0) & ((left < 1.5 * _BEHIND) | (lost > config.forget))
        track = track.masked_fill(over[:, None], 0.0)
        _, count, since, lost = track[:, :4].unbind(-1)
        since = since * (count > 0)
        # Where there is no path yet, or no longer, the path of before says nothing.
        straight = torch.addcmul(now, fall, (since * since)[:, None])
        off = straight - torch.addcmul(p, v, since[:, None])
        own = gain * ((off.norm(dim=-1) < config.gate) | (count < 3))
        powers = torch.stack([own, own * since, own * since * since], -1)
        more = [powers, powers[:, :1] * straight, powers[:, 1:2] * straight]
        sums = track[:, 4:] + torch.cat(more, -1)
        p, v = _solve(sums[:, :3], sums[:, 3:6], sums[:, 6:], prior)
        seen = own > 0
        count = count + seen
        left = _time_left(p, v, since + config.picture_age, ahead, config.plane)
        on = (count > 0) & (left > _BEHIND)
        marks = torch.stack([left * on, count, since, lost.masked_fill(seen, 0.0)], -1)
        track = torch.cat([marks, sums], -1)
        found.append(track)
        coming.append(on)
    return torch.stack(found, 1), torch.stack(coming, 1)


def _time_left(p: Tensor, v: Tensor, t: Tensor, heading: Tensor, plane: float) -> Tensor:
    """(N,) s until a path that is at time ``t`` crosses the plane before (N, 2) the heading."""
    x = (torch.addcmul(p, v, t[:, None])[:, :2] * heading).sum(-1)
    speed = (v[:, :2] * heading).sum(-1)
    return ((plane - x) / speed.clamp_max(-_LEAST_SPEED)).clamp(-1.0, 1.5)


def _told(track: Tensor, yaw: Tensor, config: FlightConfig) -> Tensor:
    """`TOLD` (N, 4) of (N, 13) `_tracks`."""
    prior = track.new_tensor(config.prior)
    left, since, sums = track[:, 0], track[:, 2], track[:, 4:7]
    p, v = _solve(sums, track[:, 7:10], track[:, 10:], prior)
    t = since + config.picture_age
    place = _crossing(p, v, t, left, yaw)
    sure, place = _believed(place, _variance(sums, prior, t + left), config)
    return torch.cat([sure, place, left[:, None]], -1)


def _fallen(place: Tensor, t: Tensor, sign: float) -> Tensor:
    """(N, 3) with (``sign`` 1) the fall of (N,) s taken out, or (-1) put in."""
    fall = sign * 0.5 * GRAVITY * t * t
    return torch.cat([place[:, :2], place[:, 2:] + fall[:, None]], -1)


def _solve(sums: Tensor, places: Tensor, moments: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Place and velocity (N, 3) at the first sighting."""
    place, speed, a, b, c = prior.unbind(-1)  # (3,) each
    m00, m01, m11 = (sums[..., None] + prior[:, 2:].T).unbind(-2)
    r0, r1 = places + (a * place + b * speed), moments + (b * place + c * speed)
    det = m00 * m11 - m01 * m01
    return (m11 * r0 - m01 * r1) / det, (m00 * r1 - m01 * r0) / det


def _crossing(p: Tensor, v: Tensor, t: Tensor, left: Tensor, yaw: Tensor) -> Tensor:
    """(N, 2): y and z (m) of the path (N,) s after time ``t``."""
    back = _about_vertical(-yaw)
    now = (back @ _fallen(p + v * t[:, None], t, -1.0)[..., None])[..., 0]
    speed = (back @ v[..., None])[..., 0]
    y = now[:, 1] + speed[:, 1] * left
    z = now[:, 2] + (speed[:, 2] - GRAVITY * t) * left - 0.5 * GRAVITY * left * left
    return torch.stack([y, z], -1)


def _variance(sums: Tensor, prior: Tensor, t: Tensor) -> Tensor:
    """(N, 2) m^2 of y and z at (N,) s after the first sighting."""
    m00, m01, m11 = (
        s[:, None] + x for s, x in zip(sums.unbind(-1), prior[1:, 2:].unbind(-1), strict=True)
    )
    t = t[:, None]
    variance: Tensor = (m11 - 2 * t * m01 + t * t * m00) / (m00 * m11 - m01 * m01)
    return variance


def _believed(crossing: Tensor, variance: Tensor, config: FlightConfig) -> tuple[Tensor, Tensor]:
    """How sure a crossing (N, 2) is, (N, 1), and where, drawn towards the mean of all throws."""
    mean, deviation = crossing.new_tensor(config.aim).unbind(-1)
    sure = 1.0 / (1.0 + config.doubt * variance / deviation.square())
    return sure[:, :1], mean + sure * (crossing - mean).clamp(-1.0, 1.0)


def _about_vertical(angle: Tensor) -> Tensor:
    """(N,) rad -> (N, 3, 3)."""
    c, s, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def later(memory: Tensor, ticks: int = 1) -> Tensor:
    """The memory (..., n) that many ticks later, if nothing is seen meanwhile."""
    left = memory[..., 3:4] - ticks * _DT
    told = torch.cat([memory[..., :3], left], -1)
    told = torch.where((memory[..., :1] > 0) & (left > _BEHIND), told, 0.0)
    passed = memory[..., _SINCE : _LOST + 1] + ticks * _DT
    return torch.cat([told, memory[..., 4:_SINCE], passed, memory[..., _LOST + 1 :]], -1)


def in_picture(memory: Tensor, pose: CameraPose, max_m: float, config: FlightConfig) -> Tensor:
    """Where a camera sees it, if the robot has not turned since the last picture.

    Args:
        memory: (N, `SIZE`).
        pose: of the camera when the picture is taken.
        max_m: depth at which nearness is 0, m.
        config: of the filter.

    Returns:
        (N, 4) as `WorldModel.motion`: column and row in half pictures from the middle, nearness of
        its surface, log-odds that it is there; below 0 where its path is not known.
    """
    prior = memory.new_tensor(config.prior)
    since, turn = memory[:, _SINCE], _about_vertical(memory[:, _YAW])
    p, v = _solve(memory[:, _SUMS], memory[:, _PLACES], memory[:, _MOMENTS], prior)
    place = _fallen(p + v * since[:, None], since, -1.0)
    from_camera = place - (turn @ pose.position[..., None])[..., 0]
    x, left, up = ((turn @ pose.axes).mT @ from_camera[..., None])[..., 0].unbind(-1)
    half_width = config.camera.half_height * spec.DEPTH_COLS / spec.DEPTH_ROWS
    x = x.clamp_min(config.radius)
    column, row = -left / (x * half_width), -up / (x * config.camera.half_height)
    inside = (x > 2 * config.radius) & (column.abs() < 1) & (row.abs() < 1)
    known = inside & (memory[:, 0] > config.painted)
    return torch.stack([column, row, 1 - (x - config.radius) / max_m, known * 40.0 - 20.0], -1)


def told(memory: Tensor, unit: tuple[float, float, float]) -> Tensor:
    """`TOLD` (..., 4) of a memory (..., n), in units."""
    return torch.cat([memory[..., :1], memory[..., 1:4] / memory.new_tensor(unit)], -1)
