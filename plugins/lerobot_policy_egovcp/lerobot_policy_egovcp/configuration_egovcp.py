"""``--policy.type=egovcp``: configuration of the policy and its training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from egovcp import spec
from egovcp.bounds import bounded, check_bounds
from egovcp.data import ReturnConfig
from egovcp.errors import DataError, UsageError
from egovcp.model import WorldModelConfig
from egovcp.model.config import require_longer
from egovcp.plan import PlannerConfig, require_affordable, require_compatible

FEATURE_SHAPES = {
    spec.DEPTH_KEY: (1, spec.DEPTH_ROWS, spec.DEPTH_COLS),
    spec.STATE_KEY: (spec.STATE_DIM,),
    spec.ACTION_KEY: (spec.ACTION_DIM,),
}


def _no_normalisation() -> dict[str, NormalizationMode]:
    return dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY)


@PreTrainedConfig.register_subclass("egovcp")
@dataclass
class EgovcpConfig(PreTrainedConfig):  # type: ignore[misc]
    """World model, planner and training of an egovcp policy; the first two are the artifact's.

    ``lerobot-train`` saves the last weights, not averaged ones as ``egovcp-train``.
    """

    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    """World model and losses."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Planner that turns the world model into actions."""
    planner_seed: int = bounded(0, least=0, below=2**63)
    """Seed of the planner's samples; `reset` restarts them."""
    save_predicted_video: bool = False
    """lerobot-eval writes ``pred_episode_N.mp4`` beside its videos: the depth image of the first
    robot reconstructed, and imagined 4, 8 and 16 steps ahead."""
    returns: ReturnConfig = field(default_factory=ReturnConfig)
    """Monte Carlo target of Q."""
    sequence_length: int = bounded(20, least=2, most=100_000)
    """Ticks per training window, which begins at the row that LeRobot draws."""
    mirror: bool = True
    """Left-right mirror half of the windows (the robot is symmetric); without it, the planner
    evaluates no mirrored plans."""
    drop_n_last_frames: int = bounded(0, least=0)
    """Rows at the end of an episode at which no window begins. Windows are padded at the end."""
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=_no_normalisation)
    """Identity: the world model normalises, with statistics among its weights."""
    optimizer_lr: float = bounded(1e-3, above=0)
    """Peak learning rate."""
    optimizer_weight_decay: float = bounded(1e-3, least=0)
    """Decoupled weight decay."""
    optimizer_grad_clip_norm: float = bounded(10.0, above=0)
    """Largest gradient norm."""
    scheduler_warmup_steps: int = bounded(100, least=0)
    """Steps of linear warm-up."""
    scheduler_decay_steps: int = bounded(20_000, least=1)
    """Steps of cosine decay to a tenth; a shorter run is decayed faster."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(self, "--policy.")
        self.returns.check("--policy.returns")
        if not self.mirror:  # the model has seen no mirrored scenes
            self.planner = replace(self.planner, mirror=False)
        require_compatible(self.world_model, self.planner)
        require_affordable(self.world_model, self.planner)
        self._check_losses()
        modes = map(NormalizationMode, self.normalization_mapping.values())
        if any(mode is not NormalizationMode.IDENTITY for mode in modes):
            raise UsageError(
                "the world model normalises by itself; leave --policy.normalization_mapping alone"
            )

    def _check_losses(self) -> None:
        loss = self.world_model.loss
        if loss.q_target == "td" and loss.td_decay > 0:
            raise UsageError(
                "lerobot-train keeps no slow copy of Q; give "
                "--policy.world_model.loss.td_decay=0, or train with egovcp-train"
            )
        if self.world_model.dynamics == "autoregressive":
            steps = loss.autoregressive_steps
            require_longer(self.sequence_length, steps, "--policy.sequence_length")

    @property
    def observation_delta_indices(self) -> list[int]:
        """The rows of a window."""
        return list(range(self.sequence_length))

    @property
    def action_delta_indices(self) -> list[int]:
        """The rows of a window and the one before: o_t is filtered after a_{t-1}."""
        return list(range(-1, self.sequence_length))

    @property
    def reward_delta_indices(self) -> None:
        """None: returns need rows beyond the window, see `RowTargets`."""
        return

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=self.scheduler_warmup_steps,
            num_decay_steps=self.scheduler_decay_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.optimizer_lr / 10,
        )

    def validate_features(self) -> None:
        """Raise `DataError` unless depth, state and action are those of egovcp."""
        features = {**(self.input_features or {}), **(self.output_features or {})}
        for name, expected in FEATURE_SHAPES.items():
            if name not in features:
                raise DataError(
                    f"no feature {name!r} among {', '.join(sorted(features)) or 'none'}; an egovcp "
                    "policy needs a dataset of egovcp-collect, or an environment that has it"
                )
            found = tuple(features[name].shape)
            if found != expected:
                raise DataError(f"feature {name!r} has shape {found}, expected {expected}")
