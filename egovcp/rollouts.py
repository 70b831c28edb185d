"""Converts episodes of a dataset to recordings and back.

Row t of an episode is tick t of a recording: o_t, a_t as sent, r_t, done.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from egovcp.data import DatasetReader, Episode
from egovcp.data.schema import COLLECTION_PATH
from egovcp.decode import DecodeError, decode
from egovcp.errors import DataError
from egovcp.log.tick import CONTROLLER, CameraView, RunInfo, Tick
from egovcp.rate import NS_PER_S
from egovcp.robot_spec import RobotSpec
from egovcp.spec import EVENT_REWARD, PLANNER_HZ

POSE: Final = (
    "The pelvis pose is not recorded: the robot is drawn at the origin, at its commanded height, "
    "with the tilt of its IMU."
)
_SEED_DIGITS: Final = 12  # hexadecimal; larger than seeds of collections and evaluations


def recording_info(reader: DatasetReader, index: int, episode: Episode) -> RunInfo:
    """The run description of the recording of an episode.

    Raises:
        DataError: a value in ``collection.json`` has another type or is out of bounds.
    """
    facts, known = episode.metadata, reader.provenance
    try:
        given = {"seed": 0, "episode": index} | {k: v for k, v in facts.items() if v is not None}
        seed, number = (decode(int, given[key], key) for key in ("seed", "episode"))
        camera = camera_view(known.get("config", {}), facts)
    except DecodeError as error:
        raise DataError.at(reader.root / COLLECTION_PATH, str(error), index) from error
    return RunInfo(
        task=episode.task,
        seed=seed,
        episode=number,
        camera=camera,
        config={
            **known.get("config", {}),
            **({"pose": POSE} if reader.robot.is_g1 else {}),
            "dataset": str(reader.root),
            "index in the dataset": index,
            "scenario": dict(facts),
            "time_limit": episode.time_limit,
            "command": known.get("command", ""),
        },
        hashes={CONTROLLER: reader.controller_id, "dataset commit": reader.source.commit},
        fps=reader.fps,
        robot=reader.robot,
        versions=dict(known.get("versions", {})),
    )


def camera_view(config: Mapping[str, Any], facts: Mapping[str, Any]) -> CameraView:
    """The camera of an episode; the default values where it is not recorded.

    Raises:
        DecodeError: a value has another type or is out of bounds.
    """
    camera = config.get("env", {}).get("camera", {})
    found = {key: camera[key] for key in ("position", "vertical_fov") if key in camera}
    if (pitch := facts.get("camera_pitch")) is not None:
        found["pitch"] = pitch
    return decode(CameraView, found, "camera")


def ticks_of(episode: Episode) -> Iterator[Tick]:
    """The rows of an episode as ticks."""
    period_ns = NS_PER_S // episode.robot.planner_hz
    for t in range(len(episode)):
        ended = bool(episode.done[t])
        yield Tick(
            index=t,
            time_ns=t * period_ns,
            depth=episode.depth[t],
            state=episode.state[t],
            action_planned=episode.action[t],
            action_sent=episode.action[t],
            reward=float(episode.reward[t]),
            terminated=ended and not episode.truncated[t],
            truncated=bool(episode.truncated[t]),
            success=bool(episode.success[t]),
            events=tuple(_events(episode, t)),
        )


def _events(episode: Episode, t: int) -> Iterator[str]:
    if t == episode.metadata.get("event_tick"):
        yield "the event of the task"
    if t > 0 and episode.success[t] != episode.success[t - 1]:
        yield "success" if episode.success[t] else "no success any more"
    if abs(episode.reward[t] - np.median(episode.reward)) > EVENT_REWARD:
        yield f"reward {episode.reward[t]:+.3f}"
    if episode.done[t]:
        yield "a fall ends the episode" if episode.terminated else "the episode is truncated"


def follows(before: Tick, tick: Tick, fps: int = PLANNER_HZ) -> bool:
    """Whether ``tick`` follows ``before`` by one period, so that both can be rows of an episode."""
    period_ns = NS_PER_S // fps
    late = abs(tick.time_ns - before.time_ns - period_ns) > period_ns / 2
    return tick.index == before.index + 1 and not late


def episode_of(info: RunInfo, ticks: Sequence[Tick]) -> Episode:
    """The episode of consecutive ticks from the start of a run.

    An end without a fall (time limit, operator, gap) is a truncation, and the time limit is the
    number of ticks. After a fall the time limit is the configured one.

    Raises:
        DataError: there is no tick.
    """
    if not ticks:
        raise DataError("it holds no tick; expected at least one")
    length, last = len(ticks), np.arange(len(ticks)) == len(ticks) - 1
    fallen = ticks[-1].terminated
    episode = Episode(
        depth=np.stack([_depth(tick, info.robot) for tick in ticks]),
        state=np.stack([tick.state for tick in ticks]).astype(np.float32),
        action=np.stack([tick.action_sent for tick in ticks]).astype(np.float32),
        reward=np.array([tick.reward for tick in ticks], np.float32),
        done=last,
        success=np.array([tick.success for tick in ticks], np.bool_),
        truncated=last & (not fallen),
        task=info.task,
        time_limit=max(length, planned_ticks(info)) if fallen else length,
        robot=info.robot,
    )
    facts = _facts(info, episode)
    return Episode(**{**vars(episode), "metadata": facts})


def _depth(tick: Tick, robot: RobotSpec) -> np.ndarray[Any, np.dtype[np.uint16]]:
    if tick.depth.shape != robot.depth:
        raise DataError(
            f"tick {tick.index}: depth of {tick.depth.shape} pixels, expected {robot.depth}"
        )
    return tick.depth


def planned_ticks(info: RunInfo) -> int:
    """Configured length of the run, ticks; 0 if unknown.

    Raises:
        DataError: it is recorded, but not as a whole number.
    """
    scene = f"{info.task}_episode"
    try:
        if "time_limit" in info.config:
            return decode(int, info.config["time_limit"], "time_limit")
        env = decode(dict[str, Any], info.config.get("env", {}), "env")
        options = decode(dict[str, Any], env.get(scene, {}), f"env.{scene}")
        return decode(int, options.get("ticks", 0), f"env.{scene}.ticks")
    except DecodeError as error:
        raise DataError(f"its configuration is damaged: {error}") from error


def _facts(info: RunInfo, episode: Episode) -> dict[str, Any]:
    """The metadata of an episode.

    The seed of a rollout is a hash of its content, since several policies play the same scenario.
    """
    scenario = info.config.get("scenario")
    if isinstance(scenario, Mapping):  # recorded from a dataset
        return dict(scenario)
    return {
        "seed": int(episode.digest()[:_SEED_DIGITS], 16),
        "episode": 0,
        "camera_pitch": info.camera.pitch,
        "rollout": {"seed": info.seed, "episode": info.episode, "hashes": dict(info.hashes)},
    }
