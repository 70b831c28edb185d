"""The options of ``egovcp-train``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Final, Literal

from egovcp import spec
from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.data import ReturnConfig, ShuffleConfig
from egovcp.dataset_options import SelectedDatasetConfig, WeightedDatasetConfig
from egovcp.errors import UsageError, suggest
from egovcp.hub import RetryPolicy, is_repo_id
from egovcp.model import PRESETS as MODELS
from egovcp.model import WorldModelConfig
from egovcp.model.config import require_longer
from egovcp.plan import PlannerConfig, require_compatible
from egovcp.plan.config import PAPER_PLANNER, require_affordable
from egovcp.robot_spec import G1, RobotSpec
from egovcp_train.loggers import WandbConfig

_FIT_UPDATES_PER_STEP: Final = 5


@dataclass(frozen=True)
class PrivilegedValueConfig:
    """Fit of the target of Q, see `egovcp_train.privileged_value`."""

    updates: int = bounded(5000, least=1, most=10_000_000)
    """Updates before the training of the world model, at most five for each of its --steps;
    a quarter of --max_minutes is spent on them at most."""
    rows: int = bounded(512, least=1, most=1_000_000)
    """Rows of an update."""
    lr: float = bounded(1e-3, above=0)
    """Learning rate at the start; it decays to 0."""
    training_lr: float = bounded(3e-4, above=0)
    """Peak learning rate while the world model is trained; it follows that of the model."""


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with linear warm-up and cosine decay to 10 % of the peak learning rate."""

    lr: float = bounded(1e-3, above=0)
    """Peak learning rate."""
    weight_decay: float = bounded(1e-3, least=0)
    """Decoupled weight decay."""
    warmup_steps: int = bounded(100, least=0)
    """Steps of linear warm-up."""
    grad_clip: float = bounded(10.0, above=0)
    """Largest gradient norm."""
    ema: float = bounded(0.995, least=0, below=1)
    """Decay of the EMA of the weights, which is evaluated and saved; 0: no EMA."""
    privileged_value: PrivilegedValueConfig = field(default_factory=PrivilegedValueConfig)
    """Fit of the target of Q under --policy.loss.q_target=privileged."""


@dataclass(frozen=True)
class SamplingConfig:
    """Sampling of training batches."""

    length: int = bounded(40, least=1, most=100_000)
    """Ticks per window."""
    burn_in: int = bounded(0, least=0, most=100_000)
    """Leading ticks of a window that only fill the memory and are not trained on."""
    mirror: bool = True
    """Mirror half of the windows left to right (data augmentation); without it, the planner
    evaluates no mirrored plans."""
    tasks: dict[str, float] = field(default_factory=dict)
    """Sampling weight per task relative to uniform sampling, '{ball: 2, wall: 1}'; 1 for tasks not
    listed."""


@dataclass(frozen=True)
class LoadingConfig:
    """How episodes are loaded during training."""

    mode: Literal["auto", "ram", "stream"] = "auto"
    """ram: all in memory, 6.3 kB per frame of the G1; stream: read through a shuffle window from
    disk, or file by file from the Hub; auto: ram if half of the free memory is enough."""
    shuffle: ShuffleConfig = field(default_factory=ShuffleConfig)
    """Shuffle window of mode stream."""
    sample_files: int = bounded(16, least=1, most=65_536)
    """Files of each task that are fetched before the first step where the data comes from the Hub:
    the episodes in them give the scale of the returns, and are evaluated on."""
    network: RetryPolicy = field(default_factory=RetryPolicy)
    """Retries of downloads from the Hub."""


@dataclass(frozen=True)
class PolicyConfig(WorldModelConfig):
    """Network sizes, losses and Hub upload."""

    pretrained_path: str = ""
    """Start from the weights and the normalisation of this policy, `contact`, a folder or a Hub id;
    its networks must have the same sizes."""
    push_to_hub: bool = False
    """Publish the finished policy and its card as a model on the Hub."""
    repo_id: str = ""
    """Where to publish it, `user/name`."""
    private: bool = False
    """A new repository is private."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.push_to_hub and not is_repo_id(self.repo_id):
            raise UsageError(
                f"--policy.repo_id={self.repo_id!r}: expected user/name, where "
                "--policy.push_to_hub publishes"
            )
        if self.repo_id and not self.push_to_hub:
            raise UsageError(
                f"--policy.repo_id={self.repo_id} names a repository without "
                "--policy.push_to_hub; give that, or leave --policy.repo_id empty"
            )

    def world_model(self, robot: RobotSpec = G1) -> WorldModelConfig:
        """What the networks themselves need to know; by default the range of images is that of the
        robot's camera."""
        names = (f.name for f in fields(WorldModelConfig))
        config = WorldModelConfig(**{name: getattr(self, name) for name in names})
        if config.depth_max_m == G1.depth_max_m:
            config = replace(config, depth_max_m=robot.depth_max_m)
        return config


