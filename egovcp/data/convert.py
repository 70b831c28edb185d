"""Converts a LeRobot dataset of any robot into one with the features that the world model learns
from: an image, a state, an action and a reward."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import schema
from egovcp.data.camera_images import camera_images
from egovcp.data.episode import Episode
from egovcp.data.features import Feature, nonfinite_problem, values_of
from egovcp.data.lerobot import EpisodeRow, LeRobotReader, is_own
from egovcp.data.provenance import Provenance
from egovcp.data.source import Source, select_episodes
from egovcp.data.writer import DatasetWriter
from egovcp.errors import DataError, UsageError, suggest
from egovcp.packages import require_packages
from egovcp.robot_spec import PATCH, RobotSpec

#: What is converted -> the feature that it is called in most datasets.
INPUTS: Final[Mapping[str, str]] = {
    "image": "",
    "state": spec.STATE_KEY,
    "action": spec.ACTION_KEY,
    "reward": "next.reward",
    "success": "next.success",
}
_OPTIONAL: Final = ("success",)
_ROWS: Final = 48  # of a converted image, those of the G1
_LEAST_RANGE: Final = 2e-3  # of an action that is constant in the data
_GREY_MM: Final = 10


def convert_dataset(
    source: Source, features: Mapping[str, str], root: Path, episodes: str = ""
) -> None:
    """Write the episodes of a LeRobot dataset to a new dataset of egovcp.

    - Images get 48 rows, or fewer, and columns in proportion. Depth beyond `spec.DEPTH_MAX_M` is
      invalid. A colour image becomes a grey one, whose value g is stored as a depth of (1 + g) cm.
    - Actions are mapped to [-1, 1] from the range that each has in the converted episodes.
    - Every episode counts as ended by its time limit. It has no success unless the dataset has.

    Args:
        features: name of the feature of some of `INPUTS`; the others have their usual names, and
            the image is that of the only camera.
        root: the new dataset; must be absent or an empty folder.
        episodes: the converted episodes (see `select_episodes`); empty: all.

    Raises:
        UsageError: the dataset has no such feature, or it cannot be used.
        DataError: an episode is damaged.
    """
    if is_own(source.root):
        raise UsageError(f"{source.root} has egovcp's features already; leave out --features")
    reader = LeRobotReader.open(source.root)
    chosen = _choose(reader, features)
    if chosen["image"].dtype == "video":
        require_packages("egovcp", "a dataset with videos", "av")
    wanted = set(select_episodes(episodes, len(reader.rows)).tolist())
    rows = {row.index: row for row in reader.rows if row.index in wanted}
    robot = _robot(reader, chosen, _action_range(reader, chosen["action"], rows))
    origin = Provenance(
        controller_id=robot.robot_type,
        config={
            "converted_from": {
                "repo_id": source.repo_id,
                "revision": source.commit,
                "features": {name: feature.key for name, feature in chosen.items()},
            }
        },
        origin="converted",
    )
    columns = [f.key for f in chosen.values() if f.dtype != "video"]
    with DatasetWriter(root, origin) as writer, tqdm(total=len(rows), desc="convert") as bar:
        for row, table in _tables(reader, rows, [*columns, "timestamp", "task_index"]):
            try:
                episode = _episode(reader, row, table, chosen, robot)
            except DataError as error:
                raise _placed(error, row) from error
            writer.add(episode)
            bar.update()


def _choose(reader: LeRobotReader, features: Mapping[str, str]) -> dict[str, Feature]:
    """The feature of each input."""
    for key in schema.INDEX_FEATURES:
        if key not in reader.features:
            raise DataError.at(reader.root / schema.INFO_PATH, f"feature {key} is missing")
    for name in features:
        if name not in INPUTS:
            raise UsageError(f"--features: unknown name {name!r}{suggest(name, INPUTS)}")
    cameras = [key for key, feature in reader.features.items() if feature.is_camera]
    usual = {**INPUTS, "image": cameras[0] if len(cameras) == 1 else ""}
    chosen = {}
    for name, key in {**usual, **features}.items():
        if key in reader.features:
            chosen[name] = reader.features[key]
        elif name in features or name not in _OPTIONAL:
            problem = f"has no feature {key!r}" if key else f"has {len(cameras)} cameras"
            known = cameras if name == "image" else reader.features
            raise UsageError(
                f"{reader.root} {problem}; give the {name} as --features='{{{name}: NAME}}'"
                f"{suggest(key, known)}"
            )
    for name, feature in chosen.items():
        if feature.is_camera != (name == "image") or not (feature.is_camera or feature.is_numeric):
            kind = "a camera" if name == "image" else "numbers"
            raise UsageError(
                f"--features: {name} must be {kind}, but {feature.key} is of dtype {feature.dtype}"
            )
        if name in ("reward", "success") and feature.size != 1:
            raise UsageError(
                f"--features: {name} must be one value per frame, but {feature.key} has "
                f"{feature.size}"
            )
    return chosen


def _action_range(
    reader: LeRobotReader, feature: Feature, rows: Mapping[int, EpisodeRow]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and largest value (A,) of each action."""
    low, high = np.full(feature.size, np.inf), np.full(feature.size, -np.inf)
    for row, table in _tables(reader, rows, [feature.key]):
        try:
            values = _numbers(table, feature)
        except DataError as error:
            raise _placed(error, row) from error
        low, high = np.minimum(low, values.min(0)), np.maximum(high, values.max(0))
    widened = np.maximum(_LEAST_RANGE - (high - low), 0) / 2
    return low - widened, high + widened


