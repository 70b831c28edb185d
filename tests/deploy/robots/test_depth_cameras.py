"""Depth images: unchanged over ZMQ, and resampled from a camera without inventing depths."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.robot.geometry import pixel_rays
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS
from egovcp_deploy.robots import depth_server
from egovcp_deploy.robots.base import DepthImage
from egovcp_deploy.robots.depth_server import DepthServer
from egovcp_deploy.robots.depth_server import main as serve_depth
from egovcp_deploy.robots.realsense_camera import (
    DepthResampler,
    RealSenseConfig,
    RealSenseDepthCamera,
    require_millimetres,
)
from egovcp_deploy.robots.wire import MalformedMessage
from egovcp_deploy.robots.zmq_camera import (
    DepthFrame,
    ZmqCameraConfig,
    ZmqDepthCamera,
    decode_frame,
    encode_frame,
)
from tests.support.lockstep import LockstepClock
from tests.support.robots.fake_g1 import TIMEOUT_S, FakeG1Thread, eventually

FOV = CameraConfig.vertical_fov


class Intrinsics(NamedTuple):
    """As ``pyrealsense2.intrinsics``."""

    width: int
    height: int
    fx: float
    fy: float
    ppx: float
    ppy: float


D435I = Intrinsics(848, 480, 425.0, 425.0, 423.5, 239.5)
SHAPE = (DEPTH_ROWS, DEPTH_COLS)


def noise(seed: int = 0) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 6000, SHAPE, dtype=np.uint16)


def test_frame_round_trip() -> None:
    image = DepthFrame(7, FOV, noise())
    back = decode_frame(encode_frame(image))
    assert back.sequence == 7
    assert back.vertical_fov == pytest.approx(FOV)
    np.testing.assert_array_equal(back.depth, image.depth)
    assert back.depth.dtype == np.uint16


def test_a_damaged_frame_is_malformed() -> None:
    frame = encode_frame(DepthFrame(7, FOV, noise()))
    rng = np.random.default_rng(0)
    for _ in range(200):
        raw = bytearray(frame)
        place = int(rng.integers(20, len(raw)))  # the pixels, under the checksum
        raw[place] ^= 1 << int(rng.integers(8))
        with pytest.raises(MalformedMessage):
            decode_frame(bytes(raw))
    for broken in (b"", frame[:-1], frame + b"x", b"JPEG" + frame[4:], b"\xff" * len(frame)):
        with pytest.raises(MalformedMessage):
            decode_frame(broken)


@pytest.fixture
def camera(running: FakeG1Thread) -> Iterator[ZmqDepthCamera]:
    found = ZmqDepthCamera(ZmqCameraConfig(port=running.fake.ports.camera_port))
    found.connect(TIMEOUT_S)
    yield found
    found.close()


def test_received_images_are_those_of_the_robot(
    camera: ZmqDepthCamera, running: FakeG1Thread
) -> None:
    first = camera.read()
    assert first is not None
    assert eventually(lambda: camera.read() is not first)
    second = camera.read()
    assert second is not None
    assert first.time_ns < second.time_ns <= time.monotonic_ns()
    running.stop()
    seen = running.fake.robot.depth_image[1]
    assert eventually(lambda: bool((camera.read().depth == seen).all()))


def test_a_repeated_image_is_ignored() -> None:
    camera, message = ZmqDepthCamera(), encode_frame(DepthFrame(7, FOV, noise()))
    assert camera._handle(message, 1, 0)
    first = camera.read()
    assert not camera._handle(message, 2, 0)
    assert camera.read() is first


def test_another_field_of_view_is_refused(running: FakeG1Thread) -> None:
    config = ZmqCameraConfig(port=running.fake.ports.camera_port, vertical_fov=math.radians(45))
    with pytest.raises(EnvironmentFailure, match=r"58\.0 deg, expected 45\.0"):
        ZmqDepthCamera(config).connect(1.0)


def test_connect_reports_a_missing_server(running: FakeG1Thread) -> None:
    running.fake.faults.stop_camera = True
    with pytest.raises(EnvironmentFailure, match="something listens"):
        ZmqDepthCamera(ZmqCameraConfig(port=running.fake.ports.camera_port)).connect(0.1)
    running.stop()
    running.fake.close()
    with pytest.raises(EnvironmentFailure, match="egovcp-depth-server"):
        ZmqDepthCamera(ZmqCameraConfig(port=running.fake.ports.camera_port)).connect(0.1)
    with pytest.raises(UsageError):
        ZmqCameraConfig(port=0)


def image_of(camera: Intrinsics, normal: NDArray[np.float64], offset: float) -> np.ndarray:
    """Depth, mm, of the plane normal . (right, down, forward) = offset, m."""
    down, right = np.mgrid[: camera.height, : camera.width].astype(float)
    rows, columns = (down - camera.ppy) / camera.fy, (right - camera.ppx) / camera.fx
    rays = np.stack([columns, rows, 1 + 0 * down])
    return np.rint(1000 * offset / np.einsum("i,ihw->hw", normal, rays)).astype(np.uint16)


@pytest.mark.parametrize("camera", [D435I, Intrinsics(1280, 720, 640.0, 636.0, 651.0, 355.0)])
def test_resampled_plane_matches_the_simulated_camera(camera: Intrinsics) -> None:
    normal, offset = np.array([0.2, 0.3, 0.93]), 2.0
    resampled = DepthResampler(camera, FOV)(image_of(camera, normal, offset)[..., None])
    forward, left, up = pixel_rays(DEPTH_ROWS / 2 / math.tan(FOV / 2)).T
    expected = 1000 * offset / (normal @ np.stack([-left, -up, forward]))
    np.testing.assert_allclose(resampled.ravel(), expected, atol=8)  # half a pixel aside is 3 mm


def test_resampling_keeps_measured_depths_and_holes() -> None:
    rng = np.random.default_rng(0)
    full = rng.choice(np.array([900, 4000], np.uint16), (480, 848))
    full[rng.random(full.shape) < 0.4] = 0
    resampled = DepthResampler(D435I, FOV)(full)
    assert set(np.unique(resampled)) == {0, 900, 4000}
    full[:240] = 0
    halved = DepthResampler(D435I, FOV)(full)
    assert not halved[: DEPTH_ROWS // 2 - 1].any()
    np.testing.assert_array_equal(halved[DEPTH_ROWS // 2 + 1 :], resampled[DEPTH_ROWS // 2 + 1 :])


@pytest.mark.parametrize(("found", "kept"), [(279, 0), (280, 280), (5000, 5000), (5001, 0)])
def test_depth_is_clipped_to_the_range(found: int, kept: int) -> None:
    resampled = DepthResampler(D435I, FOV)(np.full((480, 848), found, np.uint16))
    assert np.unique(resampled).tolist() == [kept]


def test_pixels_outside_the_camera_are_invalid() -> None:
    narrow = Intrinsics(848, 480, 700.0, 700.0, 423.5, 239.5)
    resample = DepthResampler(narrow, FOV)
    resampled = resample(np.full((480, 848), 1000, np.uint16))
    assert resampled[24, 32] == 1000
    assert not resampled[0].any()
    assert resample.coverage == pytest.approx((resampled > 0).mean(), abs=0.05)


def test_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="expected"):
        DepthResampler(D435I, FOV)(np.zeros((480, 640), np.uint16))


class FakeRealSense:
    """Behaves as LeRobot's camera: a new array per image, errors before the first."""

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
def driver() -> FakeRealSense:
    return FakeRealSense()