@dataclass(frozen=True)
class TrainConfig:
    """Train the ego-vision world model from a LeRobot dataset and write a policy.

    The dataset comes from disk (--dataset.root) or from the Hub (--dataset.repo_id); --datasets
    mixes several. Checkpoints follow LeRobot's layout:
    OUTPUT_DIR/checkpoints/last/pretrained_model is the artifact for egovcp-deploy.
    """

    cli_options: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "policy": (
            *("hidden", "latent", "units", "channels", "dynamics", "value_loss", "loss"),
            *("pretrained_path", "push_to_hub", "repo_id", "private"),
        ),
        "policy.loss": ("q_target", "reward"),
        "planner": (
            *("samples", "horizon", "iterations", "elites", "objective", "optimiser"),
            *("action_parameterization", "pose_cost", "action_rate_cost"),
        ),
        "returns": ("gamma", "steps", "weights", "scale"),
        "sampling": ("length", "mirror", "tasks"),
        "loading": ("mode",),
        "optimizer": ("lr",),
    }
    """Flags of these groups (see `egovcp.flags`); the other options are constants of `PRESETS`."""
    output_dir: str
    """Folder of the run; must not exist unless --resume."""
    dataset: SelectedDatasetConfig = field(default_factory=SelectedDatasetConfig)
    """Dataset to train on."""
    datasets: tuple[WeightedDatasetConfig, ...] = ()
    """Train on several datasets (replaces --dataset), '[{root: data/ball, weight: 2}, {repo_id:
    me/wall, weight: 1}]'; without weights, frames are sampled uniformly over all of them."""
    features: dict[str, str] = field(default_factory=dict)
    """Names of image, state, action, reward and success in another LeRobot dataset, '{image:
    NAME}'; it is converted to OUTPUT_DIR/dataset first."""
    preset: str = "default"
    """Starting point of all options: default; laptop (ends after 9.5 minutes); paper (the paper's
    losses, returns and planner); debug (tiny networks); or an ablation of the default, such as
    no_multistep."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """World model, losses, what to start from, and where to publish."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """Planner settings stored in the artifact."""
    returns: ReturnConfig = field(default_factory=ReturnConfig)
    """Monte Carlo target of Q."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Sampling of batches."""
    loading: LoadingConfig = field(default_factory=LoadingConfig)
    """Episodes in memory or on disk."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Optimiser."""
    steps: int = bounded(6000, least=1)
    """Gradient steps."""
    max_minutes: float = bounded(0.0, least=0)
    """Wall-clock limit in minutes, over all resumes; the learning-rate schedule then follows
    elapsed time instead of steps, so that a run is not reproducible step by step; 0: no limit."""
    batch_size: int = bounded(32, least=1, most=65_536)
    """Windows per gradient step."""
    seed: int = bounded(0, least=0)
    """Seed of initialisation, batches and sampling."""
    resume: bool = False
    """Resume from the last checkpoint in output_dir, with its options unless given."""
    log_freq: int = bounded(50, least=1)
    """Steps between logged training metrics."""
    eval_freq: int = bounded(1000, least=0)
    """Steps between evaluations on held-out episodes; 0: only at the end."""
    eval_closed_loop: int = bounded(0, least=0, most=1_000_000)
    """Scenarios of each task that are evaluated in simulation at every evaluation; 0: none."""
    save_freq: int = bounded(1000, least=1)
    """Steps between checkpoints; one is always written at the end."""
    threads: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """CPU threads; 0: PyTorch's default, usually one per physical core."""
    device: str = "auto"
    """cpu, cuda, or auto (cuda if there is one)."""
    mixed_precision: Literal["no", "bf16", "auto"] = "auto"
    """Precision of matrix products: no, bf16, or auto (bf16 if the hardware supports it)."""
    tensorboard: bool = True
    """Write TensorBoard records to OUTPUT_DIR/tensorboard."""
    wandb: WandbConfig = field(default_factory=WandbConfig)
    """Weights & Biases."""
    trackio: str = ""
    """Also log to this project of Trackio, on this machine (`trackio show`); empty: do not."""

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UsageError(f"unknown --preset={self.preset}{suggest(self.preset, PRESETS)}")
        if not self.sampling.mirror:  # the model has seen no mirrored scenes
            object.__setattr__(self, "planner", replace(self.planner, mirror=False))
        require_compatible(self.policy, self.planner)
        require_affordable(self.policy, self.planner)
        for term in spec.ACTION_TERMS:
            if self.returns.weights.get(term) and getattr(self.planner, f"{term}_cost"):
                raise UsageError(
                    f"--returns.weights puts {term} into Q, and --planner.{term}_cost charges it "
                    "again; set one of them to 0"
                )
        if self.policy.dynamics == "autoregressive":
            steps = self.policy.loss.autoregressive_steps
            require_longer(self.sampling.length, steps, "--sampling.length")

    @property
    def critic_fit(self) -> PrivilegedValueConfig:
        """The fit of the critic, which is shorter if the run is short."""
        fit = self.optimizer.privileged_value
        return replace(fit, updates=min(fit.updates, _FIT_UPDATES_PER_STEP * self.steps))


