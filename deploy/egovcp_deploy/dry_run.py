"""`egovcp-deploy --dry_run=true`: checks everything a run needs, and prints go or no-go for each.

Each check returns its finding, or raises `EnvironmentFailure` if no run is possible. Limits defined
in this file have not been verified on hardware.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from egovcp.artifact import Artifact
from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.files import user_path
from egovcp.outputs import nearest_existing, require_writable
from egovcp.plan import blank_observation, time_left_until
from egovcp.policy_options import load_policy
from egovcp.robot.controllers import make_controller
from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER
from egovcp.robot.stance_table import standing_pose
from egovcp.spec import ACTION_BOX, JOINT_NAMES
from egovcp.terminal import echo
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.control_process import CONTROL_PRIORITY, NO_PRIORITY, raise_priority
from egovcp_deploy.live.hardware import AnyCamera, open_camera
from egovcp_deploy.pilot.motor_watch import MotorWatch, hottest
from egovcp_deploy.pilot.pilot import posture
from egovcp_deploy.pilot.planner import BUDGET_S, RolloutPolicy, backend_of, leave_core
from egovcp_deploy.robots.base import Array, DepthImage, LowState, proprioception
from egovcp_deploy.robots.bridge import BridgeRobot
from egovcp_deploy.robots.subscriber import ArrivalStats

FREE_BYTES: Final = 1_000_000_000  # an hour of recording takes about 0.6 GB
PLAN_BUDGET_MS: Final = 36.0
_PLANS: Final = 50
_WARM_UP: Final = 5
_PLANNING_S: Final = 5.0  # fewer plans are timed on a slow machine
LISTEN_S: Final = 5.0
MAX_LOST: Final = 0.05  # share of the messages
STATE_HZ: Final = 100.0
IMAGE_HZ: Final = 15.0
MAX_OFFSET: Final = 1.5  # rad from neutral; the stand-up motion takes 3 s at 0.5 rad/s
RANGE_MARGIN: Final = 0.1  # rad beyond the joint range; more is a wrong zero
MAX_TILT: Final = 0.35  # rad between pelvis and vertical; the runner damps at 1.0


def dry_run(config: DeployConfig) -> None:
    """Perform all checks of a run on a robot, also after one has failed; print each result, then
    go. A missing real-time priority and an unusual mode are only warnings. Raises the first error,
    if any."""
    errors: list[EgovcpError] = []

    def perform[T](
        name: str, check: Callable[[], T], describe: Callable[[T], str] = str
    ) -> T | None:
        try:
            found = check()
            echo(f"go     {name}: {describe(found)}")
        except EgovcpError as error:
            echo(f"NO-GO  {name}: {error}")
            errors.append(error)
            return None
        return found

    robot_options, limits = config.robot, config.robot.limits
    with ThreadPoolExecutor(1) as pool:  # only its thread gets the priority
        granted = pool.submit(raise_priority, CONTROL_PRIORITY).result()
    echo("go     priority: real-time" if granted else f"warn   priority: {NO_PRIORITY}")
    perform("disk", lambda: check_disk(user_path(config.output_dir)))
    artifact = perform(
        "policy",
        lambda: load_policy(config.policy, config.planner),
        lambda found: f"{found.path}, for the controller {found.controller_id}",
    )
    leave_core()
    if artifact is not None:
        perform("planner", lambda: check_plan_time(artifact.make_policy(1, config.seed)))
    perform("controller", lambda: check_controller(robot_options.controller, artifact))
    with ExitStack() as stack:
        robot = perform(
            "robot",
            lambda: stack.enter_context(closing(BridgeRobot(robot_options.bridge).connect())),
            lambda found: f"answers at {found.config.host}",
        )
        camera = perform(
            "camera",
            lambda: stack.enter_context(closing(open_camera(robot_options.camera))),
            lambda found: "answers",
        )
        measured = measure(robot, camera, LISTEN_S)
        now = time.monotonic_ns()
        if robot is not None and (reading := measured.reading) is not None:
            states = robot.arrivals.stats(now, LISTEN_S)
            if robot.warning:
                echo(f"warn   mode: {robot.warning}")
            else:
                echo(f"go     mode: mode machine {reading.mode}: 29 joints, waist free")
            perform("joints", lambda: check_joint_positions(reading.joint_position))
            perform("posture", lambda: check_posture(reading))
            perform("motors", lambda: check_motors(measured))
            gap_ms = limits.state_hold_s * 1e3
            perform("states", lambda: check_message_rate(states, STATE_HZ, gap_ms))
            perform("arming", lambda: check_arming(robot.refusal))
        if camera is not None:
            images, image_gap_ms = camera.arrivals.stats(now, LISTEN_S), limits.image_hold_s * 1e3
            perform("images", lambda: check_message_rate(images, IMAGE_HZ, image_gap_ms))
            max_ms = config.env.delay.image_age[1] * 1e3
            perform("image age", lambda: image_age(measured.image_ages_ms, max_ms))
    if errors:
        echo(f"no-go: {len(errors)} checks failed")
        raise errors[0]
    echo("go")


def require_no_problem(problem: str) -> None:
    """Raise `EnvironmentFailure` unless the text is empty."""
    if problem:
        raise EnvironmentFailure(problem)


def check_arming(refusal: str) -> str:
    """Whether the robot can be armed: no other program commands it, and its mode is the same."""
    require_no_problem(refusal)
    return "no other publisher, same mode"


# --- this machine and the policy -------------------------------------------------------------
def check_disk(folder: Path) -> str:
    """Free space; raises `EnvironmentFailure` if it is too small, or not writable."""
    require_writable(folder)
    existing = nearest_existing(folder)
    free = shutil.disk_usage(existing).free
    if free < FREE_BYTES:
        raise EnvironmentFailure(
            f"{free / 1e9:.1f} GB free at {existing}, expected {FREE_BYTES / 1e9:.0f} GB; "
            "free disk space, or choose another --output_dir"
        )
    return f"{free / 1e9:.0f} GB free"


def check_controller(name: str, artifact: Artifact | None) -> str:
    """Identity of the low-level controller ``name``, which must be that of the policy, if any."""
    found = make_controller(name).id
    if artifact is not None:
        artifact.require_controller(found)
    return found


def check_plan_time(policy: RolloutPolicy) -> str:
    """Planning time on blank observations."""
    depth, state = blank_observation(1)
    policy.reset()
    times, iterations = list[float](), list[int]()
    end = time.monotonic() + _PLANNING_S
    while len(times) < _WARM_UP + _PLANS and (time.monotonic() < end or len(times) <= _WARM_UP):
        begin = time.perf_counter()
        step = policy.act(depth, state, time_left_until(begin + BUDGET_S))
        times.append((time.perf_counter() - begin) * 1e3)
        iterations.append(step.iterations)
    policy.reset()
    p50, p99 = np.percentile(times[_WARM_UP:], [50, 99])
    backend = backend_of(policy)
    if p99 > PLAN_BUDGET_MS:
        raise EnvironmentFailure(
            f"planning takes {p50:.0f} ms (p99 {p99:.0f}) on the backend {backend}, expected at "
            f"most {PLAN_BUDGET_MS:.0f} at 25 Hz; close other programs, or use fewer "
            "--planner.samples"
        )
    mean = np.mean(iterations[_WARM_UP:])
    return f"{p50:.1f} ms per plan, p99 {p99:.1f}, {mean:.1f} iterations, computed by {backend}"


# --- robot and camera ------------------------------------------------------------------------
@dataclass
class Measurements:
    """Messages received within `LISTEN_S`."""

    reading: LowState | None = None  # the newest
    refusal: str = ""  # reason why arming is refused
    motor_events: list[str] = field(default_factory=list)
    image_ages_ms: list[float] = field(default_factory=list)  # at their arrival


def measure(robot: BridgeRobot | None, camera: AnyCamera | None, seconds: float) -> Measurements:
    """Receive from both for ``seconds``; None: not connected."""
    measured, watch = Measurements(), MotorWatch()
    newest: DepthImage | None = None
    end = time.monotonic() + seconds
    while time.monotonic() < end and (robot is not None or camera is not None):
        if robot is not None and (reading := robot.read()) is not None:
            measured.reading = reading
            verdict = watch.update(reading, None, standing=False)
            measured.refusal = verdict.arming_refusal
            measured.motor_events += verdict.events
        if camera is not None and (image := camera.read()) is not newest and image is not None:
            newest = image
            if image.captured_ns is not None:
                age_ms = (time.monotonic_ns() - image.captured_ns) / 1e6
                measured.image_ages_ms.append(age_ms)
        time.sleep(0.001)
    return measured


def check_joint_positions(position: Array) -> str:
    """Largest offset of the joints (29,) rad from the neutral pose; too far from it to stand up, or
    outside the joint's range, is a no-go."""
    outside = np.maximum(JOINT_LOWER - position, position - JOINT_UPPER)
    i = int(np.argmax(outside))
    if outside[i] > RANGE_MARGIN:
        raise EnvironmentFailure(
            f"{JOINT_NAMES[i]} reports {position[i]:+.2f} rad, outside its range "
            f"{JOINT_LOWER[i]:.2f} to {JOINT_UPPER[i]:.2f}; calibrate its zero in Unitree's app"
        )
    neutral = standing_pose(ACTION_BOX.neutral[-1]).joints
    i = int(np.argmax(np.abs(position - neutral)))
    finding = f"{JOINT_NAMES[i]} is {position[i] - neutral[i]:+.2f} rad from neutral"
    if abs(position[i] - neutral[i]) > MAX_OFFSET:
        raise EnvironmentFailure(
            f"{finding}, expected at most {MAX_OFFSET:g}; move it by hand to about "
            f"{neutral[i]:+.2f} rad"
        )
    return f"largest offset: {finding}"


