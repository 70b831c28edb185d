"""Decoded depth images of states imagined open-loop, next to the images that came (figure 7b).

Starts after a ball has been in flight for a few frames, after a push, or on the way to an arch, and
imagines under the actions that were sent.

Depth errors are mean absolute differences in m over the valid pixels of the target frame, whose
small holes are closed; empty predictions count as the end of the range. Changed pixels differ from
the last observed image, moving pixels of ``egovcp-eval-model`` from the frame before.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.eval_scores import Array
from egovcp.model import Carry, WorldModel
from egovcp.model.depth import nearness, to_metres
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS, PLANNER_DT
from egovcp_experiment.studies import study

HORIZONS: Final = tuple(range(0, 17, 2))
#: Seconds from the event to the last observed image.
SEEN_S: Final = {"ball": 0.28, "wall": 0.08, "arch": 1.2}
_SHOWN: Final = 2  # episodes whose images are kept
_CHANGED_M: Final = 0.2  # change of depth of a changed pixel


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
    shape = (len(clips), len(HORIZONS), DEPTH_ROWS, DEPTH_COLS)  # also without clips
    imagined = np.reshape([_imagine(artifact.world_model, clip) for clip in clips], shape)
    depth = np.reshape([[clip.depth[k] for k in HORIZONS] for clip in clips], (-1, *shape[2:]))
    max_m = artifact.world_model.config.depth_max_m
    near = nearness(torch.from_numpy(depth.astype(np.int32)), max_m)
    seen = to_metres(near, max_m).double().numpy().reshape(shape)
    changed = abs(seen[:, 1:] - seen[:, :1]) > _CHANGED_M
    most_changed = np.argsort(-changed.mean(axis=(1, 2, 3)), kind="stable")[:_SHOWN]
    config.write(
        {
            "episodes": len(clips),
            "errors_m": {
                str(k): _errors(imagined[:, i], seen[:, i], seen[:, 0], max_m)
                for i, k in enumerate(HORIZONS)
            },
            "strips": [
                {"seen": _centimetres(seen[i]), "imagined": _centimetres(imagined[i])}
                for i in most_changed
            ],
        }
    )


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


def _errors(model: Array, truth: Array, last: Array, max_m: float) -> dict[str, float | None]:
    """Errors over all valid pixels and over changed ones, of the model and of the last observed
    image repeated; (C, H, W) m, 0: nothing in range."""
    valid = truth > 0
    model, truth, last = (np.where(x > 0, x, max_m) for x in (model, truth, last))
    changed = valid & (abs(truth - last) > _CHANGED_M)
    return {
        "model": _mean(abs(model - truth), valid),
        "repeat": _mean(abs(last - truth), valid),
        "model_changed": _mean(abs(model - truth), changed),
        "repeat_changed": _mean(abs(last - truth), changed),
    }


def _mean(values: NDArray[Any], where: NDArray[np.bool_]) -> float | None:
    return float(values[where].mean()) if where.any() else None


def _centimetres(images: Array) -> Any:
    return np.rint(100 * images).astype(int).tolist()


main = study.make_main("open_loop", OpenLoopConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
