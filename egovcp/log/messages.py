"""Encodes a tick as ROS 2 messages, one per topic, and decodes them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, Final, Literal
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from egovcp.log import ros2
from egovcp.log.pose import RobotPose, robot_pose
from egovcp.log.tick import (
    MODES,
    CameraView,
    Candidates,
    Hand,
    MotorReadings,
    Tick,
    ValueMap,
)
from egovcp.robot.geometry import quaternion
from egovcp.robot.kinematics import LINK_NAMES
from egovcp.robot_spec import G1, RobotSpec
from egovcp.spec import JOINT_NAMES, STATE_SLICES, Solid

CAMERA_FRAME: Final = "head_camera_optical"
_NO_FRAME: Final = ""  # in the camera frame, viewers would draw decoded points into the scene
HEADING_FRAME: Final = "pelvis_heading"
_FRAMES: Final = (
    *LINK_NAMES,
    CAMERA_FRAME,
    HEADING_FRAME,
    "left_hand_target",
    "right_hand_target",
)
CANDIDATE_FIELDS: Final = ("x", "y", "z", "value")
#: Number of temperatures per motor -> their names.
TEMPERATURE_SENSORS: Final = {1: ("motor",), 2: ("casing", "winding")}
_JOINTS: Final = ",".join(JOINT_NAMES)
_FLAGS: Final = ("terminated", "truncated", "success")
MOTOR_STATUS_ROWS: Final = ("faults", "enabled")


class Topic(StrEnum):
    """Topics of a recording."""

    DEPTH = "/head/depth"
    RECONSTRUCTED = "/head/depth_reconstructed"
    IMAGINED = "/head/depth_imagined"  # 1..K ticks ahead, side by side
    CAMERA_INFO = "/head/camera_info"
    TF = "/tf"
    BASE = "/robot/base_pose"  # from the simulator
    JOINTS = "/robot/joint_states"
    MOTOR_TEMPERATURE = "/robot/motor_temperature"  # rows: casing and winding, or one value
    MOTOR_STATUS = "/robot/motor_status"  # rows: the reported ones of faults, enabled
    STATE = "/policy/state"
    ACTION = "/policy/action"  # as sent
    ACTION_PLANNED = "/policy/action_planned"
    PLAN = "/plan/best"
    CANDIDATES = "/plan/candidates"  # rows: candidates; columns: left then right per step
    PLAN_SCALARS = "/plan/scalars"
    VALUE_MAP_LEFT = "/plan/value_map/left"  # rows: z ascending; columns: x ascending
    VALUE_MAP_RIGHT = "/plan/value_map/right"
    REWARD = "/reward"
    TIMING = "/timing"
    MODE = "/runner/state"  # 1 for the state of the runner, 0 for others
    LINK = "/runner/link"  # rate, jitter, loss and age of the robot's messages
    SCENE = "/scene/objects"
    LOG = "/rosout"


VALUE_MAPS: Final[dict[Hand, Topic]] = {
    "left": Topic.VALUE_MAP_LEFT,
    "right": Topic.VALUE_MAP_RIGHT,
}
MESSAGE_TYPES: Final = {
    Topic.DEPTH: "sensor_msgs/Image",
    Topic.RECONSTRUCTED: "sensor_msgs/Image",
    Topic.IMAGINED: "sensor_msgs/Image",
    Topic.CAMERA_INFO: "sensor_msgs/CameraInfo",
    Topic.TF: "tf2_msgs/TFMessage",
    Topic.BASE: "geometry_msgs/PoseStamped",
    Topic.JOINTS: "sensor_msgs/JointState",
    Topic.CANDIDATES: "sensor_msgs/PointCloud2",
    Topic.VALUE_MAP_LEFT: "sensor_msgs/PointCloud2",
    Topic.VALUE_MAP_RIGHT: "sensor_msgs/PointCloud2",
    Topic.LOG: "rcl_interfaces/Log",
}


def message_type(topic: Topic) -> str:
    """ROS 2 type of the messages on ``topic``, such as ``sensor_msgs/Image``."""
    return MESSAGE_TYPES.get(topic, "std_msgs/Float64MultiArray")


def encode_tick(tick: Tick, view: CameraView, robot: RobotSpec = G1) -> dict[Topic, bytes]:
    """All messages of one tick; topics without data are left out.

    Of another robot than the G1, the model of its links and of its camera is not known: there are
    no transforms, joint states and camera parameters.
    """
    messages = {
        **_image_messages(tick),
        **(_g1_messages(tick, view) if robot.is_g1 else {}),
        **_policy_messages(tick, robot),
        **_plan_messages(tick, robot),
        **_outcome_messages(tick),
    }
    if tick.base is not None:
        messages[Topic.BASE] = ros2.pose_stamped(tick.time_ns, tick.base[:3], tick.base[3:])
    return messages


def _image_messages(tick: Tick) -> dict[Topic, bytes]:
    t = tick.time_ns
    messages = {Topic.DEPTH: ros2.image_16uc1(t, CAMERA_FRAME, tick.depth)}
    if tick.depth_reconstructed is not None:
        image = to_millimetres(tick.depth_reconstructed)
        messages[Topic.RECONSTRUCTED] = ros2.image_16uc1(t, _NO_FRAME, image)
    if tick.depth_imagined is not None:
        strip = np.concatenate(list(to_millimetres(tick.depth_imagined)), axis=1)
        messages[Topic.IMAGINED] = ros2.image_16uc1(t, _NO_FRAME, strip)
    return messages


def _transform_tree(tick: Tick, pose: RobotPose, view: CameraView) -> bytes:
    """Every link, the camera, the heading frame and both hand targets, each in the world."""
    camera_position, camera_rotation = pose.camera(view)
    targets = pose.from_heading(tick.state[STATE_SLICES["command_hands"]].reshape(2, 3))
    pelvis = pose.positions_w[0]
    positions = [*pose.positions_w, camera_position, pelvis, *targets]
    extra = np.stack([camera_rotation, *[pose.heading_w] * 3])
    rotations = np.concatenate([pose.quaternions_w, quaternion(extra)])
    return ros2.transforms(tick.time_ns, _FRAMES, positions, rotations)


def _g1_messages(tick: Tick, view: CameraView) -> dict[Topic, bytes]:
    position = tick.state[STATE_SLICES["joint_position"]]
    velocity = tick.state[STATE_SLICES["joint_velocity"]]
    effort = () if tick.motors is None else tick.motors.torque
    messages = {
        Topic.CAMERA_INFO: ros2.camera_info(tick.time_ns, CAMERA_FRAME, view),
        Topic.TF: _transform_tree(tick, robot_pose(tick), view),
        Topic.JOINTS: ros2.joint_state(tick.time_ns, JOINT_NAMES, position, velocity, effort),
    }
    if tick.motors is not None:
        messages |= _motor_messages(tick.motors)
    return messages


def _policy_messages(tick: Tick, robot: RobotSpec) -> dict[Topic, bytes]:
    states, actions = ",".join(robot.state_names), ",".join(robot.action_names)
    return {
        Topic.STATE: ros2.multi_array(tick.state, [states]),
        Topic.ACTION: ros2.multi_array(tick.action_sent, [actions]),
        Topic.ACTION_PLANNED: ros2.multi_array(tick.action_planned, [actions]),
    }


def _motor_messages(motors: MotorReadings) -> dict[Topic, bytes]:
    messages = {}
    if motors.temperature is not None:
        sensors = TEMPERATURE_SENSORS[motors.temperature.shape[1]]
        messages[Topic.MOTOR_TEMPERATURE] = ros2.multi_array(
            motors.temperature.T, [",".join(sensors), _JOINTS]
        )
    rows = {name: getattr(motors, name) for name in MOTOR_STATUS_ROWS}
    known = {name: row for name, row in rows.items() if row is not None}
    if known:
        labels = [",".join(known), _JOINTS]
        messages[Topic.MOTOR_STATUS] = ros2.multi_array(np.stack(list(known.values())), labels)
    return messages


def _plan_messages(tick: Tick, robot: RobotSpec) -> dict[Topic, bytes]:
    messages = {}
    if tick.plan is not None:
        actions = ",".join(robot.action_names)
        messages[Topic.PLAN] = ros2.multi_array(tick.plan, ["step", actions])
    if tick.candidates is not None:
        cloud = candidate_cloud(tick.candidates)
        messages[Topic.CANDIDATES] = ros2.point_cloud(
            tick.time_ns, HEADING_FRAME, cloud, CANDIDATE_FIELDS
        )
    for value_map in tick.value_maps:
        messages[VALUE_MAPS[value_map.hand]] = ros2.point_cloud(
            tick.time_ns, HEADING_FRAME, value_map_cloud(value_map), CANDIDATE_FIELDS
        )
    scalars = {"value": tick.value, "termination": tick.termination}
    known = {name: value for name, value in scalars.items() if value is not None}
    if known:
        messages[Topic.PLAN_SCALARS] = _named(known)
    return messages


def _outcome_messages(tick: Tick) -> dict[Topic, bytes]:
    reward = {"reward": tick.reward} | {flag: float(getattr(tick, flag)) for flag in _FLAGS}
    messages = {Topic.REWARD: _named(reward | dict(tick.reward_terms))}
    if tick.mode:
        messages[Topic.MODE] = _named({mode: float(mode == tick.mode) for mode in MODES})
    if tick.link:
        messages[Topic.LINK] = _named(dict(tick.link))
    if tick.timing_ms:
        messages[Topic.TIMING] = _named(dict(tick.timing_ms))
    if tick.scene:
        rows = [(*o.position_w, *o.quaternion_w, *o.size) for o in tick.scene]
        names = ",".join(f"{_escaped(o.name)}:{o.shape}" for o in tick.scene)
        messages[Topic.SCENE] = ros2.multi_array(rows, [names, "x,y,z,qw,qx,qy,qz,sx,sy,sz"])
    if tick.events:
        messages[Topic.LOG] = ros2.log_line(tick.time_ns, "\n".join(tick.events))
    return messages


def _escaped(name: str) -> str:
    """A name without the separators of a label; the inverse is `urllib.parse.unquote`."""
    return name.replace("%", "%25").replace(":", "%3A").replace(",", "%2C")


def _named(scalars: dict[str, float]) -> bytes:
    """A vector whose axis label lists the names of its elements."""
    return ros2.multi_array(list(scalars.values()), [",".join(scalars)])


def to_millimetres(depth_m: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Metres -> whole millimetres; NaN, negative and too large values become 0."""
    mm = np.rint(np.nan_to_num(np.asarray(depth_m, np.float64), posinf=0.0) * 1000.0)
    return np.where((mm > 0) & (mm < 65536), mm, 0).astype(np.uint16)


