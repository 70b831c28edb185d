"""The simulator on the wall clock, behind the same wire as a robot, for as long as a run lasts."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Final

from egovcp.errors import EnvironmentFailure
from egovcp.parent_death import die_with_parent
from egovcp.workers import inherited_by_workers
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live.hardware import CameraOptions, HardwareOptions
from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig

if TYPE_CHECKING:
    from egovcp_deploy.robots.fake.command import FakeG1Config

_START_S: Final = 60.0
_FOR_EVER_S: Final = 1e9


@contextmanager
def simulated(config: DeployConfig, outcomes: Path) -> Iterator[HardwareOptions]:
    """Where the simulated robot listens: on the loopback, on ports that were free.

    Args:
        config: task, seed and scenes.
        outcomes: file for what came of the episode.

    Raises:
        EnvironmentFailure: the simulator is not installed, or does not come up.
    """
    from egovcp_deploy.robots.fake.bridge import Ports
    from egovcp_deploy.robots.fake.command import FakeG1Config

    fake = FakeG1Config(
        task=config.task,
        seed=config.seed,
        pause=_FOR_EVER_S,  # one episode; the robot stays where it is
        ports=Ports(command_port=0, state_port=0, camera_port=0),
        json=str(outcomes),
        env=config.env,
    )
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(fake, theirs, os.getpid()), daemon=True)
    with inherited_by_workers():
        process.start()
    theirs.close()
    try:
        yield _options(config, _ports(ours))
    finally:
        process.terminate()
        process.join()


def _serve(fake: FakeG1Config, pipe: Connection, parent: int) -> None:
    """Runs in the simulator's process."""
    import signal

    from egovcp_deploy.robots.fake.command import run

    die_with_parent(parent)  # nobody else would end it
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the planner's process to judge
    run(fake, lambda ports: pipe.send((ports.command_port, ports.state_port, ports.camera_port)))


def _ports(pipe: Connection) -> tuple[int, int, int]:
    try:
        if pipe.poll(_START_S):
            command, state, camera = pipe.recv()
            return command, state, camera
    except EOFError:
        pass
    raise EnvironmentFailure("the simulator did not come up; its own message is above")


def _options(config: DeployConfig, ports: tuple[int, int, int]) -> HardwareOptions:
    command, state, camera = ports
    eye = ZmqCameraConfig(port=camera, vertical_fov=config.env.camera.vertical_fov)
    return HardwareOptions(
        BridgeConfig(state_port=state, command_port=command),
        replace(CameraOptions(), server=eye),
    )
