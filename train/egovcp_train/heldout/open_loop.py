"""How far a model foresees pictures and proprioception without looking.

After at least `CONTEXT` filtered frames the state at row s is imagined onwards with the recorded
actions. At s + k the decoded picture and proprioception are compared with the recorded ones, and
so are those of row s itself, "the last image repeated".

Depth errors are mean absolute differences in mm over the pixels of a region of row s + k, of
those in which something is in range; a prediction of nothing in range counts as the end of it.
State errors are mean absolute differences in standard deviations of the training data.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import Batch, Carry, WorldModel
from egovcp.model.losses import Rollout, moving_pixels
from egovcp_train.heldout.episodes import Recorded

HORIZONS: Final = (1, 2, 4, 8, 12, 16)
CONTEXT: Final = 4  # frames that are filtered before anything is foreseen
REGIONS: Final = ("valid", "near", "moving")
NEAR_M: Final = 1.5  # m; upper end of the region "near", about the reach of the hands
_MOVING: Final = 0.04  # change of nearness, 0.2 m of 5 m, as in the loss
_IMAGES_AT_ONCE: Final = 1024

type Errors = dict[str, dict[str, dict[str, float | int | None]]]


class OpenLoop:
    """Sums of the errors at each horizon, over any number of groups of episodes."""

    def __init__(self, stride: int = 4) -> None:
        """Foresee from every ``stride``-th row."""
        self.stride = stride
        self._depth = {
            (r, k): torch.zeros(3, dtype=torch.float64) for r in REGIONS for k in HORIZONS
        }
        shape = (2, spec.STATE_DIM)
        self._state = {k: torch.zeros(shape, dtype=torch.float64) for k in HORIZONS}
        self._rows = dict.fromkeys(HORIZONS, 0)

    def add(self, model: WorldModel, episodes: Recorded, rollout: Rollout) -> None:
        """Foresee one group of episodes, filtered as ``rollout``."""
        batch = episodes.batch
        s = _starts(batch, self.stride)
        if len(s) == 0:
            return
        regions = _regions(rollout.near, model.config.depth_max_m)
        carry = rollout.carry.map(lambda x: x[:, s])
        last = batch.valid.shape[1] - 1
        for k in range(1, max(HORIZONS) + 1):
            carry = model.imagine(carry, batch.action[:, (s + k - 1).clamp_max(last)])
            if k in HORIZONS:
                exists = batch.valid[:, (s + k).clamp_max(last)] & (s + k <= last)
                b, i = torch.nonzero(exists, as_tuple=True)
                self._compare(model, carry, rollout, regions, s, k, b, i)

    def _compare(
        self,
        model: WorldModel,
        carry: Carry,
        rollout: Rollout,
        regions: Mapping[str, Tensor],
        starts: Tensor,
        k: int,
        b: Tensor,
        i: Tensor,
    ) -> None:
        """Add the errors of starts ``i`` of episodes ``b`` at horizon ``k``."""
        found, then = carry.map(lambda x: x[b, i]), starts[i] + k
        truth, before = rollout.state[b, then], rollout.state[b, starts[i]]
        foreseen = model.decode_state(found.h, found.z).float()
        errors = torch.stack([(foreseen - truth).abs().sum(0), (before - truth).abs().sum(0)])
        self._state[k] += errors.double().cpu()
        self._rows[k] += len(b)
        for some in torch.split(torch.arange(len(b), device=b.device), _IMAGES_AT_ONCE):
            bs, ts = b[some], then[some]
            image = model.decode_near(_some(found, some)).clamp(0.0, 1.0)
            truth = rollout.near[bs, ts]
            wrong = (image - truth).abs()
            still = (rollout.near[bs, ts - k] - truth).abs()
            for name, pixels in regions.items():
                inside = pixels[bs, ts]
                sums = [(wrong * inside).sum(), (still * inside).sum(), inside.sum()]
                scale = torch.tensor([1e3 * model.config.depth_max_m] * 2 + [1.0])
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
        """Group of `spec.STATE_SLICES` -> horizon -> model, repeat (None without rows), rows."""
        out: Errors = {}
        for group, part in spec.STATE_SLICES.items():
            out[group] = {}
            for k, (model, repeat) in self._state.items():
                n = self._rows[k]
                out[group][str(k)] = {
                    "model": float(model[part].mean()) / n if n else None,
                    "repeat": float(repeat[part].mean()) / n if n else None,
                    "rows": n,
                }
        return out


def _some(carry: Carry, rows: Tensor) -> Carry:
    return carry.map(lambda x: x[rows])


def _starts(batch: Batch, stride: int) -> Tensor:
    """(S,) rows from which states are imagined."""
    end = max(CONTEXT - 1, batch.valid.shape[1] - 1)
    return torch.arange(CONTEXT - 1, end, stride, device=batch.valid.device)


def _regions(near: Tensor, max_m: float) -> dict[str, Tensor]:
    """(B, T, 48, 64) bool each."""
    valid = near > 0
    return {
        "valid": valid,
        "near": near > 1 - NEAR_M / max_m,
        "moving": valid & (moving_pixels(near, _MOVING) > 0),
    }