def _robot(
    reader: LeRobotReader,
    chosen: Mapping[str, Feature],
    action_range: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> RobotSpec:
    low, high = action_range
    if reader.fps != round(reader.fps):
        raise UsageError(f"{reader.root} has {reader.fps} fps; expected a whole number")
    box = spec.ActionBox(*(tuple(x.tolist()) for x in (low, (low + high) / 2, high)))
    image = chosen["image"]
    try:
        return RobotSpec(
            robot_type=str(reader.info.get("robot_type") or "unknown"),
            depth=_image_size(image),
            depth_max_m=spec.DEPTH_MAX_M if image.is_depth else 256 * _GREY_MM / 1000,
            planner_hz=round(reader.fps),
            state_names=_names(chosen["state"]),
            action_names=_names(chosen["action"]),
            action_box=box,
        )
    except UsageError as error:
        raise UsageError(f"{reader.root} cannot be learned from: {error}") from error


def _image_size(camera: Feature) -> tuple[int, int]:
    """Rows and columns of the converted images."""
    channels_first = camera.shape[0] in (1, 3)
    height, width = camera.shape[1:] if channels_first else camera.shape[:2]
    rows = min(_ROWS, max(PATCH, height // PATCH * PATCH))
    return rows, max(PATCH, round(rows * width / height / PATCH) * PATCH)


def _names(feature: Feature) -> tuple[str, ...]:
    return feature.names or tuple(map(str, range(feature.size)))


def _tables(
    reader: LeRobotReader, rows: Mapping[int, EpisodeRow], columns: list[str]
) -> Iterator[tuple[EpisodeRow, pa.Table]]:
    """Some columns of the episodes ``rows``, in order.

    Raises:
        DataError: one cannot be read, or is not complete.
    """
    left = dict(rows)
    for path in dict.fromkeys(row.data_path for row in rows.values()):
        for found in reader.episodes(path, columns):
            if isinstance(found, DataError):
                raise found
            number, table = found
            row = left.pop(number, None)
            if row is None:
                continue
            for key in columns:  # pyarrow does not report a column that is missing
                if key not in table.column_names:
                    raise DataError.at(path, f"column {key} is missing", number)
            if table.num_rows != row.length:
                problem = f"holds {table.num_rows} rows of it, expected {row.length}"
                raise DataError.at(path, problem, number)
            yield row, table
    if left:
        row = next(iter(left.values()))
        raise DataError.at(row.data_path, "has no rows of this episode", row.index)


def _episode(
    reader: LeRobotReader,
    row: EpisodeRow,
    table: pa.Table,
    chosen: Mapping[str, Feature],
    robot: RobotSpec,
) -> Episode:
    """Raises `DataError` with `frame` set."""
    last = np.arange(row.length) == row.length - 1
    times = values_of(table["timestamp"], reader.features["timestamp"])[:, 0].astype(np.float64)
    images = camera_images(row, chosen["image"], table, times)
    low, high = (np.array(x) for x in (robot.action_box.low, robot.action_box.high))
    action = 2 * (_numbers(table, chosen["action"]) - low) / (high - low) - 1
    success: NDArray[np.bool_] = np.zeros(row.length, np.bool_)
    if "success" in chosen:
        success = _numbers(table, chosen["success"])[:, 0] > 0
    return Episode(
        depth=np.stack([_depth(image, robot) for image in images]),
        state=_numbers(table, chosen["state"]).astype(np.float32),
        action=action.clip(-1, 1).astype(np.float32),
        reward=_numbers(table, chosen["reward"])[:, 0].astype(np.float32),
        done=last,
        success=success,
        truncated=last,
        task=_task(reader, table),
        time_limit=row.length,
        metadata={"episode": row.index},
        robot=robot,
    )


def _numbers(table: pa.Table, feature: Feature) -> NDArray[np.float64]:
    """(T, n) finite values; raises `DataError` with `frame` set."""
    values = values_of(table[feature.key], feature)
    if found := nonfinite_problem(values, feature):
        frame, problem = found
        raise DataError.without_place(problem, frame)
    return values.astype(np.float64)


def _depth(image: NDArray[Any], robot: RobotSpec) -> NDArray[np.uint16]:
    """The image of a camera, (H, W) uint16 in mm, (H, W) float32 in m or (H, W, 3) uint8, as depth
    in mm with the size and range of ``robot``.

    Depth is sampled, because a mean over an edge would lie on no surface; colours are averaged.
    """
    from PIL import Image

    rows, cols = robot.depth
    if image.ndim == 3 or image.dtype == np.uint8:
        grey = Image.fromarray(image).convert("L").resize((cols, rows), Image.Resampling.BOX)
        return np.asarray(_GREY_MM * (1 + np.asarray(grey).astype(np.uint16)))
    at_row, at_col = (
        ((np.arange(n) + 0.5) * size / n).astype(int)
        for n, size in ((rows, image.shape[0]), (cols, image.shape[1]))
    )
    depth = image[at_row][:, at_col].astype(np.float64)
    if np.issubdtype(image.dtype, np.floating):
        depth *= 1000
    valid = (depth > 0) & (depth <= robot.depth_max_m * 1000)
    return np.where(valid, depth, 0).round().astype(np.uint16)


def _task(reader: LeRobotReader, table: pa.Table) -> str:
    number = int(values_of(table["task_index"], reader.features["task_index"])[0, 0])
    return reader.tasks.get(number, f"task {number}")


def _placed(error: DataError, row: EpisodeRow) -> DataError:
    path = error.file or row.data_path  # a video is another file
    return DataError.at(path, error.problem or str(error), row.index, error.frame)
