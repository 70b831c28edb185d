"""The path of what is thrown at the robot, followed from picture to picture.

What flies free moves as x(t) = p + v t + g t^2 / 2. A recurrent network has to learn this, and to
take the robot's own turning and swaying out of what it sees; it does so slowly (docs/log.md). Here
both are written down. The encoder says where in each picture the thing is
(`WorldModel.sight`); the pixels around that place say it to a fraction of a pixel; proprioception
says where the camera was (`egovcp.model.camera_pose`) when the picture was taken
(`egovcp.model.picture_age`); and the sums of a weighted least-squares fit with a prior
(`egovcp.model.ballistics`) are the memory. Nothing here is trained but the prior's statistics;
nothing passes gradients.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import picture_age
from egovcp.model.ballistics import (
    GRAVITY,
    about_vertical,
    believed,
    crossing,
    fallen,
    solve,
    time_left,
    variance,
)
from egovcp.model.camera_pose import CameraPose, camera_pose, earlier
from egovcp.model.config import AGES, FlightConfig
from egovcp.model.floor import Floor
from egovcp.model.kept import constant

TOLD: Final = slice(0, 4)
"""What a memory (..., `SIZE`) tells: how sure its path is (0: nothing is on its way; 1: quite);
y and z (m) where it will cross the plane before the pelvis, heading frame, z from the neutral
height of the pelvis; time left (s). What is unsure lies near the mean of all throws."""
_SEEN, _SINCE, _LOST, _YAW, _RATE = range(4, 9)  # sightings; s since first and last; rad, rad/s
_POSE, _BEFORE = slice(9, 21), slice(21, 33)  # axes and position of the camera, last two ticks
_EVIDENCE = slice(33, 33 + picture_age.SIZE)  # of how old the pictures are
SUMS = slice(_EVIDENCE.stop, _EVIDENCE.stop + 3 + 2 * 3 * AGES)
"""Of the weights, and for each age of the places and their moments."""
SIZE: Final = SUMS.stop
_TICK: Final = (-spec.PLANNER_DT, 0.0, *[spec.PLANNER_DT] * 2, *[0.0] * (SIZE - SUMS.start))
_FALL: Final = (0.0, 0.0, 0.5 * GRAVITY)
_DT: Final = spec.PLANNER_DT
_MIN_PIXELS: Final = 2
_MANY: Final = 32  # pictures among which a processor better picks; graphs are traced with fewer
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
    if len(sight) < _MANY or near.device.type != "cpu":
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
    z = own * z
    sums = [z.sum((1, 2)), -(z.sum(1) * col).sum(1), -(z.sum(2) * row[:, 0]).sum(1)]
    mean = [total / count.clamp_min(1) for total in sums]
    # First and last lines; a list of them in brackets would be copied to a GPU at each call.
    edges = own[:, :: height - 1], own[:, :, :: width - 1]
    cut = sum(edge.sum((1, 2)) for edge in edges)  # its middle is lost
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
    floor: Floor,
    first: Tensor,
    config: FlightConfig,
) -> Tensor:
    """One tick: the memory (N, `SIZE`) after a picture; N rows of what `follow_all` takes."""
    poses = CameraPose(*(x[:, None] for x in pose))
    pictures = Sighting(*(x[:, None] for x in seen))
    ground = Floor(*(x[:, None] for x in floor))
    return follow_all(memory, poses, pictures, ground, first[:, None], config)[:, 0]


def follow_all(
    memory: Tensor,
    pose: CameraPose,
    seen: Sighting,
    floor: Floor,
    first: Tensor,
    config: FlightConfig,
) -> Tensor:
    """The memories (N, T, `SIZE`) after each of T pictures.

    Only the sums go from tick to tick; what does not depend on them is computed for all ticks at
    once, since N is small and what an operation costs is mostly its call.

    Args:
        memory: (N, `SIZE`) of the tick before.
        pose: (N, T, ...) of the camera; the picture is older (`FlightConfig.picture_ages`).
        seen: (N, T, ...) what the pictures show of a thing that flies.
        floor: (N, T, ...) and of the floor.
        first: (N, T) bool, an episode begins: nothing is remembered.
        config: of the filter.
    """
    rate = pose.yaw_rate
    yaw = _turned_by(memory, rate, first)
    turn = about_vertical(yaw.flatten()).view(*yaw.shape, 3, 3)
    axes, position = turn @ pose.axes, (turn @ pose.position[..., None])[..., 0]
    now = torch.cat([axes.flatten(-2), position], -1)  # (N, T, 12)
    before = _one_earlier(now, memory[:, _POSE], first)
    earliest = _one_earlier(before, memory[:, _BEFORE], first)
    then = picture_age.at_ages(torch.stack([now, before, earliest], -2), config)
    evidence = picture_age.gathered(memory[:, _EVIDENCE], then, floor, first, config)
    ages = picture_age.shares(evidence, config)  # (N, T, A)

    tracks, on = _tracks(memory, then.place(seen.point), seen.weight, ages, first, yaw, config)
    told = _told(tracks.flatten(0, 1), ages.flatten(0, 1), yaw.flatten(), config)
    told = torch.where(on[..., None], told.view(*yaw.shape, 4), 0.0)
    marks, sums = tracks[..., 1:4], tracks[..., 4:]
    turning = torch.stack([yaw, rate], -1)
    return torch.cat([told, marks, turning, now, before, evidence, sums], -1)


def _turned_by(memory: Tensor, rate: Tensor, first: Tensor) -> Tensor:
    """Heading (N, T), rad, since the episode began, from rates (N, T), rad/s."""
    yaw, found = memory[:, _YAW], []
    before = torch.cat([memory[:, _RATE : _RATE + 1], rate[:, :-1]], 1)
    steps = 0.5 * _DT * (rate + before)
    for step, new in zip(steps.unbind(1), first.unbind(1), strict=True):
        yaw = (yaw + step).masked_fill(new, 0.0)
        found.append(yaw)
    return torch.stack(found, 1)


def _one_earlier(x: Tensor, before: Tensor, first: Tensor) -> Tensor:
    """What (N, T, k) was a tick earlier, (N, k) before the first of them; as it is where an episode
    begins."""
    return torch.where(first[..., None], x, torch.cat([before[:, None], x[:, :-1]], 1))


def _tracks(
    memory: Tensor,
    place: Tensor,
    weight: Tensor,
    ages: Tensor,
    first: Tensor,
    yaw: Tensor,
    config: FlightConfig,
) -> tuple[Tensor, Tensor]:
    """What goes from tick to tick, of places (N, T, A, 3) that are seen with a weight (N, T).

    There is a fit for each age of the pictures. All of them have the weights, and so the path that
    is likeliest, the mean over ages with their shares (N, T, A), is the solution of mean sums.

    Returns:
        (N, T, 4 + `SUMS`) time left, sightings, time since the first and since the last of them,
        and the sums of the fits; and (N, T) bool, whether anything is on its way.
    """
    prior = constant(config.prior, memory)  # (3, 5)
    tick, fall = constant(_TICK, memory), constant(_FALL, memory)
    heading = torch.stack([yaw.cos(), yaw.sin()], -1)
    old = ages @ constant(config.picture_ages, ages)
    track = torch.cat([memory[:, 3:4], memory[:, _SEEN : _LOST + 1], memory[:, SUMS]], -1)
    found, coming = [], []
    for new, now, gain, share, age, ahead in zip(
        *(x.unbind(1) for x in (first, place, weight, ages, old, heading)), strict=True
    ):
        track = track.masked_fill(new[:, None], 0.0) + tick
        left, count, since, lost = track[:, :4].unbind(-1)
        over = (count > 0) & ((left < 1.5 * _BEHIND) | (lost > config.forget))
        track = track.masked_fill(over[:, None], 0.0)
        _, count, since, lost = track[:, :4].unbind(-1)
        since = since * (count > 0)
        straight = torch.addcmul(now, fall, (since * since)[:, None, None])  # (N, A, 3)
        p, v = _path(track[:, 4:], share, prior)
        # Where there is no path yet, or no longer, the path of before says nothing.
        off = (share[..., None] * straight).sum(1) - torch.addcmul(p, v, since[:, None])
        own = gain * ((off.norm(dim=-1) < config.gate) | (count < 3))
        powers = torch.stack([own, own * since, own * since * since], -1)
        places = straight.flatten(1)
        more = [powers, powers[:, :1] * places, powers[:, 1:2] * places]
        sums = track[:, 4:] + torch.cat(more, -1)
        p, v = _path(sums, share, prior)
        seen = own > 0
        count = count + seen
        left = time_left(p, v, since + age, ahead, config.plane)
        on = (count > 0) & (left > _BEHIND)
        marks = torch.stack([left * on, count, since, lost.masked_fill(seen, 0.0)], -1)
        track = torch.cat([marks, sums], -1)
        found.append(track)
        coming.append(on)
    return torch.stack(found, 1), torch.stack(coming, 1)


def _path(sums: Tensor, share: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Place and velocity (N, 3) at the first sighting, of sums (N, `SUMS`) and shares (N, A)."""
    fits = sums[:, 3:].reshape(-1, 2, share.shape[-1], 3)
    places, moments = (share[:, None, :, None] * fits).sum(2).unbind(1)
    return solve(sums[:, :3], places, moments, prior)


