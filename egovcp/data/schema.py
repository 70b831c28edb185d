"""The LeRobot v3.0 layout of an egovcp dataset: files, columns, types."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any, Final

import pyarrow as pa

from egovcp import spec
from egovcp.robot_spec import G1, RobotSpec

CODEBASE_VERSION: Final = "v3.0"
DEPTH_UNIT: Final = "mm"
CHUNK_FILES: Final = 1000  # files per chunk folder
FILE_MB: Final = 100  # for LeRobot's writer, should it append

DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH: Final = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO_PATH: Final = "meta/info.json"
STATS_PATH: Final = "meta/stats.json"
TASKS_PATH: Final = "meta/tasks.parquet"
#: Provenance and the scenario of each episode, which are not part of the LeRobot format.
COLLECTION_PATH: Final = "meta/collection.json"
COLLECTION_VERSION: Final = 2
#: SHA-256 of every other file.
HASHES_PATH: Final = "meta/sha256.json"
#: Hub commit of a downloaded folder.
SOURCE_PATH: Final = "meta/source.json"
#: Episodes per shard: one data file and one file of the episodes table (150 ticks: 95 MB).
SHARD_EPISODES: Final = 100

#: Columns that LeRobot adds to every dataset.
INDEX_FEATURES: Final[dict[str, dict[str, object]]] = {
    key: {"dtype": "float32" if key == "timestamp" else "int64", "shape": (1,), "names": None}
    for key in ("timestamp", "frame_index", "episode_index", "index", "task_index")
}
#: All columns, with the shapes and names of the G1.
FEATURES: Final = {**spec.FEATURES, **INDEX_FEATURES}

#: Numeric columns in the order of ``FEATURES``; every one but the depth image.
NUMERIC_KEYS: Final = tuple(key for key in FEATURES if key != spec.DEPTH_KEY)
#: Those of an `Episode`; the others give the position of a frame in the dataset.
DATA_KEYS: Final = tuple(key for key in spec.FEATURES if key != spec.DEPTH_KEY)


def features_of(robot: RobotSpec) -> dict[str, dict[str, object]]:
    """`FEATURES` with the shapes and names of ``robot``."""
    return {**robot.features, **INDEX_FEATURES}


def feature_of(key: str, robot: RobotSpec) -> Mapping[str, Any]:
    """The description of a column."""
    return INDEX_FEATURES.get(key) or robot.features[key]


def width(key: str, robot: RobotSpec = G1) -> int:
    """Values per frame of a numeric column."""
    shape = feature_of(key, robot)["shape"]
    assert isinstance(shape, tuple)
    return int(shape[0])


def type_problems(found: pa.Schema, robot: RobotSpec = G1) -> Iterator[str]:
    """Problems of the columns of a data file; lists may be of fixed size or not."""
    expected = arrow_schema(robot)
    for name in sorted(set(expected.names) - set(found.names) - set(spec.OPTIONAL_KEYS)):
        yield f"column {name} is missing"
    for field in found:
        if field.name in expected.names:
            want = expected.field(field.name).type
            if _elements(field.type) != _elements(want):
                yield f"column {field.name} is {field.type}, expected {want}"


def _elements(kind: pa.DataType) -> tuple[bool, pa.DataType]:
    """Whether a type is a list, and its element type."""
    listed = pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)
    return listed, kind.value_type if listed else kind


def info_features(controller_id: str, robot: RobotSpec = G1) -> dict[str, dict[str, object]]:
    """The ``features`` of ``info.json``.

    The action's ``info`` names the controller, on which the effect of an action depends: LeRobot's
    tools keep feature descriptions and refuse to merge datasets in which they differ.
    """
    features = {key: dict(value) for key, value in features_of(robot).items()}
    features[spec.DEPTH_KEY]["info"] = {"is_depth_map": True, "depth_unit": DEPTH_UNIT}
    features[spec.ACTION_KEY]["info"] = {"controller_id": controller_id}
    return features


def arrow_schema(robot: RobotSpec = G1) -> pa.Schema:
    """Arrow schema of the data files, with the metadata that `datasets` reads its types from."""
    features = features_of(robot)
    fields = [pa.field(key, _arrow_type(feature)) for key, feature in features.items()]
    hub = {key: _hub_type(feature) for key, feature in features.items()}
    metadata = {"huggingface": json.dumps({"info": {"features": hub}})}
    return pa.schema(fields, metadata=metadata)


def episode_schema(robot: RobotSpec = G1) -> pa.Schema:
    """Arrow schema of an episode: depth and `DATA_KEYS`."""
    fields = robot.features.items()
    return pa.schema([pa.field(key, _arrow_type(feature)) for key, feature in fields])


def _arrow_type(feature: Mapping[str, Any]) -> pa.DataType:
    if feature["dtype"] == "image":
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    scalar = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}[feature["dtype"]]
    size = feature["shape"][0]
    return scalar if size == 1 else pa.list_(scalar, size)


def _hub_type(feature: Mapping[str, Any]) -> dict[str, object]:
    if feature["dtype"] == "image":
        return {"_type": "Image"}
    scalar = {"dtype": feature["dtype"], "_type": "Value"}
    size = feature["shape"][0]
    return scalar if size == 1 else {"feature": scalar, "length": size, "_type": "List"}