def candidate_cloud(candidates: Candidates) -> NDArray[np.float32]:
    """(n, 2 N, 4) points x, y, z, value: per candidate, left and right hand of each step."""
    hands = np.asarray(candidates.hands_b, np.float32)
    points = hands.reshape(len(hands), -1, 3)
    values = np.asarray(candidates.values, np.float32)[:, None, None]
    return np.concatenate([points, np.broadcast_to(values, (*points.shape[:2], 1))], axis=2)


def value_map_cloud(value_map: ValueMap) -> NDArray[np.float32]:
    """(n, m, 4) points x, y, z, value: an organised point cloud."""
    z, x = np.meshgrid(value_map.z_b, value_map.x_b, indexing="ij")
    return np.stack([x, np.full_like(x, value_map.y_b), z, value_map.values], axis=-1)


# --- decoding ---------------------------------------------------------------------
def decode_tick(index: int, time_ns: int, messages: Mapping[str, Any]) -> Tick:
    """The inverse of `encode_tick`; decoded depths are rounded to millimetres."""
    reward = _scalars(messages[Topic.REWARD])
    plan = _scalars(messages.get(Topic.PLAN_SCALARS))
    flags = {name: bool(reward.pop(name)) for name in _FLAGS}
    total = reward.pop("reward")
    log = messages.get(Topic.LOG)
    sent = _array(messages[Topic.ACTION]).astype(np.float32)
    planned = messages.get(Topic.ACTION_PLANNED)
    return Tick(
        index=index,
        time_ns=time_ns,
        depth=_image(messages[Topic.DEPTH]),
        state=_array(messages[Topic.STATE]).astype(np.float32),
        action_planned=sent if planned is None else _array(planned).astype(np.float32),
        action_sent=sent,
        depth_reconstructed=_metres(messages.get(Topic.RECONSTRUCTED)),
        depth_imagined=_imagined(messages.get(Topic.IMAGINED), messages[Topic.DEPTH].width),
        plan=_array(messages[Topic.PLAN]) if Topic.PLAN in messages else None,
        candidates=_candidates(messages.get(Topic.CANDIDATES)),
        value=plan.get("value"),
        termination=plan.get("termination"),
        value_maps=_value_maps(messages),
        reward=total,
        reward_terms=reward,
        timing_ms=_scalars(messages.get(Topic.TIMING)),
        base=_base(messages.get(Topic.BASE)),
        scene=_scene(messages.get(Topic.SCENE)),
        events=tuple(log.msg.split("\n")) if log else (),
        mode="".join(name for name, is_in in _scalars(messages.get(Topic.MODE)).items() if is_in),
        motors=motor_readings(messages),
        link=_scalars(messages.get(Topic.LINK)),
        terminated=flags["terminated"],
        truncated=flags["truncated"],
        success=flags["success"],
    )


