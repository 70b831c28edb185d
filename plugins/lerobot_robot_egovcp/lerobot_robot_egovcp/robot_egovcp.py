"""The robot as LeRobot's recording, replaying and teleoperating tools see it."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from egovcp import spec
from egovcp.errors import UsageError
from egovcp_deploy.live.puppet import Puppet
from lerobot_robot_egovcp.configuration_egovcp import EgovcpG1Config

_DEPTH = spec.DEPTH_KEY.removeprefix("observation.images.")


class EgovcpG1(Robot):  # type: ignore[misc]
    """Takes the seven numbers of an egovcp action at 25 Hz and shows what its datasets hold.

    The robot balances, holds when actions stop coming, and is damped when it falls, whatever
    LeRobot does. Untested on hardware.
    """

    config_class = EgovcpG1Config
    name = "egovcp_g1"

    def __init__(self, config: EgovcpG1Config) -> None:
        super().__init__(config)
        self.config = config
        self._puppet: Puppet | None = None

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Proprioception by name, and the depth picture."""
        picture = (spec.DEPTH_ROWS, spec.DEPTH_COLS, 1)
        return {**dict.fromkeys(spec.STATE_NAMES, float), _DEPTH: picture}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Hands and height, box units."""
        return dict.fromkeys(spec.ACTION_NAMES, float)

    @property
    def cameras(self) -> dict[str, Any]:
        """None that LeRobot would have to run: the picture comes with the observation."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the robot runs."""
        return self._puppet is not None

    @property
    def is_calibrated(self) -> bool:
        """Always: the robot knows its joints."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Stand up and run; see `Puppet.connect` for what can go wrong."""
        if self._puppet is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        setup = self.config.setup
        puppet = Puppet.by_itself(setup) if self.config.by_itself else Puppet(setup)
        puppet.connect()
        self._puppet = puppet

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_observation(self) -> dict[str, Any]:
        """The next observation: `spec.STATE_NAMES`, and ``ego_depth`` (48, 64, 1) uint16 mm."""
        report = self._running.observe()
        state = dict(zip(spec.STATE_NAMES, report.state.tolist(), strict=True))
        return {**state, _DEPTH: report.depth[..., None].copy()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send `spec.ACTION_NAMES`, each in [-1, 1]; what the robot takes, rate limited.

        Raises:
            UsageError: one is missing, or no number.
        """
        missing = [name for name in spec.ACTION_NAMES if name not in action]
        if missing:
            raise UsageError(f"the action lacks {missing[0]}; expected {spec.ACTION_NAMES}")
        wanted = np.array([float(action[name]) for name in spec.ACTION_NAMES])
        taken = self._running.send(wanted)
        return dict(zip(spec.ACTION_NAMES, taken.tolist(), strict=True))

    def disconnect(self) -> None:
        """Hold, then damp: hang the robot up first."""
        puppet, self._puppet = self._running, None
        puppet.close()

    @property
    def _running(self) -> Puppet:
        if self._puppet is None:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect()")
        return self._puppet
