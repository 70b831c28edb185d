"""From raw depth in millimetres to what the network sees."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor


def nearness(depth_mm: Tensor, max_m: float) -> Tensor:
    """(B, H, W) raw depth, mm, 0 = invalid -> (B, H, W) nearness in [0, 1].

    Nearness is 1 - z / max: 0 where nothing is in range, growing towards the camera, so
    that a ball stands out from an empty background and vanishing detail is far away. A
    morphological closing (3 x 3 maximum, then minimum) fills isolated invalid pixels
    without touching the outline of a near object: left in, one per cent of random holes
    outweighs a distant ball a hundredfold in the reconstruction.
    """
    # In whole millimetres, where what is nearest is the minimum: half the memory to go through.
    far = math.ceil(1e3 * max_m)
    dtype = torch.int16 if far <= torch.iinfo(torch.int16).max else torch.int32
    depth = depth_mm.clamp(0, far).to(dtype)
    depth = depth.sub(depth.clamp(max=1).sub(1), alpha=far)  # 0 to far; faster than by a mask
    depth = _extreme_3x3(_extreme_3x3(depth, torch.minimum), torch.maximum)
    return depth.to(torch.float32).mul_(-1e-3 / max_m).add_(1.0).clamp_(0.0, 1.0)


def _extreme_3x3(x: Tensor, extreme: Callable[..., Tensor]) -> Tensor:
    """(B, H, W) -> maximum or minimum over each pixel's 3 x 3 neighbourhood; no gradient."""
    for dim in (1, 2):
        size, out = x.shape[dim], x.clone()
        for to, of in ((0, 1), (1, 0)):
            part = out.narrow(dim, to, size - 1)
            extreme(part, x.narrow(dim, of, size - 1), out=part)
        x = out
    return x


def lowest_3x3(x: Tensor) -> Tensor:
    """(B, H, W) -> the smallest in each pixel's 3 x 3 neighbourhood; no gradient."""
    return _extreme_3x3(x, torch.minimum)


def highest_3x3(x: Tensor) -> Tensor:
    """(B, H, W) -> the largest in each pixel's 3 x 3 neighbourhood; no gradient."""
    return _extreme_3x3(x, torch.maximum)


def network_image(near: Tensor) -> Tensor:
    """(B, H, W) nearness -> (B, 2, H, W): nearness and validity.

    In memory the two of a pixel lie side by side, as a convolution reads them.
    """
    if torch.onnx.is_in_onnx_export():  # it knows no complex numbers
        return torch.stack([near, near.sign()], 1)
    return torch.view_as_real(torch.complex(near, near.sign())).permute(0, 3, 1, 2)


def to_metres(near: Tensor, max_m: float) -> Tensor:
    """Nearness -> planar depth in metres; 0 (nothing in range) where nearness vanishes."""
    return torch.where(near > 0.01, (1.0 - near).clamp(0.0, 1.0) * max_m, 0.0)


#: Distance in depth, m, within which a pixel belongs to a thing whose place is known.
SLACK = 0.2


def thing_pixels(near: Tensor, place: Tensor, max_m: float) -> Tensor:
    """The pixels of a thing whose place in the picture is known.

    Args:
        near: (N, H, W) nearness.
        place: (N, 4) row and column of its middle and the radius within which its pixels are,
            in pixels, 0: it is nowhere; depth of its surface, m.
        max_m: depth at which nearness is 0, m.

    Returns:
        (N, H, W) bool.
    """
    at_its_depth = ((1.0 - near) * max_m - place[:, 3, None, None]).abs() < SLACK
    return within(near, place) & at_its_depth & (near > 0)


def within(near: Tensor, place: Tensor) -> Tensor:
    """(N, H, W) bool: the disc in which a thing's pixels are, see `thing_pixels`."""
    rows = torch.arange(near.shape[-2], device=near.device)[:, None]
    cols = torch.arange(near.shape[-1], device=near.device)
    row, column, radius = (place[:, i, None, None] for i in range(3))
    return (rows - row).square() + (cols - column).square() < radius.square()


BALL = 5.0  #: radius of what is painted, pixels times metres: 0.115 m at 43 pixels per radian
_EDGE = 0.4  # softness of its edge, pixels


def paint_ball(image: Tensor, place: Tensor, max_m: float) -> Tensor:
    """Paint what flies over a picture, as a ball of its likely size at its likeliest place.

    Args:
        image: (N, H, W) nearness.
        place: (N, 4) column and row of its middle in half pictures from the middle, nearness,
            log-odds that it is there.
        max_m: depth at which nearness is 0, m.
    """
    painted = torch.nonzero(place[:, 3] > 0)[:, 0]
    column, row, near, _ = (x[:, None, None] for x in place[painted].unbind(-1))
    height, width = image.shape[-2:]
    rows = torch.linspace(-1, 1, height, device=image.device)[:, None]
    cols = torch.linspace(-1, 1, width, device=image.device)
    away = torch.hypot((cols - column) * (width - 1) / 2, (rows - row) * (height - 1) / 2)
    near = near.clamp(0.0, 0.95)
    cover = torch.sigmoid((BALL / ((1 - near) * max_m) - away) / _EDGE)
    return image.index_copy(0, painted, torch.lerp(image[painted], near.expand_as(cover), cover))


#: Nearness below which a change is noise at the end of the range, and above which it is the
#: robot's own arm: 4 m and 0.9 m of a range of 5 m.
OBJECT_NEARNESS = (0.2, 0.82)
MIN_PIXELS = 2  # that came nearer, for something to count as seen
CLOSER = 0.12  # change of nearness, 0.6 m of a range of 5 m, that is no noise


def approaching(near: Tensor) -> tuple[Tensor, Tensor]:
    """Where something beyond the arms' reach has come nearer since the previous frame.

    Args:
        near: (B, T, H, W) nearness.

    Returns:
        (B, T, 3) column and row of the centre of the pixels that changed, in [-1, 1], and
        their mean nearness; and (B, T) whether there were any. Derived from the images
        alone: no simulator truth, no knowledge of the tasks.
    """
    low, high = OBJECT_NEARNESS
    before = near[:, :-1].flatten(0, 1)
    # Against the nearest of the previous neighbourhood: the robot's own sway moves edges by a
    # pixel, and pixels at an edge come and go.
    before = _extreme_3x3(before, torch.maximum).view_as(near[:, 1:])
    change = near[:, 1:] - before > CLOSER
    mask = (change & (near[:, 1:] > low) & (near[:, 1:] < high)).to(near.dtype)
    count = mask.sum((-2, -1))
    rows = torch.linspace(-1, 1, near.shape[-2], device=near.device)
    cols = torch.linspace(-1, 1, near.shape[-1], device=near.device)
    place = torch.stack([cols.expand(near.shape[-2:]), rows[:, None].expand(near.shape[-2:])], -1)
    nearest = (mask * near[:, 1:]).sum((-2, -1))
    sums = torch.cat([mask.flatten(-2) @ place.flatten(0, 1), nearest[..., None]], -1)
    centre = sums / count.clamp_min(1.0)[..., None]
    seen = count >= MIN_PIXELS
    return F.pad(centre, (0, 0, 1, 0)), F.pad(seen, (1, 0))  # nothing comes before the first