def test_realsense_images_are_resampled_and_stamped(driver: FakeRealSense) -> None:
    camera = RealSenseDepthCamera(driver, D435I, FOV)
    assert camera.read() is None
    driver.capture(1500)
    first = camera.read()
    assert first is not None
    assert np.unique(first.depth).tolist() == [1500]
    assert camera.read() is first, "the same image again is not new"
    time.sleep(0.02)
    driver.capture(1600)
    time.sleep(0.05)
    second = camera.read()
    assert second is not None
    assert np.unique(second.depth).tolist() == [1600]
    assert second.time_ns - first.time_ns >= 20_000_000
    assert time.monotonic_ns() - second.time_ns >= 50_000_000, "stamped when it was taken"


@pytest.mark.parametrize(
    "failure", [TimeoutError("too old"), RuntimeError("thread died"), ConnectionError("unplugged")]
)
def test_a_failed_camera_keeps_its_last_image(driver: FakeRealSense, failure: Exception) -> None:
    camera = RealSenseDepthCamera(driver, D435I, FOV)
    driver.capture(1500)
    last = camera.read()
    driver.failure = failure
    assert camera.read() is last
    camera.close()
    camera.close()
    assert not driver.connected
    assert camera.read() is last


def test_a_narrow_camera_is_refused(driver: FakeRealSense) -> None:
    narrow = Intrinsics(848, 480, 700.0, 700.0, 423.5, 239.5)
    with pytest.raises(EnvironmentFailure, match="wider mode"):
        RealSenseDepthCamera(driver, narrow, FOV)


