"""Depth pictures: over the wire unchanged, from a great camera without inventing any depth."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.robot.geometry import pixel_rays
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS
from egovcp_deploy.robots.body import Picture
from egovcp_deploy.robots.depth_server import DepthServer
from egovcp_deploy.robots.depth_server import main as serve_depth
from egovcp_deploy.robots.depth_wire import WirePicture, decode_picture, encode_picture
from egovcp_deploy.robots.fake.running import PATIENCE_S, Running, eventually
from egovcp_deploy.robots.realsense_eye import RealSenseEye, RealSenseEyeConfig
from egovcp_deploy.robots.resample import Intrinsics, Resampler
from egovcp_deploy.robots.wire import Garbled
from egovcp_deploy.robots.zmq_eye import ZmqEye, ZmqEyeConfig

FOV = CameraConfig.vertical_fov
D435I = Intrinsics(848, 480, 425.0, 425.0, 423.5, 239.5)
SHAPE = (DEPTH_ROWS, DEPTH_COLS)


def noise(seed: int = 0) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 6000, SHAPE, dtype=np.uint16)


def test_pictures_survive_the_wire() -> None:
    picture = WirePicture(7, FOV, noise())
    back = decode_picture(encode_picture(picture))
    assert back.sequence == 7
    assert back.vertical_fov == pytest.approx(FOV)
    np.testing.assert_array_equal(back.depth, picture.depth)
    assert back.depth.dtype == np.uint16


def test_a_damaged_picture_is_garbled() -> None:
    frame = encode_picture(WirePicture(7, FOV, noise()))
    rng = np.random.default_rng(0)
    for _ in range(200):
        raw = bytearray(frame)
        place = int(rng.integers(20, len(raw)))  # the pixels, under the checksum
        raw[place] ^= 1 << int(rng.integers(8))
        with pytest.raises(Garbled):
            decode_picture(bytes(raw))
    for broken in (b"", frame[:-1], frame + b"x", b"JPEG" + frame[4:], b"\xff" * len(frame)):
        with pytest.raises(Garbled):
            decode_picture(broken)


@pytest.fixture
def eye(running: Running) -> Iterator[ZmqEye]:
    found = ZmqEye(ZmqEyeConfig(port=running.fake.ports.camera_port))
    found.connect(PATIENCE_S)
    yield found
    found.close()


def test_an_eye_sees_what_the_robot_sees(eye: ZmqEye, running: Running) -> None:
    first = eye.read()
    assert first is not None
    assert eventually(lambda: eye.read() is not first)
    second = eye.read()
    assert second is not None
    assert first.time_ns < second.time_ns <= time.monotonic_ns()
    running.stop()
    seen = running.fake.robot.depth_image[1]
    assert eventually(lambda: bool((eye.read().depth == seen).all()))


def test_the_same_picture_again_is_not_news(eye: ZmqEye, running: Running) -> None:
    running.fake.faults.freeze_camera = True
    assert eventually(lambda: eye.repeated > 1)
    last = eye.read()
    seen = eye.repeated
    assert eventually(lambda: eye.repeated > seen + 1)
    assert eye.read() is last


def test_another_field_of_view_is_refused(running: Running) -> None:
    config = ZmqEyeConfig(port=running.fake.ports.camera_port, vertical_fov=math.radians(45))
    with pytest.raises(EnvironmentFailure, match=r"58\.0 deg, expected 45\.0"):
        ZmqEye(config).connect(1.0)


def test_no_server_is_a_clear_failure(running: Running) -> None:
    running.fake.faults.mute_camera = True
    with pytest.raises(EnvironmentFailure, match="something listens"):
        ZmqEye(ZmqEyeConfig(port=running.fake.ports.camera_port)).connect(0.1)
    running.stop()
    running.fake.close()
    with pytest.raises(EnvironmentFailure, match="egovcp-depth-server"):
        ZmqEye(ZmqEyeConfig(port=running.fake.ports.camera_port)).connect(0.1)
    with pytest.raises(UsageError):
        ZmqEyeConfig(port=0)


def picture_of(camera: Intrinsics, normal: NDArray[np.float64], offset: float) -> np.ndarray:
    """Depth, mm, of the plane normal . (right, down, forward) = offset, m."""
    down, right = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = np.stack([(right - camera.cx) / camera.fx, (down - camera.cy) / camera.fy, 1 + 0 * down])
    return np.rint(1000 * offset / np.einsum("i,ihw->hw", normal, rays)).astype(np.uint16)


@pytest.mark.parametrize("camera", [D435I, Intrinsics(1280, 720, 640.0, 636.0, 651.0, 355.0)])
def test_a_plane_looks_as_in_the_simulated_camera(camera: Intrinsics) -> None:
    normal, offset = np.array([0.2, 0.3, 0.93]), 2.0
    small = Resampler(camera, FOV)(picture_of(camera, normal, offset)[..., None])
    forward, left, up = pixel_rays(DEPTH_ROWS / 2 / math.tan(FOV / 2)).T
    expected = 1000 * offset / (normal @ np.stack([-left, -up, forward]))
    np.testing.assert_allclose(small.ravel(), expected, atol=8)  # half a pixel aside is 3 mm


def test_every_depth_was_measured_and_holes_stay_holes() -> None:
    rng = np.random.default_rng(0)
    great = rng.choice(np.array([900, 4000], np.uint16), (480, 848))
    great[rng.random(great.shape) < 0.4] = 0
    small = Resampler(D435I, FOV)(great)
    assert set(np.unique(small)) == {0, 900, 4000}
    great[:240] = 0
    halved = Resampler(D435I, FOV)(great)
    assert not halved[: DEPTH_ROWS // 2 - 1].any()
    np.testing.assert_array_equal(halved[DEPTH_ROWS // 2 + 1 :], small[DEPTH_ROWS // 2 + 1 :])


@pytest.mark.parametrize(("found", "kept"), [(279, 0), (280, 280), (5000, 5000), (5001, 0)])
def test_depth_is_clipped_to_the_range(found: int, kept: int) -> None:
    small = Resampler(D435I, FOV)(np.full((480, 848), found, np.uint16))
    assert np.unique(small).tolist() == [kept]


def test_what_the_camera_does_not_see_is_a_hole() -> None:
    narrow = Intrinsics(848, 480, 700.0, 700.0, 423.5, 239.5)
    resample = Resampler(narrow, FOV)
    small = resample(np.full((480, 848), 1000, np.uint16))
    assert small[24, 32] == 1000
    assert not small[0].any()
    assert resample.coverage == pytest.approx((small > 0).mean(), abs=0.05)


def test_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="expected"):
        Resampler(D435I, FOV)(np.zeros((480, 640), np.uint16))


class FakeRealSense:
    """Behaves as LeRobot's camera: a new array per picture, errors before the first."""

    def __init__(self) -> None:
        self.latest_timestamp: float | None = None
        self.failure: Exception | None = RuntimeError("has not captured any frames yet")
        self.connected = True
        self._latest = np.zeros((480, 848, 1), np.uint16)

    def capture(self, depth: int) -> None:
        self._latest = np.full((480, 848, 1), depth, np.uint16)
        self.latest_timestamp = time.perf_counter()
        self.failure = None

    def read_latest_depth(self, max_age_ms: int = 500) -> NDArray[np.uint16]:
        if self.failure is not None:
            raise self.failure
        return self._latest

    def disconnect(self) -> None:
        assert self.connected
        self.connected = False