def _told(track: Tensor, share: Tensor, yaw: Tensor, config: FlightConfig) -> Tensor:
    """`TOLD` (N, 4) of (N, 4 + `SUMS`) `_tracks`."""
    prior = constant(config.prior, track)
    left, since, sums = track[:, 0], track[:, 2], track[:, 4:]
    p, v = _path(sums, share, prior)
    t = since + share @ constant(config.picture_ages, share)
    place = crossing(p, v, t, left, yaw)
    sure, place = believed(place, variance(sums[:, :3], prior, t + left), config)
    return torch.cat([sure, place, left[:, None]], -1)


def later(memory: Tensor, ticks: int | Tensor = 1) -> Tensor:
    """The memory (..., n) that many ticks (or (..., 1)) later, if nothing is seen meanwhile."""
    told = told_later(memory, ticks)
    passed = memory[..., _SINCE : _LOST + 1] + ticks * _DT
    return torch.cat([told, memory[..., 4:_SINCE], passed, memory[..., _LOST + 1 :]], -1)


def told_later(memory: Tensor, ticks: int | Tensor) -> Tensor:
    """The same of what is told of it, (..., 4), not in units."""
    left = memory[..., 3:4] - ticks * _DT
    told = torch.cat([memory[..., :3], left], -1)
    return torch.where((memory[..., :1] > 0) & (left > _BEHIND), told, 0.0)


def in_picture(memory: Tensor, state: Tensor, max_m: float, config: FlightConfig) -> Tensor:
    """Where a picture shows it, if the robot has not turned since the last one that was seen.

    Args:
        memory: (N, `SIZE`).
        state: (N, 74) raw proprioception at the tick of the picture.
        max_m: depth at which nearness is 0, m.
        config: of the filter.

    Returns:
        (N, 4) as `WorldModel.motion`: column and row in half pictures from the middle, nearness of
        its surface, log-odds that it is there; below 0 where its path is not known.
    """
    share = picture_age.shares(memory[:, _EVIDENCE], config)
    age = share @ constant(config.picture_ages, share)
    pose = camera_pose(earlier(state, age), config.camera)
    since, turn = memory[:, _SINCE], about_vertical(memory[:, _YAW] - age * pose.yaw_rate)
    p, v = _path(memory[:, SUMS], share, constant(config.prior, memory))
    place = fallen(p + v * since[:, None], since, -1.0)
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
    # by numbers: a tensor of them, made on the processor, would be in the way of a CUDA graph
    parts = [memory[..., i : i + 1] / scale for i, scale in enumerate(unit, 1)]
    return torch.cat([memory[..., :1], *parts], -1)
