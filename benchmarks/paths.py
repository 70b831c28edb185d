"""How far ahead the path of a thrown ball can be foreseen at all, whoever looks.

Beside the held-out figures of a world model (`egovcp-eval-model`, depth on the pixels of what
flies against the last picture repeated) this says what is in the recordings. From the same rows,
after at least as many frames of the flight, a ballistic path is fitted to what was sighted so far,
and a ball is painted over the last picture where the path leads. The fit is told what no policy
is: which pixels are the ball's, how old the pictures are, and how the camera will move.

* ``fit``: least squares on the sightings;
* ``prior``: the same, with the mean and the spread of the training throws as prior.

    python benchmarks/paths.py --dataset.root=data/ball
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from report import publish
from tqdm import tqdm

from egovcp import spec
from egovcp.cli import DatasetConfig, run_command
from egovcp.data import DatasetReader, EpisodeIndex, EpisodeStore, ReturnConfig
from egovcp.errors import DataError
from egovcp.model.depth import nearness, paint_ball, thing_pixels
from egovcp_train.heldout.open_loop import CONTEXT, HORIZONS
from egovcp_train.labels.camera import Array
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.flight import in_picture
from egovcp_train.labels.throw import GRAVITY, Path, Throw, find_throw, sightings_along

PROG = "paths.py"
STRIDE: Final = 4  # rows from one start to the next, as in `OpenLoop`
KINDS: Final = ("fit", "prior")
_SIGHTING: Final = 0.01  # m per m of distance, about what sightings lie beside their path
_CERTAIN: Final = 20.0  # log-odds that the ball is there


@dataclass(frozen=True)
class PathsConfig:
    """How well a ballistic fit foresees the pixels of what flies."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Dataset with throws."""
    labels: PassingConfig = field(default_factory=PassingConfig)
    """How throws are found."""
    episodes: int = 400
    """Training episodes for the prior, evenly spread; held-out ones: all."""
    json: str = ""
    """File for the figures; empty: none."""


class Flight(NamedTuple):
    """One throw, and what of it is seen."""

    throw: Throw
    near: torch.Tensor  # (T, 48, 64) nearness
    place: Array  # (T, 4), see `in_picture`
    rows: NDArray[np.intp]  # (n,) in which it is sighted
    point: Array  # (n, 3) m, where, in the frame that stays put


class Prior(NamedTuple):
    """Place (m) and velocity (m/s) of throws at their first sighting."""

    mean: Array  # (6,)
    precision: Array  # (6, 6)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(PathsConfig, measure, argv, prog=PROG)


def measure(config: PathsConfig) -> None:
    """Measure and print."""
    reader = DatasetReader.open(config.dataset)
    train = EpisodeIndex.of([reader], "train")
    prior = prior_of(list(flights(train.spread(config.episodes), config.labels)))
    judged = list(flights(EpisodeIndex.of([reader], "heldout"), config.labels))
    publish(
        figures(judged, prior, config.labels), pathlib.Path(config.json) if config.json else None
    )


def flights(index: EpisodeIndex, config: PassingConfig) -> Iterator[Flight]:
    """The throws of some episodes."""
    store = EpisodeStore.read(index, ReturnConfig())
    spans = zip(store.start.tolist(), store.length.tolist(), strict=True)
    for start, length in tqdm(spans, total=len(index), unit="ep", leave=False):
        rows = slice(start, start + length)
        throw = find_throw(store.depth[rows], store.state[rows], config)
        if throw.path is None:
            continue
        near = nearness(torch.from_numpy(store.depth[rows].astype(np.int32)), spec.DEPTH_MAX_M)
        seen, point = sightings_along(throw, near, config)
        place = in_picture(throw, config)
        flying = place[seen, 2] > 0
        yield Flight(throw, near, place, seen[flying], point[flying])


def prior_of(throws: Sequence[Flight]) -> Prior:
    """Raises `DataError` where there are too few throws for one."""
    starts = []
    for flight in throws:
        path = flight.throw.path
        if path is not None and len(flight.rows):
            t = flight.rows[0] * spec.PLANNER_DT
            starts.append(np.concatenate([path.at(t), path.velocity + GRAVITY * t]))
    if len(starts) < 20:
        raise DataError(f"{len(starts)} throws in the training episodes; a prior takes 20")
    values = np.array(starts)
    return Prior(values.mean(0), np.linalg.inv(np.cov(values.T)))


