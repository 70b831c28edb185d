"""Open-loop prediction of depth images and proprioception.

After at least `CONTEXT` filtered frames the state at row s is imagined forward with the recorded
actions. At s + k the decoded image and proprioception are compared with the recorded ones; so are
those of row s itself ("last image repeated").

Depth MAE, mm, over the valid pixels of the region in the target frame s + k; empty predictions
count as the end of the range. Moving pixels differ from the frame before. MAE of the state in
standard deviations of the training data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp.model import Batch, Carry, WorldModel
from egovcp.model.losses import Rollout, moving_pixels
from egovcp.robot_spec import G1, RobotSpec

HORIZONS: Final = (1, 2, 4, 8, 12, 16)
CONTEXT: Final = 4  # frames that are filtered before a prediction
REGIONS: Final = ("valid", "near", "moving")
NEAR_M: Final = 1.5  # m; upper end of the region "near"
STRIP_HORIZONS: Final = tuple(range(0, max(HORIZONS) + 1, 2))  # of an image strip; 0 is filtered
MAX_STRIPS: Final = 3  # per task
_MOVING: Final = 0.04  # change of nearness, 0.2 m of 5 m, as in the loss
_IMAGES_AT_ONCE: Final = 1024

type Errors = dict[str, dict[str, dict[str, float | int | None]]]


class OpenLoop:
    """Sums of the errors at each horizon over batches of episodes."""

    def __init__(self, stride: int = 4, robot: RobotSpec = G1) -> None:
        """Predict the observations of ``robot`` from every ``stride``-th row."""
        self.stride = stride
        self._depth = {
            (r, k): torch.zeros(3, dtype=torch.float64) for r in REGIONS for k in HORIZONS
        }
        self._robot = robot
        shape = (2, robot.state_dim)
        self._state = {k: torch.zeros(shape, dtype=torch.float64) for k in HORIZONS}
        self._rows = dict.fromkeys(HORIZONS, 0)

    def add(self, model: WorldModel, batch: Batch, rollout: Rollout) -> None:
        """Add a batch of episodes, filtered as ``rollout``."""
        last = batch.valid.shape[1] - 1
        s = torch.arange(CONTEXT - 1, max(CONTEXT - 1, last), self.stride)
        s = s.to(batch.valid.device)  # rows from which states are imagined
        if len(s) == 0:
            return
        regions = _regions(rollout.near, model.config.depth_max_m)
        carry = rollout.carry.map(lambda x: x[:, s])
        for k in range(1, max(HORIZONS) + 1):
            carry = model.imagine(carry, batch.action[:, (s + k - 1).clamp_max(last)])
            if k in HORIZONS:
                in_episode = batch.valid[:, (s + k).clamp_max(last)] & (s + k <= last)
                b, i = torch.nonzero(in_episode, as_tuple=True)
                self._compare(model, _rows(carry, b, i), rollout, regions, b, s[i], k)

    def _compare(
        self,
        model: WorldModel,
        carry: Carry,
        rollout: Rollout,
        regions: Mapping[str, Tensor],
        b: Tensor,
        start: Tensor,
        k: int,
    ) -> None:
        """Add the errors of ``carry``, predicted from rows ``start`` of episodes ``b``."""
        target_row = start + k
        truth, last_observed = rollout.state[b, target_row], rollout.state[b, start]
        predicted = model.decode_state(carry.h, carry.z).float()
        for i, state in enumerate((predicted, last_observed)):
            self._state[k][i] += (state - truth).abs().sum(0).double().cpu()
        self._rows[k] += len(b)
        scale = torch.tensor([1e3 * model.config.depth_max_m] * 2 + [1.0])
        for chunk in torch.split(torch.arange(len(b), device=b.device), _IMAGES_AT_ONCE):
            bs, ts = b[chunk], target_row[chunk]
            image = model.decode_near(_rows(carry, chunk)).clamp(0.0, 1.0)
            truth = rollout.near[bs, ts]
            error = (image - truth).abs()
            repeated = (rollout.near[bs, ts - k] - truth).abs()
            for name, pixels in regions.items():
                inside = pixels[bs, ts]
                sums = [(error * inside).sum(), (repeated * inside).sum(), inside.sum()]
                self._depth[name, k] += torch.stack([x.double() for x in sums]).cpu() * scale

    def depth(self) -> Errors:
        """Region -> horizon -> model_mm, repeat_mm (None without pixels), pixels."""
        out: Errors = {}
        for (region, k), (model, repeat, pixels) in self._depth.items():
            n = float(pixels)
            out.setdefault(region, {})[str(k)] = {
                "model_mm": float(model) / n if n else None,
                "repeat_mm": float(repeat) / n if n else None,
                "pixels": int(n),
            }
        return out

    def state(self) -> Errors:
        """`RobotSpec.state_slices` -> horizon -> model, repeat (None without rows), rows."""
        out: Errors = {}
        for group, part in self._robot.state_slices.items():
            out[group] = {}
            for k, (model, repeat) in self._state.items():
                n = self._rows[k]
                out[group][str(k)] = {
                    "model": float(model[part].mean()) / n if n else None,
                    "repeat": float(repeat[part].mean()) / n if n else None,
                    "rows": n,
                }
        return out


def _rows(carry: Carry, *index: Tensor) -> Carry:
    return carry.map(lambda x: x[index])


def _regions(near: Tensor, max_m: float) -> dict[str, Tensor]:
    """(B, T, H, W) bool each."""
    valid = near > 0
    return {
        "valid": valid,
        "near": valid & (near > 1 - NEAR_M / max_m),
        "moving": valid & (moving_pixels(near, _MOVING) > 0),
    }


class ImageStrip(NamedTuple):
    """Recorded and predicted images of one prediction."""

    moving_pixels: float
    """Number of moving pixels in the predicted rows."""
    start: int
    """Row of the last observed image."""
    observed: NDArray[np.float32]
    """(len(STRIP_HORIZONS), H, W) nearness."""
    predicted: NDArray[np.float32]
    """(len(STRIP_HORIZONS), H, W) nearness."""


def select_strips(strips: Sequence[ImageStrip]) -> list[ImageStrip]:
    """The `MAX_STRIPS` strips with the most moving pixels."""
    return sorted(strips, key=lambda strip: -strip.moving_pixels)[:MAX_STRIPS]


def image_strips(model: WorldModel, batch: Batch, rollout: Rollout) -> list[ImageStrip]:
    """Strips of the episodes in which most pixels move, at most one per episode.

    A strip starts before the rows in which most pixels move.
    """
    ahead = max(HORIZONS)
    latest = batch.valid.sum(1) - 1 - ahead
    moving = (moving_pixels(rollout.near, _MOVING).sum((-2, -1)) * batch.valid).cumsum(1)
    window = torch.full_like(moving, -1.0)  # stays where the episode is too short
    window[:, :-ahead] = moving[:, ahead:] - moving[:, :-ahead]
    rows = torch.arange(window.shape[1], device=window.device)
    possible = (rows >= CONTEXT - 1) & (rows <= latest[:, None])
    most, start = window.masked_fill(~possible, -1.0).max(1)
    order = torch.argsort(-most, stable=True)[:MAX_STRIPS]
    return [
        _strip(model, batch, rollout, int(b), int(start[b]), float(most[b]))
        for b in order
        if most[b] >= 0
    ]


def _strip(
    model: WorldModel, batch: Batch, rollout: Rollout, b: int, s: int, moving: float
) -> ImageStrip:
    states = [rollout.carry.map(lambda x: x[b, s][None])]
    for k in range(max(HORIZONS)):
        states.append(model.imagine(states[-1], batch.action[b, s + k][None]))
    shown = Carry.join([states[k] for k in STRIP_HORIZONS], torch.cat)
    predicted = model.decode_near(shown).clamp(0.0, 1.0)
    observed = rollout.near[b, [s + k for k in STRIP_HORIZONS]]
    return ImageStrip(moving, s, observed.cpu().numpy(), predicted.cpu().numpy())
