"""Decoded depth images of states imagined open-loop, beside the images that came (figure 7b).

From a moment of each episode (the ball has been in flight for a few frames, the push has come, the
way to the arch has begun) the model imagines on under the actions that were then really sent. Of
the ball task the pixels of the ball are also measured by themselves (`BallMasks`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel
from egovcp.sim.env import StepResult
from egovcp.sim.scenario import Scenario
from egovcp.spec import DEPTH_MAX_M, PLANNER_DT
from egovcp_experiment.studies.ball_masks import BallMasks
from egovcp_experiment.studies.study import finish
from egovcp_experiment.studies.watching import Moment, WatchConfig, Watcher, watch

PROG: Final = "python -m egovcp_experiment.studies.open_loop"
HORIZONS: Final = tuple(range(0, 17, 2))
#: Seconds from the event to the last picture that is seen.
SEEN_S: Final = {"ball": 0.28, "wall": 0.08, "arch": 1.2}
_SHOWN: Final = 2  # episodes whose pictures are kept
_DETECTED_M: Final = 0.3  # largest error of the ball's depth in an image that shows it


@dataclass(frozen=True)
class OpenLoopConfig(WatchConfig):
    """Pictures that are foreseen, beside those that came."""


class _Film:
    """One episode from its moment on."""

    def __init__(self, carry: Carry) -> None:
        self.carry = carry
        self.depth: list[NDArray[np.uint16]] = []
        self.ball: list[NDArray[np.bool_]] = []
        self.sent: list[NDArray[np.float64]] = []


class _Films(Watcher):
    """Keeps carry, pictures and actions from the moment on."""

    def __init__(self, config: OpenLoopConfig) -> None:
        self._seen = SEEN_S[config.task]
        self._balls = BallMasks(config.env) if config.task == "ball" else None
        self.films: dict[int, _Film] = {}

    def begin(self, scenarios: Sequence[Scenario]) -> None:
        self._episodes = [scenario.episode for scenario in scenarios]
        if self._balls is not None:
            self._balls.begin()

    def before(self, moment: Moment) -> None:
        if self._balls is not None:
            self._balls.update(moment.env)
        since = moment.env.privileged_state().since_event
        for row in np.flatnonzero(moment.live).tolist():
            episode = self._episodes[row]
            due = self._seen - 1e-6 <= since[row] < self._seen + PLANNER_DT - 1e-6
            if due and episode not in self.films:
                carry = moment.policy.carry.row(row).map(torch.clone)
                self.films[episode] = _Film(carry)
            if episode in self.films:
                depth = moment.observation.depth[row].copy()
                self.films[episode].depth.append(depth)
                if self._balls is not None:
                    self.films[episode].ball.append(self._balls.mask(moment.env, row, depth))

    def after(self, moment: Moment, result: StepResult) -> None:
        for row in np.flatnonzero(moment.live).tolist():
            if self._episodes[row] in self.films:
                self.films[self._episodes[row]].sent.append(result.sent_action[row].copy())


def measure(config: OpenLoopConfig) -> None:
    """Play, imagine, and write pictures and errors."""
    if config.task not in SEEN_S:
        raise UsageError(f"--task={config.task}: expected one of {', '.join(SEEN_S)}")
    artifact = config.artifact()
    films = _Films(config)
    watch(artifact, config.env, config, films)
    whole = [f for _, f in sorted(films.films.items()) if len(f.depth) > HORIZONS[-1]]
    foreseen = [_foreseen(artifact.world_model, film) for film in whole]
    seen = [np.stack([film.depth[k] for k in HORIZONS]) / 1e3 for film in whole]
    errors = {}
    for i, k in enumerate(HORIZONS):
        triples = [(f[i], s[i], s[0]) for f, s in zip(foreseen, seen, strict=True)]
        errors[str(k)] = _errors(triples)
        if config.task == "ball":
            errors[str(k)] |= ball_errors(triples, [film.ball[k] for film in whole])
    order = sorted(range(len(whole)), key=lambda i: -_change(seen[i]))[:_SHOWN]
    strips = [{"seen": _centimetres(seen[i]), "foreseen": _centimetres(foreseen[i])} for i in order]
    finish(config, {"episodes": len(whole), "errors_m": errors, "strips": strips})


@torch.no_grad()
def _foreseen(model: WorldModel, film: _Film) -> NDArray[np.float64]:
    """(len(HORIZONS), 48, 64) m."""
    carry, pictures = film.carry, []
    for k in range(HORIZONS[-1] + 1):
        if k in HORIZONS:
            pictures.append(model.decode(carry)[0][0].double().cpu().numpy())
        if k < HORIZONS[-1]:
            carry = model.imagine(carry, torch.as_tensor(film.sent[k][None]).to(carry.h))
    return np.stack(pictures)


def _errors(triples: Sequence[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]) -> dict[str, Any]:
    """Mean absolute error over pixels in range, of the model and of the last picture repeated;
    and over those that have changed since then by a fifth of a metre."""
    if not triples:
        return {"model": None, "repeat": None, "model_moving": None, "repeat_moving": None}
    model, truth, last = (np.stack(parts) for parts in zip(*triples, strict=True))
    valid = (truth > 0) & (last > 0)
    moving = valid & (abs(truth - last) > 0.2)
    return {
        "model": _mean(abs(model - truth), valid),
        "repeat": _mean(abs(last - truth), valid),
        "model_moving": _mean(abs(model - truth), moving),
        "repeat_moving": _mean(abs(last - truth), moving),
    }


def ball_errors(
    triples: Sequence[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]],
    masks: Sequence[NDArray[np.bool_]],
) -> dict[str, Any]:
    """Mean absolute error of depth over the pixels of the ball, of the model and of the last
    picture repeated; and the share of images that show the ball, in which the median error of the
    model is below `_DETECTED_M`. Nothing in range counts as the end of the range."""
    model, repeat = [], []
    for (decoded, truth, last), ball in zip(triples, masks, strict=True):
        if ball.any():
            model.append(abs(_in_range(decoded[ball]) - truth[ball]))
            repeat.append(abs(_in_range(last[ball]) - truth[ball]))
    detected = [bool(np.median(errors) < _DETECTED_M) for errors in model]
    return {
        "ball_images": len(model),
        "model_ball": float(np.concatenate(model).mean()) if model else None,
        "repeat_ball": float(np.concatenate(repeat).mean()) if repeat else None,
        "ball_detected": sum(detected) / len(detected) if detected else None,
    }


def _in_range(depth: NDArray[Any]) -> NDArray[Any]:
    return np.where(depth > 0, depth, DEPTH_MAX_M)


def _mean(values: NDArray[Any], where: NDArray[np.bool_]) -> float | None:
    return float(values[where].mean()) if where.any() else None


def _change(seen: NDArray[Any]) -> float:
    return float((abs(seen[1:] - seen[:1]) > 0.2).mean())


def _centimetres(pictures: NDArray[Any]) -> list[Any]:
    whole: list[Any] = np.rint(100 * pictures).astype(int).tolist()
    return whole


CONFIG = OpenLoopConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CONFIG, measure, argv, prog=PROG)


if __name__ == "__main__":
    sys.exit(main())
