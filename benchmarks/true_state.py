"""What the simulator knew at every row of a dataset, from simulating its episodes again.

Physics does not depend on pictures, so none are rendered; that everything else comes out as it was
recorded is checked bit for bit.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import DatasetReader, Episode
from egovcp.errors import DataError
from egovcp.robot.geometry import rotation_matrix
from egovcp.sim.env import PrivilegedState, VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import PARTS
from egovcp_collect.dataset.audit import changed_versions, resimulate, scenario_of

type Array = NDArray[np.float32]
#: Column -> (N, width) rows of episodes, one after the other.
type Columns = dict[str, Array]

_LAYOUT: Final = 1  # of the kept files; another one is made anew
_FEET: Final = ("left_ankle_roll_link", "right_ankle_roll_link")
#: What a recording holds as well and must agree in: column -> feature.
_RECORDED: Final = {
    "state": spec.STATE_KEY,
    "action": spec.ACTION_KEY,
    "reward": spec.REWARD_KEY,
    "done": spec.DONE_KEY,
}


class Watch:
    """Notes the truth of every robot before each tick (a `StepCallback` of the collection)."""

    def __init__(self) -> None:
        self._rows: dict[Scenario, list[dict[str, NDArray[np.float64]]]] = {}

    def __call__(self, env: VectorEnv, live: NDArray[np.bool_]) -> None:
        """Note a row for each robot whose episode is not over."""
        truth = env.privileged_state()
        for row in np.flatnonzero(live).tolist():
            lane = env.instances[row]
            found = _columns(truth, row) | {"delay": np.array([lane.action_delay * 0.02])}
            self._rows.setdefault(lane.scenario, []).append(found)

    def take(self, scenario: Scenario) -> Columns:
        """The rows (T, width) of a finished episode; they are forgotten here."""
        rows = self._rows.pop(scenario)
        return {name: np.stack([row[name] for row in rows]).astype(np.float32) for name in rows[0]}


def _columns(truth: PrivilegedState, row: int) -> dict[str, NDArray[np.float64]]:
    """One robot's truth. ``_b``: heading frame, from the pelvis; SI units."""
    pelvis = truth.pelvis_w[row]
    rotation = rotation_matrix(pelvis[3:])
    heading = _heading(rotation)

    def seen(points_w: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((points_w - pelvis[:3]) @ heading).ravel()

    feet = [truth.body_names.index(name) for name in _FEET]
    thing = np.nan_to_num(truth.object_b[row])
    return {
        "time": truth.time[row, None],
        "since_event": np.maximum(truth.since_event[row, None], -1.0),
        "height": pelvis[2:3],
        "gravity": -rotation[2],
        "velocity_b": truth.pelvis_velocity_w[row] @ heading,
        "joint_position": truth.joint_position[row],
        "joint_velocity": truth.joint_velocity[row],
        "hands_b": truth.hands_b[row].ravel(),
        "feet_b": seen(truth.body_position_w[row, feet]),
        "camera_b": seen(truth.camera_w[row, :3]),
        "object_b": thing,
        "object_velocity_b": np.nan_to_num(truth.object_velocity_b[row]),
        "object_size": np.nan_to_num(truth.object_size[row, None]),
        "object_active": truth.object_active[row, None].astype(np.float64),
        "object_there": np.isfinite(truth.object_b[row, :1]).astype(np.float64),
        "object_ahead_b": _facing(truth, row, heading),
        "force": truth.contact_force[row],
    }


def _facing(truth: PrivilegedState, row: int, heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) x axis of the thing in the scene; zeros if there is none."""
    if not truth.solids[row]:
        return np.zeros(3)
    return np.asarray(rotation_matrix(truth.solids[row][0].quaternion_w)[:, 0] @ heading)


def _heading(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3) from the heading frame to the world, given the pelvis'."""
    c, s = rotation[:2, 0] / max(float(np.hypot(*rotation[:2, 0])), 1e-9)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def true_states(reader: DatasetReader, chosen: Sequence[int], folder: Path) -> Columns:
    """Truth and recorded ``state``, ``action``, ``reward`` (N, width) of episodes, in their order.

    Each episode is kept in ``folder`` as soon as it is known, and read from there the next time.

    Raises:
        DataError: an episode does not come out as it was recorded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = {index: _path(reader, index, folder) for index in chosen}
    missing = [index for index, path in paths.items() if not path.is_file()]
    if missing:
        _simulate(reader, missing, paths)
    parts = [_kept(path) for path in paths.values()]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _path(reader: DatasetReader, index: int, folder: Path) -> Path:
    """Named by what was recorded, so that other choices and datasets find it, too."""
    digest = reader.digest(index) or reader.read(index).digest()
    return folder / f"true_state{_LAYOUT}_{digest}.npz"


def _kept(path: Path) -> Columns:
    with np.load(path, allow_pickle=False) as kept:
        return {name: kept[name] for name in kept.files}


def _keep(path: Path, columns: Columns) -> None:
    new = path.with_suffix(".new.npz")
    np.savez(new, allow_pickle=False, **columns)
    os.replace(new, path)


def _simulate(reader: DatasetReader, chosen: Sequence[int], paths: Mapping[int, Path]) -> None:
    """Keep each of the episodes."""
    watch, different = Watch(), []
    with tqdm(total=len(chosen), unit="ep", desc="simulate again", delay=1) as bar:
        for index, episode in resimulate(reader, chosen, watch, render_depth=False):
            truth = watch.take(scenario_of(reader, index))
            if _agrees(episode, reader.read_episode_columns(index, tuple(_RECORDED.values()))):
                rows = {"state": episode.state, "action": episode.action}
                _keep(
                    paths[index],
                    {**rows, "reward": episode.reward[:, None], **_remembered(truth)},
                )
            else:
                different.append(index)
            bar.update(1)
    if different:
        raise DataError(
            f"{reader.root}: {len(different)} of {len(chosen)} episodes come out otherwise than "
            f"recorded, the first is {min(different)}; versions: "
            f"{changed_versions(reader, chosen) or 'as recorded, so the code was changed'}"
        )


def _agrees(episode: Episode, recorded: Columns) -> bool:
    """Whether all but the pictures is the same, bit for bit."""
    return all(
        getattr(episode, name).tobytes() == recorded[feature].tobytes()
        for name, feature in _RECORDED.items()
    )


def _remembered(truth: Columns) -> Columns:
    """Add, part by part, for how many ticks it has been in touch with the object so far, and for
    how long (s) anything has been since the first touch."""
    touching = truth["force"] > 0
    touched = touching.cumsum(axis=0).astype(np.float32)
    since = np.cumsum(touched.any(axis=1, keepdims=True), axis=0) * np.float32(spec.PLANNER_DT)
    assert touching.shape[1] == len(PARTS)
    return truth | {"touched_ticks": touched, "since_touch": since.astype(np.float32)}
