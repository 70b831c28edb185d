"""Decoded depth images of states imagined open-loop, next to the images that came (figure 7b).

Starts after a ball has been in flight for a few frames, after a push, or on the way to an arch, and
imagines under the actions that were sent. For the ball, errors on its own pixels are measured, too.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.model import Carry, WorldModel
from egovcp.robot.geometry import focal_length, pixel_rays, rotation_matrix
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import PrivilegedState
from egovcp.spec import (
    CONTROLLER_HZ,
    CONTROLLER_TICKS_PER_PLAN,
    DEPTH_COLS,
    DEPTH_MAX_M,
    DEPTH_ROWS,
    PLANNER_DT,
)
from egovcp_experiment.studies import study

HORIZONS: Final = tuple(range(0, 17, 2))
#: Seconds from the event to the last observed image.
SEEN_S: Final = {"ball": 0.28, "wall": 0.08, "arch": 1.2}
_SHOWN: Final = 2  # episodes whose images are kept
_MOVING_M: Final = 0.2  # change of depth of a moving pixel
_DETECTED_M: Final = 0.3  # largest error of the ball's depth in an image that shows it
_TOLERANCE_M: Final = 0.15  # of the ball's depth: several deviations of the noise at 3 m

type Array = NDArray[np.float64]
type Mask = NDArray[np.bool_]
type Images = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Decoded, true and last observed depth, m; 0: nothing in range."""


@dataclass(frozen=True)
class OpenLoopConfig(study.SimStudyConfig):
    """Compare imagined images with those that came."""


class BallMasks:
    """Finds the ball's pixels in simulated depth images.

    An image of age k was taken k controller ticks before its observation, so the poses of the last
    planner ticks are stored and interpolated.
    """

    def __init__(self, config: EnvConfig) -> None:
        rays = pixel_rays(focal_length(config.camera.vertical_fov))
        self._rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        oldest = round(config.delay.image_age[1] * CONTROLLER_HZ)
        self._states: deque[PrivilegedState] = deque(maxlen=2 + oldest // CONTROLLER_TICKS_PER_PLAN)

    def update(self, state: PrivilegedState) -> None:
        """Store the poses of a planner tick; call once per tick, before `mask`."""
        self._states.append(state)

    def mask(self, row: int, age: int, depth: NDArray[np.uint16]) -> Mask:
        """(48, 64) visible pixels of the ball in the image ``depth`` (48, 64) mm of a robot, taken
        ``age`` controller ticks ago; none before the throw and after the first contact."""
        state = self._states[-1]
        if not state.object_active[row]:
            return np.zeros(depth.shape, np.bool_)
        surface = self._surface(row, age, float(state.object_size[row]))
        found: Mask = np.abs(depth / 1e3 - surface) < _TOLERANCE_M
        return found & (depth > 0)

    def _surface(self, row: int, age: int, radius: float) -> Array:
        """(48, 64) planar depth of the ball in an image of this age, m; NaN elsewhere."""
        ball, camera = self._poses(row, age)
        rotation = rotation_matrix(camera[3:] / np.linalg.norm(camera[3:]))
        centre = rotation.T @ (ball - camera[:3])
        along = self._rays @ centre
        squared = radius**2 - (centre @ centre - along**2)
        hit = (squared > 0) & (along > 0)
        reach = along - np.sqrt(np.where(hit, squared, 0.0))
        depth: Array = np.where(hit, reach * self._rays[:, 0], np.nan)
        return depth.reshape(DEPTH_ROWS, DEPTH_COLS)

    def _poses(self, row: int, age: int) -> tuple[Array, Array]:
        """Ball (3,) and camera (7,) ``age`` controller ticks before the last planner tick."""
        whole, rest = divmod(age, CONTROLLER_TICKS_PER_PLAN)
        share = rest / CONTROLLER_TICKS_PER_PLAN
        last = len(self._states) - 1
        after, before = (self._states[max(0, last - whole - k)] for k in (0, 1))
        ball = (1 - share) * after.object_w[row] + share * before.object_w[row]
        return ball, (1 - share) * after.camera_w[row] + share * before.camera_w[row]


@dataclass
class _Clip:
    """One episode from the start of the imagination on."""

    carry: Carry
    depth: list[NDArray[np.uint16]] = field(default_factory=list)
    ball: list[Mask] = field(default_factory=list)
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
        if config.task == "ball":
            errors[str(k)] |= ball_errors(images, [clip.ball[k] for clip in clips])
    most_moving = sorted(range(len(clips)), key=lambda i: -_moving_share(seen[i]))[:_SHOWN]
    strips = [
        {"seen": _centimetres(seen[i]), "foreseen": _centimetres(imagined[i])} for i in most_moving
    ]
    config.write({"episodes": len(clips), "errors_m": errors, "strips": strips})


def _clips(artifact: Artifact, config: OpenLoopConfig) -> dict[int, _Clip]:
    """Episode -> its clip."""
    start = SEEN_S[config.task] - 1e-6
    balls = BallMasks(config.env)
    clips: dict[int, _Clip] = {}
    for step in study.play_episodes(artifact, config.env, config):
        if not step.tick.any():  # a new group of episodes
            balls = BallMasks(config.env)
        balls.update(step.state)
        for row in step.live:
            episode = step.scenarios[row].episode
            if start <= step.state.since_event[row] < start + PLANNER_DT:
                clips.setdefault(episode, _Clip(step.carry.row(row).map(torch.clone)))
            if episode in clips:
                depth = step.observation.depth[row].copy()
                clips[episode].depth.append(depth)
                clips[episode].sent.append(step.result.sent_action[row].copy())
                if config.task == "ball":
                    age = int(step.env.parameters[row]["image_age_ticks"])
                    clips[episode].ball.append(balls.mask(row, age, depth))
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


def ball_errors(images: Sequence[Images], masks: Sequence[Mask]) -> dict[str, Any]:
    """Mean absolute error of depth on the ball's pixels, of the model and of the last observed
    image repeated; and the share of images with the ball in which the model's median error is below
    `_DETECTED_M`. Nothing in range counts as the end of the range."""
    model, repeat = [], []
    for (decoded, truth, last), ball in zip(images, masks, strict=True):
        if ball.any():
            model.append(abs(_in_range(decoded[ball]) - truth[ball]))
            repeat.append(abs(_in_range(last[ball]) - truth[ball]))
    return {
        "ball_images": len(model),
        "model_ball": float(np.concatenate(model).mean()) if model else None,
        "repeat_ball": float(np.concatenate(repeat).mean()) if repeat else None,
        "ball_detected": (
            float(np.mean([np.median(errors) < _DETECTED_M for errors in model])) if model else None
        ),
    }


def _in_range(depth: NDArray[Any]) -> NDArray[Any]:
    return np.where(depth > 0, depth, DEPTH_MAX_M)


def _mean(values: NDArray[Any], where: Mask) -> float | None:
    return float(values[where].mean()) if where.any() else None


def _moving_share(seen: NDArray[Any]) -> float:
    return float((abs(seen[1:] - seen[:1]) > _MOVING_M).mean())


def _centimetres(images: NDArray[Any]) -> list[Any]:
    whole: list[Any] = np.rint(100 * images).astype(int).tolist()
    return whole


CONFIG = OpenLoopConfig
main = study.make_main("open_loop", CONFIG, measure)

if __name__ == "__main__":
    sys.exit(main(None))
