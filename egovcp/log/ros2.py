"""ROS 2 message types of the MCAP logs: their definitions and their encoders.

Rerun and Foxglove show these types without plugins. Every encoder takes the time of the tick in
nanoseconds and returns CDR bytes. CDR is encoded here because a generic encoder visits each number
in Python, which takes longer than the millisecond that the loop has.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from egovcp.log.tick import CameraView
from egovcp.rate import NS_PER_S
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS

_ENCAPSULATION: Final = b"\x00\x01\x00\x00"  # plain CDR, little endian
_HEADER_BYTES: Final = len(_ENCAPSULATION)
_PARTS: Final = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n"
        "uint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort"
    ),
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense"
    ),
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/Float64MultiArray": "std_msgs/MultiArrayLayout layout\nfloat64[] data",
    "rcl_interfaces/Log": (
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\n"
        "string function\nuint32 line"
    ),
}

_FLOAT32: Final = 7  # sensor_msgs/PointField.FLOAT32
_STAMP_BYTES: Final = 8
_POSE_BYTES: Final = 7 * 8
_INFO: Final = 20  # rcl_interfaces/Log.INFO


class Cdr:
    """Builds one message field by field; every method returns the builder.

    A message is a 4-byte encapsulation header and its fields in order. A primitive is aligned to
    its own size, counted from the end of the header. Sequences and strings start with a u32 length;
    strings end in a zero byte that the length includes.
    """

    def __init__(self) -> None:
        self._buffer = bytearray(_ENCAPSULATION)

    def _align(self, size: int) -> None:
        self._buffer += bytes(-(len(self._buffer) - _HEADER_BYTES) % size)

    def u8(self, value: int) -> Self:
        self._buffer.append(value)
        return self

    def i32(self, value: int) -> Self:
        self._align(4)
        self._buffer += struct.pack("<i", value)
        return self

    def u32(self, *values: int) -> Self:
        self._align(4)
        self._buffer += struct.pack(f"<{len(values)}I", *values)
        return self

    def string(self, text: str) -> Self:
        self._align(4)
        self._buffer += _string(text)
        return self

    def strings(self, texts: tuple[str, ...]) -> Self:
        self._align(4)
        self._buffer += _strings(texts)
        return self

    def octets(self, data: bytes) -> Self:
        self.u32(len(data))
        self._buffer += data
        return self

    def f64(self, values: ArrayLike) -> Self:
        """Doubles of any shape, row-major, without a length: a fixed-size field."""
        array = np.asarray(values, dtype="<f8")
        if array.size:
            self._align(8)
            self._buffer += array.tobytes()
        return self

    def f64s(self, values: ArrayLike) -> Self:
        """Sequence of doubles: length, then the values."""
        array = np.asarray(values, dtype="<f8")
        return self.u32(array.size).f64(array)

    def raw(self, data: bytes) -> Self:
        """Encoded bytes, which must fit the current alignment."""
        self._buffer += data
        return self

    def done(self) -> bytes:
        return bytes(self._buffer)


@lru_cache(maxsize=1024)
def _string(text: str) -> bytes:
    """An encoded string from an aligned start; cached, since names repeat in every tick."""
    data = text.encode()
    return struct.pack("<I", len(data) + 1) + data + b"\x00"


@lru_cache(maxsize=64)
def _strings(texts: tuple[str, ...]) -> bytes:
    """An encoded sequence of strings from an aligned start."""
    cdr = Cdr().u32(len(texts))
    for text in texts:
        cdr.string(text)
    return cdr.done()[_HEADER_BYTES:]


def definition(name: str) -> str:
    """Text of message ``name`` (such as ``sensor_msgs/Image``) with all its dependencies."""
    text = _PARTS[name]
    for part in _dependencies(name):
        text += f"\n{'=' * 80}\nMSG: {part}\n{_PARTS[part]}"
    return text


def _dependencies(name: str) -> list[str]:
    """Every message type inside ``name``, outermost first, each once."""
    found: dict[str, None] = {}
    for line in _PARTS[name].splitlines():
        kind = line.split()[0].removesuffix("[]")
        if kind in _PARTS:
            found |= dict.fromkeys([kind, *_dependencies(kind)])
    return list(found)


def _stamp(cdr: Cdr, time_ns: int) -> Cdr:
    return cdr.i32(time_ns // NS_PER_S).u32(time_ns % NS_PER_S)


def _header(time_ns: int, frame: str) -> Cdr:
    return _stamp(Cdr(), time_ns).string(frame)


def image_16uc1(time_ns: int, frame: str, image: NDArray[np.uint16]) -> bytes:
    """``sensor_msgs/Image`` of depth (H, W) in millimetres."""
    rows, cols = image.shape
    cdr = _header(time_ns, frame).u32(rows, cols).string("16UC1").u8(0).u32(2 * cols)
    return cdr.octets(image.astype("<u2", copy=False).tobytes()).done()


def camera_info(time_ns: int, frame: str, view: CameraView) -> bytes:
    """``sensor_msgs/CameraInfo`` of an undistorted pinhole."""
    f, (column, row) = view.focal_px, view.centre_px
    cx, cy = column - 0.5, row - 0.5  # ROS counts from the centre of the first pixel
    cdr = _header(time_ns, frame).u32(DEPTH_ROWS, DEPTH_COLS).string("plumb_bob").f64s([0.0] * 5)
    cdr.f64([f, 0, cx, 0, f, cy, 0, 0, 1]).f64(np.eye(3))
    cdr.f64([f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1, 0])
    return cdr.u32(0, 0).u32(0, 0, 0, 0).u8(0).done()


def transforms(
    time_ns: int, names: Sequence[str], positions: ArrayLike, quaternions: ArrayLike
) -> bytes:
    """``tf2_msgs/TFMessage`` of frames in ``world``: (n, 3) m and (n, 4) wxyz."""
    stamp = _stamp(Cdr(), time_ns).done()[_HEADER_BYTES:]
    cdr = Cdr().u32(len(names))
    poses = _pose_rows(positions, quaternions).astype("<f8", copy=False)
    for between, pose in zip(_frame_names(tuple(names)), poses, strict=True):
        cdr.raw(stamp).raw(between).raw(pose.tobytes())
    return cdr.done()


@lru_cache(maxsize=16)
def _frame_names(names: tuple[str, ...]) -> tuple[bytes, ...]:
    """The bytes between stamp and pose of each transform: frame names and padding."""
    cdr = Cdr().u32(len(names))
    parts = []
    for name in names:
        start = len(cdr.raw(bytes(_STAMP_BYTES)).done())
        cdr.string("world").string(name).f64(np.zeros(7))
        parts.append(cdr.done()[start:-_POSE_BYTES])
    return tuple(parts)


def pose_stamped(time_ns: int, position: ArrayLike, quaternion: ArrayLike) -> bytes:
    """``geometry_msgs/PoseStamped`` in ``world``: (3,) m and (4,) wxyz."""
    rows = _pose_rows(np.reshape(position, (1, 3)), np.reshape(quaternion, (1, 4)))
    return _header(time_ns, "world").f64(rows).done()


def _pose_rows(positions: ArrayLike, quaternions: ArrayLike) -> NDArray[np.float64]:
    """(n, 7): ROS orders quaternions x, y, z, w."""
    wxyz = np.asarray(quaternions, np.float64)
    return np.concatenate([np.asarray(positions, np.float64), wxyz[:, [1, 2, 3, 0]]], axis=1)


def joint_state(
    time_ns: int,
    names: tuple[str, ...],
    position: ArrayLike,
    velocity: ArrayLike,
    effort: ArrayLike = (),
) -> bytes:
    """``sensor_msgs/JointState``: rad, rad/s and N m; no effort if it is not measured."""
    return _header(time_ns, "").strings(names).f64s(position).f64s(velocity).f64s(effort).done()


def multi_array(values: ArrayLike, labels: Sequence[str]) -> bytes:
    """``std_msgs/Float64MultiArray``: one label per axis of ``values``."""
    array = np.asarray(values, np.float64)
    cdr = Cdr().u32(array.ndim)
    for axis, label in enumerate(labels):
        stride = int(np.prod(array.shape[axis:]))
        cdr.string(label).u32(array.shape[axis], stride)
    return cdr.u32(0).f64s(array).done()


def point_cloud(
    time_ns: int, frame: str, points: NDArray[np.float32], fields: Sequence[str]
) -> bytes:
    """``sensor_msgs/PointCloud2`` of float32 rows (height, width, len(fields)); xyz in metres."""
    height, width, count = points.shape
    cdr = _header(time_ns, frame).u32(height, width).u32(count)
    for i, name in enumerate(fields):
        cdr.string(name).u32(4 * i).u8(_FLOAT32).u32(1)
    cdr.u8(0).u32(4 * count, 4 * count * width)
    return cdr.octets(points.astype("<f4", copy=False).tobytes()).u8(1).done()


def log_line(time_ns: int, text: str) -> bytes:
    """``rcl_interfaces/Log`` at level INFO."""
    cdr = _stamp(Cdr(), time_ns).u8(_INFO).string("egovcp").string(text)
    return cdr.string("").string("").u32(0).done()