def test_a_camera_whose_depth_is_not_in_millimetres_is_refused() -> None:
    def profile(scale: float) -> SimpleNamespace:
        sensor = SimpleNamespace(get_depth_scale=lambda: scale)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor)
        return SimpleNamespace(get_device=lambda: device)

    require_millimetres(profile(0.0010000000474974513))
    with pytest.raises(EnvironmentFailure, match=r"units of 0\.1 mm, expected 1 mm"):
        require_millimetres(profile(1e-4))


@pytest.mark.skipif(find_spec("pyrealsense2") is not None, reason="the driver is installed")
def test_a_missing_driver_names_the_extra_to_install() -> None:
    with pytest.raises(EnvironmentFailure, match=r"pyrealsense2.*egovcp-deploy\[realsense\]"):
        RealSenseDepthCamera.connect(RealSenseConfig(serial="0123"))


class FakeDepthCamera:
    """A depth camera whose image the test sets."""

    def __init__(self) -> None:
        self.image: DepthImage | None = None

    def read(self) -> DepthImage | None:
        return self.image

    def close(self) -> None:
        pass


def test_an_image_that_arrives_together_with_a_newer_one_is_not_lost() -> None:
    camera = ZmqDepthCamera()
    for sequence, older in ((1, 0), (2, 0), (4, 1)):
        message = encode_frame(DepthFrame(sequence, FOV, noise(sequence)))
        assert camera._handle(message, sequence, older)
    assert camera.arrivals.stats(5).lost == 0.0
    assert camera._handle(encode_frame(DepthFrame(6, FOV, noise())), 6, 0)
    assert camera.arrivals.stats(6).lost == 1 / 5


def test_depth_server_publishes_each_image_once() -> None:
    shown = FakeDepthCamera()
    server = DepthServer(shown, FOV, "127.0.0.1", 0)
    camera = ZmqDepthCamera(ZmqCameraConfig(port=server.port))
    handle, new = camera._handle, list[bool]()  # whether each message has a new image

    def record(message: bytes, time_ns: int, older: int) -> bool:
        new.append(handle(message, time_ns, older))
        return new[-1]

    camera._handle = record  # type: ignore[method-assign]
    waiting = threading.Thread(target=camera.connect, args=(TIMEOUT_S,))
    waiting.start()
    count = iter(range(10_000))

    def show() -> bool:
        shown.image = DepthImage(0, noise(next(count)))
        server.step()
        server.step()
        return len(new) > 2

    assert eventually(show)
    waiting.join()
    assert all(new), "each image is sent once"
    assert eventually(lambda: bool((camera.read().depth == shown.image.depth).all()))
    with pytest.raises(EnvironmentFailure, match="choose another"):
        DepthServer(shown, FOV, "127.0.0.1", server.port)
    camera.close()
    server.close()


def test_depth_server_warns_of_a_silent_camera_and_then_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock, shown = LockstepClock(), FakeDepthCamera()
    monkeypatch.setattr(depth_server, "time", SimpleNamespace(monotonic_ns=clock.now_ns))
    with closing(DepthServer(shown, FOV, "127.0.0.1", 0)) as server:
        clock.advance(900_000_000)
        shown.image = DepthImage(0, noise(0))
        server.step()
        for _ in range(49):
            clock.advance(100_000_000)
            server.step()
        assert capsys.readouterr().err.count("no new image of the camera") == 4
        clock.advance(100_000_000)
        with pytest.raises(EnvironmentFailure, match="no new image of the camera for 5 s"):
            server.step()


def test_depth_server_reports_a_missing_serial_number(capsys: pytest.CaptureFixture[str]) -> None:
    assert serve_depth([]) == 2
    assert "egovcp-depth-server --camera.serial" in capsys.readouterr().err
