"""Small datasets of many kinds, written by LeRobot itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

VIDEO = {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
IMAGE = {"dtype": "image", "shape": (3, 24, 32), "names": ["channels", "height", "width"]}
DEPTH = {"dtype": "image", "shape": (24, 32, 1), "names": None, "info": {"is_depth_map": True}}
STATE = {"dtype": "float32", "shape": (3,), "names": ["pan", "lift", "elbow"]}
ACTION = {"dtype": "float32", "shape": (2,), "names": {"motors": ["pan", "grip"]}}
ONE = {"shape": (1,), "names": None}

#: Name -> features, lengths of the episodes, tasks, and options of `LeRobotDataset.create`.
KINDS: Mapping[str, tuple[dict[str, Any], Sequence[int], Sequence[str], dict[str, Any]]] = {
    "arm": (
        {"observation.state": STATE, "action": ACTION, "observation.images.top": VIDEO},
        (8, 12, 7, 9),
        ("pick the cube", "open the drawer"),
        {"fps": 10},
    ),
    "cameras": (  # each of its videos, and of its data, is a file
        {
            "observation.images.left": VIDEO,
            "observation.images.right": {**VIDEO, "shape": (32, 32, 3)},
            "action": ACTION,
        },
        (6, 5, 7),
        ("push",),
        {"fps": 30, "video_files_size_in_mb": 0.001, "data_files_size_in_mb": 0.001},
    ),
    "images": (
        {"observation.image": IMAGE, "observation.depth": DEPTH, "observation.state": STATE},
        (5, 6, 5),
        ("look",),
        {"fps": 15, "use_videos": False},
    ),
    "types": (
        {
            "action": {"dtype": "int64", **ONE},
            "next.reward": {"dtype": "float64", **ONE},
            "next.done": {"dtype": "bool", **ONE},
            "note": {"dtype": "string", **ONE},
            "observation.grid": {"dtype": "float32", "shape": (4, 5), "names": None},
            "observation.far": {"dtype": "float32", "shape": (2,), "names": None},
        },
        (30, 40, 2),
        ("a", "b", "c"),
        {"fps": 50, "use_videos": False},
    ),
    "chunks": (  # no action, several chunks of two files
        {"observation.state": STATE},
        (20, 20, 20, 1, 20),
        ("wait",),
        {"fps": 25, "use_videos": False, "data_files_size_in_mb": 0.001, "chunks_size": 2},
    ),
}


def write_dataset(root: Path, kind: str) -> Path:
    """A dataset of one of `KINDS`."""
    return write_features(root, *KINDS[kind])


def write_features(
    root: Path,
    features: dict[str, Any],
    lengths: Sequence[int],
    tasks: Sequence[str],
    options: Mapping[str, Any],
) -> Path:
    """A dataset with these features, tasks in turn; for the arguments see `KINDS`."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    sizes = {k: v for k, v in options.items() if k not in ("fps", "use_videos")}
    dataset = LeRobotDataset.create(
        "me/theirs", features=features, root=root, robot_type="so100",
        fps=options["fps"], use_videos=options.get("use_videos", True),
    )  # fmt: skip
    dataset.meta.update_chunk_settings(**sizes)
    rng = np.random.default_rng(0)
    for number, length in enumerate(lengths):
        for t in range(length):
            frame = {key: _value(key, feature, t, rng) for key, feature in features.items()}
            dataset.add_frame({**frame, "task": tasks[number % len(tasks)]})
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def _value(
    key: str, feature: Mapping[str, Any], t: int, rng: np.random.Generator
) -> NDArray[Any] | str:
    shape, dtype = feature["shape"], feature["dtype"]
    if dtype == "string":
        return f"step {t}"
    if (feature.get("info") or {}).get("is_depth_map"):
        return rng.integers(300, 4000, shape, np.uint16)
    if dtype in ("video", "image"):
        return np.full(shape, 5 * t, np.uint8) + rng.integers(0, 20, shape, np.uint8)
    if dtype == "bool":
        return np.array([t % 5 == 0])
    if dtype == "int64":
        return rng.integers(0, 4, shape)
    offset = 1000.0 if key.endswith("far") else 0.0  # the variance nearly cancels in float32
    return (offset + rng.normal(size=shape)).astype(dtype)
