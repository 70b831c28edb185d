"""The world model and its planner behind LeRobot's `PreTrainedPolicy`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Mapping
from copy import copy
from pathlib import Path
from typing import Any, Final, Self

import draccus
import numpy as np
import torch
from draccus.utils import DraccusException
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from numpy.typing import NDArray
from torch import Tensor, nn

from egovcp import spec
from egovcp.artifact import CONFIG, Artifact, load_artifact, require_same_returns, write_artifact
from egovcp.data import DatasetReader
from egovcp.errors import ArtifactError, UsageError
from egovcp.log.rollout_video import grey_image
from egovcp.manifest import FORMAT_KEYS
from egovcp.model import WorldModel, world_model_loss
from egovcp.plan import Policy
from lerobot_policy_egovcp.batches import (
    RowTargets,
    mirrored,
    open_reader,
    read_observation,
    to_batch,
)
from lerobot_policy_egovcp.configuration_egovcp import EgovcpConfig

type Stats = Mapping[str, Mapping[str, Any]]

_LOG: Final = logging.getLogger(__name__)
_AHEAD: Final = (4, 8, 16)  # steps from an observation to the imagined images of the video
_PREFIX = "world_model."


class EgovcpPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """Filters every observation into the state of the world model, then plans.

    It saves an artifact as ``egovcp-train`` writes it (see `egovcp.artifact`).
    """

    config_class = EgovcpConfig
    name = "egovcp"
    config: EgovcpConfig

    def __init__(
        self,
        config: EgovcpConfig,
        dataset_stats: Stats | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        """A new policy, with the statistics of the dataset to train on, if there is one."""
        super().__init__(config)
        config.validate_features()
        self.world_model = WorldModel(config.world_model)
        self._reader = (
            open_reader(Path(dataset_meta.root), dataset_meta.repo_id) if dataset_meta else None
        )
        self._targets: RowTargets | None = None
        self._provenance = _provenance(self._reader, config)
        self._planner: Policy | None = None
        self.last_predicted_latents: Tensor | None = None
        if self._reader is not None and dataset_stats is not None:
            state = dataset_stats[spec.STATE_KEY]
            returns = self._dataset_targets().usable.numpy()
            self.world_model.set_statistics(
                np.asarray(state["mean"]),
                np.asarray(state["std"]),
                returns,
                scaled=config.returns.scale != "none",
                gamma=config.returns.gamma,
            )

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: EgovcpConfig | None = None,
        revision: str | None = None,
        dataset_stats: Stats | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> Self:
        """Load and validate an artifact of ``egovcp-train`` or ``lerobot-train``, for evaluation.

        Args:
            config: replaces the artifact's own, for another planner or other loss weights.
            dataset_stats: unused; the artifact has its own.
            dataset_meta: a dataset to train on further, with the same low-level controller, and
                with the discount and scale of the returns that Q was trained with.
        """
        artifact = load_artifact(str(pretrained_name_or_path), revision or "")
        if not artifact.robot.is_g1:
            raise ArtifactError(
                f"{artifact.path} is of robot {artifact.robot.robot_type}: LeRobot's commands "
                "drive policies of the G1; use egovcp-deploy"
            )
        if config is None:
            config = _read_config(artifact.path)
        if artifact.world_model.object_head is None and config.world_model.predicts_object:
            if dataset_meta is not None:
                raise UsageError(
                    f"{artifact.path} has no object head (egovcp-train does not save it), so it "
                    "cannot be trained with object losses; give "
                    "--policy.world_model.loss.object=0 and "
                    "--policy.world_model.loss.multistep_object=0"
                )
            config = copy(config)
            config.world_model = config.world_model.without_object()
        policy = cls(config, dataset_meta=dataset_meta)
        if policy._reader is not None:
            artifact.require_controller(policy._reader.controller_id)
            state, where = artifact.world_model.state_dict(), f"--policy.path={artifact.path}"
            require_same_returns(state, config.returns, where, "--policy.returns")
        policy._take(artifact)
        policy.to(config.device)
        policy.eval()
        return policy

    def _take(self, artifact: Artifact) -> None:
        """Take the weights and, without a dataset, the provenance of an artifact."""
        try:
            self.world_model.load_state_dict(artifact.world_model.state_dict())
        except RuntimeError as error:
            reason = " ".join(str(error).split())[:300]
            raise ArtifactError(
                f"{artifact.path}: its weights are not those of --policy.world_model ({reason}); "
                "leave the sizes as the artifact has them"
            ) from error
        older = {k: v for k, v in artifact.manifest.items() if k not in FORMAT_KEYS}
        self._provenance = self._provenance or older

    def reset(self) -> None:
        """Reset all robots; the next batch may have another size."""
        self._planner = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any]) -> Tensor:
        """Filter one observation of E robots and plan: the action (E, 7) in [-1, 1] to execute.

        The state advances with this action, as if it were sent unchanged.
        """
        return self.predict_action_chunk(batch)[:, 0]

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any]) -> Tensor:
        """Filter and plan as `select_action`, once per planner step of 40 ms: the plan (E, N, 7).

        An observation whose state is not finite is skipped with a warning, see
        `egovcp.plan.Policy`.

        Args:
            batch: the observation, see `read_observation`. ``info`` may hold the
                ``controller_id`` of the robot's low-level controller, as the processors of
                ``--env.type=egovcp`` write it; the policy must be for that controller.
        """
        self._require_controller(batch.get("info"))
        depth, state = read_observation(batch, check_unit=self._planner is None)
        planner = self._planner_for(len(state))
        before = planner.skipped
        step = planner.act(depth, state)
        if self.config.save_predicted_video:
            ahead = planner.imagine(step.plan, max(_AHEAD))[0]
            images = [planner.reconstruct()[0], *(ahead[k - 1] for k in _AHEAD)]
            self.last_predicted_latents = torch.from_numpy(np.hstack(images))[None, None, None]
        planner.advance(step.action)
        if (robots := (step.skipped & ~before).nonzero()[0]).size:
            _LOG.warning(
                "skipped the observation of robot %s: %s is not finite, or impossible",
                ", ".join(map(str, robots)),
                spec.STATE_KEY,
            )
        return torch.from_numpy(step.plan).to(batch[spec.STATE_KEY].device)

    @staticmethod
    def decode_predicted_latents(latents: Tensor) -> NDArray[np.uint8]:
        """Frames (T, H, W, 3) of a rollout, for lerobot-eval, which joins along T what it finds in
        ``last_predicted_latents`` after each step.

        Args:
            latents: decoded depth images (1, 1, T, h, w) in m.
        """
        return np.stack([grey_image(depth) for depth in latents[0, 0].numpy()])

    def _require_controller(self, info: object) -> None:
        found = info.get(spec.CONTROLLER_ID_KEY) if isinstance(info, Mapping) else None
        expected = self._provenance.get("controller_id")
        if None not in (found, expected) and found != expected:
            raise ArtifactError(
                f"the policy was trained on data of low-level controller {expected!r}, but the "
                f"environment runs {found!r}; choose the data's with --env.simulation.controller, "
                "or train on data of this one"
            )

    def _planner_for(self, robots: int) -> Policy:
        if self._planner is None:
            config = self.config
            self._planner = Policy(self.world_model, config.planner, robots, config.planner_seed)
        if self._planner.num_envs != robots:
            raise UsageError(
                f"the policy follows {self._planner.num_envs} robots and was shown {robots}; call "
                "reset() first"
            )
        return self._planner

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of the world model on windows (see `to_batch`), and its terms."""
        rows = to_batch(batch, self._dataset_targets())
        if self.training and self.config.mirror:
            rows = mirrored(rows, torch.rand(len(rows.state), device=rows.state.device) < 0.5)
        loss, terms = world_model_loss(self.world_model, rows)
        return loss, {name.removeprefix("loss/"): float(value) for name, value in terms.items()}

    def get_optim_params(self) -> Iterator[nn.Parameter]:
        return self.world_model.parameters()

    def _dataset_targets(self) -> RowTargets:
        if self._targets is None:
            if self._reader is None:
                raise UsageError(
                    "an egovcp policy learns from the rewards of a whole dataset: make it with "
                    "dataset_meta, as lerobot-train does"
                )
            self._targets = RowTargets.of(self._reader, self.config.returns)
        return self._targets

    def _save_pretrained(
        self, save_directory: Path, state_dict: dict[str, Tensor] | None = None
    ) -> None:
        """Write the artifact; LeRobot adds its processors, and so the manifest is without them."""
        weights = {
            name.removeprefix(_PREFIX): value
            for name, value in (state_dict or self.state_dict()).items()
        }
        config = draccus.encode(self.config, PreTrainedConfig)
        write_artifact(Path(save_directory), config, weights, self._provenance, {})


def _read_config(folder: Path) -> EgovcpConfig:
    try:
        config: EgovcpConfig = PreTrainedConfig.from_pretrained(folder)
        return config
    except (UsageError, DraccusException, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:300]
        raise ArtifactError(f"{folder / CONFIG}: {reason}; the file is damaged") from error


def _provenance(reader: DatasetReader | None, config: EgovcpConfig) -> dict[str, Any]:
    """Provenance for the manifest; empty without a dataset."""
    if reader is None:
        return {}
    source = reader.source
    return {
        "controller_id": reader.controller_id,
        "datasets": [{"repo_id": source.repo_id, "revision": source.commit}],
        "train_config": {"returns": draccus.encode(config.returns)},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
    }