def motor_readings(messages: Mapping[str, Any]) -> MotorReadings | None:
    """Motor readings in the messages of a tick, topic -> message; None without a torque."""
    joints = messages.get(Topic.JOINTS)
    if joints is None or not len(joints.effort):
        return None
    temperature = messages.get(Topic.MOTOR_TEMPERATURE)
    status = _rows(messages.get(Topic.MOTOR_STATUS))
    return MotorReadings(
        torque=np.array(joints.effort, np.float64),
        temperature=None if temperature is None else _array(temperature).T,
        faults=status["faults"].astype(np.int64) if "faults" in status else None,
        enabled=None if "enabled" not in status else status["enabled"] != 0.0,
    )


def _rows(message: Any) -> dict[str, NDArray[np.float64]]:
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, _array(message), strict=True))


def _array(message: Any) -> NDArray[np.float64]:
    shape = [dimension.size for dimension in message.layout.dim]
    return np.array(message.data, np.float64).reshape(shape)


def _scalars(message: Any) -> dict[str, float]:
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, map(float, message.data), strict=True))


def _image(message: Any) -> NDArray[np.uint16]:
    return np.frombuffer(message.data, "<u2").reshape(message.height, message.width)


def _metres(message: Any) -> NDArray[np.float64] | None:
    return None if message is None else _image(message) / 1000.0


