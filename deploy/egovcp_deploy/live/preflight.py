"""What `--dry_run` finds at a robot: controller, mode, pose, motors, connection and camera.

Every check is one line. The limits that are not those of the runner are unverified on hardware.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.artifact import Artifact
from egovcp.errors import EnvironmentFailure
from egovcp.robot.controllers import make_controller
from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER, LINK_NAMES, link_transforms
from egovcp.robot.stance import pelvis_height
from egovcp.robot.stance_table import standing_pose
from egovcp.spec import ACTION_BOX, JOINT_NAMES
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.dry_run import Finding, examine
from egovcp_deploy.live.hardware import open_eye
from egovcp_deploy.pilot.motor_watch import MotorWatch, hottest
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.base import DepthImage, LowState, projected_gravity
from egovcp_deploy.robots.bridge import BridgeRobot
from egovcp_deploy.robots.g1_variants import describe_variant
from egovcp_deploy.robots.realsense_camera import RealSenseDepthCamera
from egovcp_deploy.robots.subscriber import ArrivalStats
from egovcp_deploy.robots.zmq_camera import ZmqDepthCamera

Array = NDArray[np.float64]

LISTEN_S: Final = 5.0
MOST_LOST: Final = 0.05  # of the messages
STATE_HZ: Final = 100.0
IMAGE_HZ: Final = 15.0
MOST_OFFSET: Final = 1.5  # rad from neutral: the way of 3 s at half a radian per second
RANGE_MARGIN: Final = 0.1  # rad beyond the joint range; more is a wrong zero
MOST_TILT: Final = 0.35  # rad between pelvis and vertical; the runner damps at 1.0
POSTURE_TOLERANCE: Final = 0.15  # rad between the IMU and a pelvis above flat feet
_SHOWN_OFFSET: Final = 0.1  # rad
_FEET: Final = [LINK_NAMES.index(f"{side}_ankle_roll_link") for side in ("left", "right")]


@dataclass
class Heard:
    """What arrived within `LISTEN_S`."""

    reading: LowState | None = None
    """The newest."""
    states: ArrivalStats = field(default_factory=ArrivalStats)
    motors: str = ""
    """Why the motors forbid to arm."""
    motor_events: list[str] = field(default_factory=list)
    images: ArrivalStats = field(default_factory=ArrivalStats)
    image_ages_ms: list[float] = field(default_factory=list)
    """Of every image when it arrived, where the camera tells."""


def examine_hardware(config: DeployConfig, artifact: Artifact | None) -> Iterator[Finding]:
    """Controller, robot and camera."""

    def controller() -> str:
        found = make_controller(config.robot.controller).id
        if artifact is not None:
            artifact.require_controller(found)
        return found

    yield examine("controller", controller)
    with ExitStack() as stack:
        body = BridgeRobot(config.robot.bridge)
        robot = examine("robot", lambda: _connect(body))
        yield robot
        if robot.error is None:
            stack.callback(body.close)
        eyes: list[ZmqDepthCamera | RealSenseDepthCamera] = []

        def camera() -> str:
            eyes.append(open_eye(config.robot.camera))
            stack.callback(eyes[0].close)
            return "answers"

        yield examine("camera", camera)
        connected = body if robot.error is None else None
        heard = listen(connected, eyes[0] if eyes else None, LISTEN_S)
        if heard.reading is not None:
            yield from _examine_robot(body, heard, config.robot.limits)
        if eyes:
            gap_ms = config.robot.limits.picture_hold_s * 1e3
            yield examine("images", lambda: arrivals(heard.images, IMAGE_HZ, gap_ms, "images"))
            most_ms = config.env.delay.image_age[1] * 1e3
            yield examine("image age", lambda: image_age(heard.image_ages_ms, most_ms))


def _examine_robot(body: BridgeRobot, heard: Heard, limits: Limits) -> Iterator[Finding]:
    reading = heard.reading
    assert reading is not None, "called once one has arrived"
    yield Finding("mode", describe_variant(reading.mode))
    yield examine("joints", lambda: joint_offsets(reading.joint_position))
    yield examine("posture", lambda: posture(reading.joint_position, reading.quaternion_w))
    yield examine("motors", lambda: motors(reading, heard))
    most_gap_ms = limits.state_hold_s * 1e3
    yield examine("states", lambda: arrivals(heard.states, STATE_HZ, most_gap_ms, "states"))
    yield examine("other publishers", lambda: _alone(body))


def _connect(body: BridgeRobot) -> str:
    body.connect()
    return f"answers at {body.config.host}"


def _alone(body: BridgeRobot) -> str:
    if body.refusal:
        raise EnvironmentFailure(body.refusal)
    return "none noticed"


def listen(
    body: BridgeRobot | None, eye: ZmqDepthCamera | RealSenseDepthCamera | None, seconds: float
) -> Heard:
    """Watch both for a while; None: not there, and not waited for."""
    heard, watch = Heard(), MotorWatch()
    if body is None and eye is None:
        return heard
    seen: DepthImage | None = None
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if body is not None and (reading := body.read()) is not None:
            heard.reading = reading
            verdict = watch.update(reading, None, standing=False)
            heard.motors = verdict.refusal
            heard.motor_events += verdict.events
        if eye is not None and (picture := eye.read()) is not seen and picture is not None:
            seen = picture
            if picture.captured_ns is not None:
                heard.image_ages_ms.append((time.monotonic_ns() - picture.captured_ns) / 1e6)
        time.sleep(0.001)
    now = time.monotonic_ns()
    if body is not None:
        heard.states = body.arrivals.stats(now, seconds)
    if eye is not None:
        heard.images = eye.arrivals.stats(now, seconds)
    return heard


def joint_offsets(position: Array) -> str:
    """Offset of each joint from the neutral pose.

    Args:
        position: (29,) rad.

    Raises:
        EnvironmentFailure: a joint is outside its range, or too far from neutral to stand up.
    """
    neutral = standing_pose(ACTION_BOX.neutral[-1]).joints
    outside = np.maximum(JOINT_LOWER - position, position - JOINT_UPPER)
    i = int(np.argmax(outside))
    if outside[i] > RANGE_MARGIN:
        raise EnvironmentFailure(
            f"{JOINT_NAMES[i]} reports {position[i]:+.2f} rad, outside its range "
            f"{JOINT_LOWER[i]:.2f} to {JOINT_UPPER[i]:.2f}; calibrate its zero in Unitree's app"
        )
    offset = position - neutral
    i = int(np.argmax(np.abs(offset)))
    if abs(offset[i]) > MOST_OFFSET:
        raise EnvironmentFailure(
            f"{JOINT_NAMES[i]} is {offset[i]:+.2f} rad from neutral, expected at most "
            f"{MOST_OFFSET:g}; move it by hand to about {neutral[i]:+.2f} rad"
        )
    named = zip(JOINT_NAMES, offset, strict=True)
    far = [
        f"{name.removesuffix('_joint')} {value:+.2f}"
        for name, value in named
        if abs(value) >= _SHOWN_OFFSET
    ]
    rest = f"{len(JOINT_NAMES) - len(far)} joints within {_SHOWN_OFFSET:g} rad of neutral"
    return f"{rest}; {', '.join(far)}" if far else rest


def posture(position: Array, quaternion_w: Array) -> str:
    """The tilt of the pelvis above feet that are flat on the ground, against the IMU's.

    Feet that hang in the air need not agree with the IMU, so a difference alone forbids nothing.

    Args:
        position: (29,) rad.
        quaternion_w: (4,) orientation of the pelvis by the IMU.

    Raises:
        EnvironmentFailure: the pelvis is far from upright.
    """
    gravity = projected_gravity(quaternion_w)
    up = -gravity
    tilt = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    if tilt > MOST_TILT:
        raise EnvironmentFailure(
            f"the IMU says that the pelvis is tilted by {tilt:.2f} rad, expected at most "
            f"{MOST_TILT:g}; hang the robot up upright"
        )
    rotation = link_transforms(position[None])[1][0, _FEET]  # (2, 3, 3)
    soles = rotation[:, :, 2]  # the feet's upward axes in the pelvis frame
    height = float(pelvis_height(position[None], gravity[None])[0])
    apart = np.arccos(np.clip(soles @ up, -1.0, 1.0))
    words = (
        f"the IMU says {tilt:.2f} rad from upright, pelvis {height:.2f} m above the lower foot; "
        f"above flat feet the pelvis would differ from "
        f"that by {apart[0]:.2f} (left) and {apart[1]:.2f} rad (right)"
    )
    if apart.max() <= POSTURE_TOLERANCE:
        return words
    return (
        f"{words}; as it should be only while the feet hang in the air. If they stand flat on the "
        "ground, calibrate the joints' zeros in Unitree's app"
    )


def motors(reading: LowState, heard: Heard) -> str:
    """The hottest motor, and which checks are off.

    Raises:
        EnvironmentFailure: a motor is too hot, or reports a fault.
    """
    if heard.motors:
        raise EnvironmentFailure(heard.motors)
    words = "" if reading.motors is None else hottest(reading.motors)
    found = f"the hottest is {words}" if words else "no temperatures are reported"
    return "; ".join([found, *heard.motor_events])


def arrivals(stats: ArrivalStats, least_hz: float, most_gap_ms: float, what: str) -> str:
    """Rate, jitter and loss of messages.

    Raises:
        EnvironmentFailure: too few, too long without one, or too many lost.
    """
    words = (
        f"{stats.rate_hz:.0f} {what} per second, jitter {stats.jitter_ms:.1f} ms (p99), longest "
        f"gap {stats.gap_ms:.0f} ms, {stats.lost:.1%} lost"
    )
    expected = ""
    if stats.rate_hz < least_hz:
        expected = f"at least {least_hz:.0f} per second"
    elif stats.gap_ms > most_gap_ms:
        expected = f"gaps of at most {most_gap_ms:.0f} ms"
    elif stats.lost > MOST_LOST:
        expected = f"at most {MOST_LOST:.0%} lost"
    if expected:
        raise EnvironmentFailure(
            f"{words}; expected {expected}: use a cable instead of wireless, and end what loads "
            "the other end or this machine"
        )
    return words


def image_age(ages_ms: list[float], most_ms: float) -> str:
    """Age of the images when they arrived.

    Args:
        ages_ms: of each; empty: the camera does not tell.
        most_ms: greatest age that policies are trained with.

    Raises:
        EnvironmentFailure: too old.
    """
    if not ages_ms:
        return "not measured: the camera does not say when an image was taken"
    median, p99 = np.percentile(ages_ms, [50, 99])
    words = f"{median:.0f} ms when they arrive, p99 {p99:.0f}; exposure and network not included"
    if median > most_ms:
        raise EnvironmentFailure(
            f"{words}; expected at most {most_ms:.0f}: policies are trained with images of at most "
            "that age. Use a cable, a smaller mode of the camera, or a faster machine at it"
        )
    return words