def default() -> TrainConfig:
    """The best known recipe for all tasks."""
    return TrainConfig(output_dir="")


def laptop() -> TrainConfig:
    """The default, ended by the clock; the recipe of `make quickstart`."""
    optimizer = OptimizerConfig(privileged_value=PrivilegedValueConfig(updates=3000, rows=256))
    return replace(default(), preset="laptop", max_minutes=9.5, optimizer=optimizer)


def debug() -> TrainConfig:
    """Networks that train in seconds and learn nothing."""
    optimizer = OptimizerConfig(privileged_value=PrivilegedValueConfig(updates=20, rows=64))
    policy = _policy(MODELS["debug"])
    return replace(default(), preset="debug", policy=policy, optimizer=optimizer)


def paper() -> TrainConfig:
    """The paper's losses, returns and planner; no mirrored episodes, no EMA weights.

    Returns that the time limit cuts short count (section III-D), and values after a termination
    are zero.
    """
    return replace(
        default(),
        preset="paper",
        policy=_policy(MODELS["paper"]),
        planner=PAPER_PLANNER,
        returns=ReturnConfig(
            keep_truncated=True, steps=50, weights=dict.fromkeys(spec.ACTION_TERMS, 1.0)
        ),
        sampling=SamplingConfig(mirror=False),
        optimizer=OptimizerConfig(ema=0.0),
    )


def _policy(model: WorldModelConfig) -> PolicyConfig:
    return PolicyConfig(**{f.name: getattr(model, f.name) for f in fields(model)})


def _ablation(name: str, **loss: Any) -> Callable[[], TrainConfig]:
    """The default with other loss options."""

    def build() -> TrainConfig:
        policy = PolicyConfig(loss=replace(PolicyConfig().loss, **loss))
        return replace(default(), preset=name, policy=policy)

    return build


_ABLATED_LOSSES: Final[Mapping[str, Mapping[str, Any]]] = {
    "kl_equal": {"kl_posterior": 0.1},
    "kl_tenfold": {"kl_prior": 1.0, "kl_posterior": 0.1},
    "no_free_nats": {"free_nats": 0.0},
    "free_nats_per_dimension": {"free_nats_per": "dimension"},
    "pixels_summed": {"depth": float(spec.DEPTH_ROWS * spec.DEPTH_COLS)},
    "state_summed": {"state": float(spec.STATE_DIM)},
    "state_1": {"state": 1.0, "multistep_state": 1.0},
    "no_motion_weight": {"motion_weight": 0.0},
    "no_multistep": {"multistep_depth": 0.0, "multistep_state": 0.0, "multistep_object": 0.0},
    "no_proximity_weight": {"proximity_weight": 0.0},
    "no_object": {"object": 0.0, "multistep_object": 0.0},
    "no_sampled_actions": {"sampled_actions": 0},
    "value_weight_1": {"value": 1.0, "imagined_value": 1.0},
    "no_imagined_value": {"imagined_steps": 0},
}


def monte_carlo() -> TrainConfig:
    """Q fitted to the returns of the recorded actions, as a distribution."""
    loss = replace(PolicyConfig().loss, q_target="mc")
    policy = PolicyConfig(value_loss="two_hot", loss=loss)
    return replace(default(), preset="monte_carlo", policy=policy)


#: Ablations of the loss, as `egovcp-experiment ablations` compares them.
ABLATIONS: Final[Mapping[str, Callable[[], TrainConfig]]] = {
    "monte_carlo": monte_carlo,
    **{name: _ablation(name, **loss) for name, loss in _ABLATED_LOSSES.items()},
}
#: Name -> function that returns the complete configuration.
PRESETS: Final[Mapping[str, Callable[[], TrainConfig]]] = {
    "default": default,
    "laptop": laptop,
    "paper": paper,
    "debug": debug,
    **ABLATIONS,
}