def _imagined(message: Any, columns: int) -> NDArray[np.float64] | None:
    strip = _metres(message)
    return None if strip is None else np.stack(np.split(strip, strip.shape[1] // columns, 1))


def _candidates(message: Any) -> Candidates | None:
    if message is None:
        return None
    points = np.frombuffer(message.data, "<f4").reshape(message.height, -1, 2, 4)
    return Candidates(hands_b=points[..., :3], values=points[:, 0, 0, 3])


def _value_maps(messages: Mapping[str, Any]) -> tuple[ValueMap, ...]:
    maps = []
    for hand, topic in VALUE_MAPS.items():
        if topic in messages:
            message = messages[topic]
            cloud = np.frombuffer(message.data, "<f4").reshape(message.height, message.width, 4)
            x, z, y = cloud[0, :, 0], cloud[:, 0, 2], float(cloud[0, 0, 1])
            maps.append(ValueMap(hand, x, y, z, cloud[..., 3]))
    return tuple(maps)


def _base(message: Any) -> NDArray[np.float64] | None:
    if message is None:
        return None
    p, q = message.pose.position, message.pose.orientation
    return np.array([p.x, p.y, p.z, q.w, q.x, q.y, q.z])


def _scene(message: Any) -> tuple[Solid, ...]:
    if message is None:
        return ()
    names = [label.split(":") for label in message.layout.dim[0].label.split(",")]
    scene = []
    for (name, shape), row in zip(names, _array(message), strict=True):
        x, y, z = row[7:].tolist()
        kind: Literal["sphere", "box"] = "sphere" if shape == "sphere" else "box"
        scene.append(Solid(unquote(name), kind, (x, y, z), row[:3], row[3:7]))
    return tuple(scene)
