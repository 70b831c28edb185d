"""Decoded depth images of states imagined open-loop, next to the images that came (figure 7b).

Starts after a ball has been in flight for a few frames, after a push, or on the way to an arch, and
imagines under the actions that were sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.model import Carry, WorldModel
from egovcp.spec import PLANNER_DT
from egovcp_experiment.studies import study

HORIZONS: Final = tuple(range(0, 17, 2))
#: Seconds from the event to the last observed image.
SEEN_S: Final = {"ball": 0.28, "wall": 0.08, "arch": 1.2}
_SHOWN: Final = 2  # episodes whose images are kept
_MOVING_M: Final = 0.2  # change of depth of a moving pixel

type Array = NDArray[np.float64]
type Images = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Decoded, true and last observed depth, m; 0: nothing in range."""


@dataclass(frozen=True)
class OpenLoopConfig(study.SimStudyConfig):
    """Compare imagined images with those that came."""


@dataclass
class _Clip:
    """One episode from the start of the imagination on."""

    carry: Carry
    depth: list[NDArray[np.uint16]] = field(default_factory=list)
    sent: list[Array] = field(default_factory=list)


def measure(config: OpenLoopConfig) -> None:
    """Play, imagine, and write images and errors."""
    config.require_task(SEEN_S)
    artifact = config.load()
    recorded = sorted(_clips(artifact, config).items())
    clips = [clip for _, clip in recorded if len(clip.depth) > HORIZONS[-1]]
    imagined = [_imagine(artifact.world_model, clip) for clip in clips]
    seen = [np.stack([clip.depth[k] for k in HORIZONS]) / 1e3 for clip in clips]
    errors = {}
    for i, k in enumerate(HORIZONS):
        images = [(f[i], s[i], s[0]) for f, s in zip(imagined, seen, strict=True)]
        errors[str(k)] = _errors(images)
    most_moving = sorted(range(len(clips)), key=lambda i: -_moving_share(seen[i]))[:_SHOWN]
    strips = [
        {"seen": _centimetres(seen[i]), "imagined": _centimetres(imagined[i])} for i in most_moving
    ]
    config.write({"episodes": len(clips), "errors_m": errors, "strips": strips})


def _clips(artifact: Artifact, config: OpenLoopConfig) -> dict[int, _Clip]:
    """Episode -> its clip."""
    start = SEEN_S[config.task] - 1e-6
    clips: dict[int, _Clip] = {}
    for step in study.play_episodes(artifact, config.env, config):
        for row in step.live:
            episode = step.scenarios[row].episode
            if start <= step.state.since_event[row] < start + PLANNER_DT:
                clips.setdefault(episode, _Clip(step.carry.row(row).map(torch.clone)))
            if episode in clips:
                clips[episode].depth.append(step.observation.depth[row].copy())
                clips[episode].sent.append(step.result.sent_action[row].copy())
    return clips


@torch.no_grad()
def _imagine(model: WorldModel, clip: _Clip) -> Array:
    """(len(HORIZONS), 48, 64) m."""
    carry, images = clip.carry, []
    for k in range(HORIZONS[-1] + 1):
        if k in HORIZONS:
            images.append(model.decode(carry)[0][0].double().cpu().numpy())
        if k < HORIZONS[-1]:
            carry = model.imagine(carry, torch.as_tensor(clip.sent[k][None]).to(carry.h))
    return np.stack(images)


def _errors(images: Sequence[Images]) -> dict[str, Any]:
    """Mean absolute error over pixels in range, and over moving ones, of the model and of the last
    observed image repeated."""
    if not images:
        return dict.fromkeys(("model", "repeat", "model_moving", "repeat_moving"))
    model, truth, last = (np.stack(parts) for parts in zip(*images, strict=True))
    valid = (truth > 0) & (last > 0)
    moving = valid & (abs(truth - last) > _MOVING_M)
    return {
        "model": _mean(abs(model - truth), valid),
        "repeat": _mean(abs(last - truth), valid),
        "model_moving": _mean(abs(model - truth), moving),
        "repeat_moving": _mean(abs(last - truth), moving),
    }


def _mean(values: NDArray[Any], where: NDArray[np.bool_]) -> float | None:
    return float(values[where].mean()) if where.any() else None


def _moving_share(seen: NDArray[Any]) -> float:
    return float((abs(seen[1:] - seen[:1]) > _MOVING_M).mean())


def _centimetres(images: NDArray[Any]) -> list[Any]:
    whole: list[Any] = np.rint(100 * images).astype(int).tolist()
    return whole


main = study.make_main("open_loop", OpenLoopConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
