"""What LeRobot adds to the observations of the simulation before a policy sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import InfoProcessorStep

from egovcp import spec


@dataclass
class ControllerIdProcessorStep(InfoProcessorStep):  # type: ignore[misc]
    """Writes the id of the low-level controller into ``info``: a policy is trained for one.

    LeRobot gives a policy neither the environment nor its config, so this is how it finds out.
    """

    controller_id: str
    """Of the simulated robots, `LowLevelController.id`."""

    def info(self, info: dict[str, Any]) -> dict[str, Any]:
        """The same with ``controller_id``."""
        return {**info, spec.CONTROLLER_ID_KEY: self.controller_id}

    def get_config(self) -> dict[str, Any]:
        """Arguments to make the step again."""
        return {"controller_id": self.controller_id}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Unchanged: ``info`` is no feature."""
        return features
