"""Options of the networks, of PPO and of the curriculum."""

from __future__ import annotations

from dataclasses import dataclass

from egovcp.bounds import bounded


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of actor and critic."""

    actor: tuple[int, ...] = bounded((256, 128, 64), least=1, most=8192, longest=16)
    """Hidden layers of the policy."""
    critic: tuple[int, ...] = bounded((256, 128, 64), least=1, most=8192, longest=16)
    """Hidden layers of the critic, which also sees what only the simulator knows."""
    activation: str = "elu"
    """Activation of both."""
    initial_std: float = bounded(0.3, above=0)
    """Standard deviation of the policy's actions at the start."""


@dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimisation; the names are rsl-rl's."""

    num_steps_per_env: int = bounded(24, least=1, most=100_000)
    """Ticks per robot and iteration."""
    num_learning_epochs: int = bounded(4, least=1, most=10_000)
    """Passes over the data of an iteration."""
    num_mini_batches: int = bounded(4, least=1, most=65_536)
    """Mini-batches per pass."""
    learning_rate: float = bounded(1e-3, above=0)
    """At the start; then it follows desired_kl."""
    desired_kl: float = bounded(0.02, above=0)
    """Change of the policy per update that the learning rate aims at."""
    gamma: float = bounded(0.99, least=0, most=1)
    """Discount per tick of 20 ms."""
    lam: float = bounded(0.95, least=0, most=1)
    """Of generalised advantage estimation."""
    clip_param: float = bounded(0.2, above=0)
    """Clipping of the probability ratio."""
    entropy_coef: float = bounded(0.0, least=0)
    """Weight of the entropy; with one, the exploration noise shakes the torso."""


@dataclass(frozen=True)
class CurriculumConfig:
    """When the task becomes harder."""

    start: float = bounded(0.0, least=0, most=1)
    """Difficulty of the first iteration."""
    step: float = bounded(0.004, least=0)
    """Change of the difficulty per iteration."""
    few_falls: float = bounded(0.02, least=0, most=1)
    """Falls per robot and second, below which it becomes harder."""
    many_falls: float = bounded(0.08, least=0, most=1)
    """Above which it becomes easier."""
    tracking: float = bounded(0.65, least=0)
    """Mean of the velocity reward (1: perfect) that is also needed to make it harder."""