def figures(judged: Sequence[Flight], prior: Prior, config: PassingConfig) -> dict[str, object]:
    """Errors on the ball's pixels at each horizon, mm, and how many times below repetition."""
    sums: dict[tuple[str, int], Array] = {(n, k): np.zeros(3) for n in KINDS for k in HORIZONS}
    for flight in judged:
        for start in range(CONTEXT - 1, len(flight.near) - 1, STRIDE):
            since = flight.place[: start + 1, 2] > 0
            if since.sum() and start - int(np.argmax(since)) + 1 >= CONTEXT:
                for name in KINDS:
                    told = prior if name == "prior" else None
                    for k in HORIZONS:
                        sums[name, k] += errors(flight, start, k, told, config)
    out: dict[str, object] = {"throws": len(judged)}
    for (name, k), (fit, repeat, pixels) in sums.items():
        if pixels:
            out[f"h{k}_{name}_mm"] = fit / pixels
            out[f"h{k}_repeat_mm"] = repeat / pixels
            out[f"h{k}_{name}_ratio"] = repeat / fit
    return dict(sorted(out.items(), key=lambda item: (item[0][0] == "h", len(item[0]), item[0])))


def errors(
    flight: Flight, start: int, ahead: int, prior: Prior | None, config: PassingConfig
) -> Array:
    """(3,) sums over the ball's pixels ``ahead`` ticks after row ``start``: error in mm of the
    painted picture, and of the last one; number of pixels."""
    then = start + ahead
    if then >= len(flight.near) or flight.place[then, 2] <= 0:
        return np.zeros(3)
    place = torch.from_numpy(flight.place[then : then + 1]).float()
    truth, last = flight.near[then : then + 1], flight.near[start : start + 1]
    ball = thing_pixels(truth, place, spec.DEPTH_MAX_M)
    expected = foreseen(flight, start, then, prior, config)
    image = last if expected is None else paint_ball(last, expected, spec.DEPTH_MAX_M)
    to_mm = 1e3 * spec.DEPTH_MAX_M
    wrong, still = ((x - truth).abs()[ball].sum() * to_mm for x in (image, last))
    return np.array([float(wrong), float(still), float(ball.sum())])


def foreseen(
    flight: Flight, start: int, then: int, prior: Prior | None, config: PassingConfig
) -> torch.Tensor | None:
    """(1, 4) where the ball is in the picture of row ``then``, as `paint_ball` takes it, from
    what is seen up to row ``start``; None: it cannot be told."""
    seen = flight.rows <= start
    t = flight.rows[seen].astype(np.float64) * spec.PLANNER_DT
    path = fitted(t, flight.point[seen], prior)
    if path is None:
        return None
    at = path.at(then * spec.PLANNER_DT - path.seen[0])
    track = flight.throw.track
    x, left, up = track.rotation[then].T @ (at - track.position[then])
    if x < config.radius + 0.05:
        return None
    column, row = (-v * config.focal / x for v in (left, up))
    near = 1.0 - (x - config.radius) / spec.DEPTH_MAX_M
    half = ((spec.DEPTH_COLS - 1) / 2, (spec.DEPTH_ROWS - 1) / 2)
    return torch.tensor([[column / half[0], row / half[1], near, _CERTAIN]], dtype=torch.float32)


def fitted(t: Array, point: Array, prior: Prior | None) -> Path | None:
    """The path of sightings (n, 3) at times (n,), whose t = 0 is the first; None: too few."""
    if len(t) < (1 if prior else 2):
        return None
    since = t - t[0]
    straight = point - 0.5 * GRAVITY * (since * since)[:, None]
    weight = 1.0 / (_SIGHTING * np.maximum(point[:, 0], 1.0)) ** 2
    design = np.stack([np.ones(len(t)), since], -1)
    normal = np.kron((design * weight[:, None]).T @ design, np.eye(3))
    right = ((design * weight[:, None]).T @ straight).ravel()
    if prior is not None:
        normal, right = normal + prior.precision, right + prior.precision @ prior.mean
    start = np.linalg.solve(normal, right)
    return Path(start[:3], start[3:], t)


if __name__ == "__main__":
    sys.exit(main())