@pytest.fixture
def camera() -> FakeRealSense:
    return FakeRealSense()


def test_a_realsense_is_an_eye(camera: FakeRealSense) -> None:
    eye = RealSenseEye(camera, D435I, FOV)
    assert eye.read() is None
    camera.capture(1500)
    first = eye.read()
    assert first is not None
    assert np.unique(first.depth).tolist() == [1500]
    assert eye.read() is first, "the same picture again is not news"
    time.sleep(0.02)
    camera.capture(1600)
    time.sleep(0.05)
    second = eye.read()
    assert second is not None
    assert np.unique(second.depth).tolist() == [1600]
    assert second.time_ns - first.time_ns >= 20_000_000
    assert time.monotonic_ns() - second.time_ns >= 50_000_000, "stamped when it was taken"


@pytest.mark.parametrize(
    "failure", [TimeoutError("too old"), RuntimeError("thread died"), ConnectionError("unplugged")]
)
def test_a_camera_that_fails_keeps_its_last_picture(
    camera: FakeRealSense, failure: Exception
) -> None:
    eye = RealSenseEye(camera, D435I, FOV)
    camera.capture(1500)
    last = eye.read()
    camera.failure = failure
    assert eye.read() is last
    assert eye.problem == str(failure)
    eye.close()
    eye.close()
    assert not camera.connected
    assert eye.read() is last


def test_a_narrow_camera_is_refused(camera: FakeRealSense) -> None:
    narrow = Intrinsics(848, 480, 700.0, 700.0, 423.5, 239.5)
    with pytest.raises(EnvironmentFailure, match="wider mode"):
        RealSenseEye(camera, narrow, FOV)


@pytest.mark.skipif(find_spec("pyrealsense2") is not None, reason="the driver is installed")
def test_a_missing_driver_says_what_to_install() -> None:
    with pytest.raises(EnvironmentFailure, match=r"pyrealsense2.*egovcp-deploy\[realsense\]"):
        RealSenseEye.connect(RealSenseEyeConfig(serial="0123"))
    with pytest.raises(EnvironmentFailure, match="lerobot-find-cameras"):
        RealSenseEye.connect(RealSenseEyeConfig())


class Slides:
    """An eye that sees what it is shown."""

    def __init__(self) -> None:
        self.picture: Picture | None = None

    def read(self) -> Picture | None:
        return self.picture

    def close(self) -> None:
        pass


def test_a_camera_can_be_served_to_another_machine() -> None:
    slides = Slides()
    server = DepthServer(slides, FOV, "127.0.0.1", 0)
    eye = ZmqEye(ZmqEyeConfig(port=server.port))
    waiting = threading.Thread(target=eye.connect, args=(PATIENCE_S,))
    waiting.start()
    count = iter(range(10_000))

    def show() -> bool:
        slides.picture = Picture(0, noise(next(count)))
        server.step()
        server.step()
        return eye.pictures > 2

    assert eventually(show)
    waiting.join()
    assert eye.repeated == 0, "each picture is sent once"
    assert eventually(lambda: bool((eye.read().depth == slides.picture.depth).all()))
    with pytest.raises(EnvironmentFailure, match="choose another"):
        DepthServer(slides, FOV, "127.0.0.1", server.port)
    eye.close()
    server.close()


def test_the_server_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert serve_depth([]) == 5
    assert "lerobot-find-cameras" in capsys.readouterr().err