def check_posture(reading: LowState) -> str:
    """Tilt of the pelvis by the IMU, and its height above the lower foot; a large tilt is a
    no-go."""
    tilt, height = posture(proprioception(reading, np.zeros(10)))
    if tilt > MAX_TILT:
        raise EnvironmentFailure(
            f"according to the IMU the pelvis is tilted by {tilt:.2f} rad, expected at most "
            f"{MAX_TILT:g}; hang the robot up upright"
        )
    return f"IMU {tilt:.2f} rad from upright, pelvis {height:.2f} m above the lower foot"


def check_motors(measured: Measurements) -> str:
    """The hottest motor, and the checks that are off."""
    require_no_problem(measured.refusal)
    readings = None if measured.reading is None else measured.reading.motors
    joint = "" if readings is None else hottest(readings)
    finding = f"the hottest is {joint}" if joint else "no temperatures are reported"
    return "; ".join([finding, *measured.motor_events])


def check_message_rate(stats: ArrivalStats, min_hz: float, max_gap_ms: float) -> str:
    """Rate, jitter, gaps and loss of messages."""
    finding = (
        f"{stats.rate_hz:.0f} per second, jitter {stats.jitter_ms:.1f} ms (p99), longest "
        f"gap {stats.gap_ms:.0f} ms, {stats.lost:.1%} lost"
    )
    expected = ""
    if stats.rate_hz < min_hz:
        expected = f"at least {min_hz:.0f} per second"
    elif stats.gap_ms > max_gap_ms:
        expected = f"gaps of at most {max_gap_ms:.0f} ms"
    elif stats.lost > MAX_LOST:
        expected = f"at most {MAX_LOST:.0%} lost"
    if expected:
        raise EnvironmentFailure(
            f"{finding}; expected {expected}: use a cable instead of wireless, and reduce the load "
            "of both machines"
        )
    return finding


def image_age(ages_ms: list[float], max_ms: float) -> str:
    """Age of the images at their arrival; empty: not reported by the camera. ``max_ms`` is the
    largest configured age, which should be that of the training data."""
    if not ages_ms:
        return "not measured: the camera does not report when an image was taken"
    median, p99 = np.percentile(ages_ms, [50, 99])
    finding = f"{median:.0f} ms when they arrive, p99 {p99:.0f}; exposure and network not included"
    if median > max_ms:
        raise EnvironmentFailure(
            f"{finding}; expected at most {max_ms:.0f}, the largest --env.delay.image_age (set it "
            "to that of the training data): use a cable, a smaller camera mode, or a faster "
            "machine at the camera"
        )
    return finding
