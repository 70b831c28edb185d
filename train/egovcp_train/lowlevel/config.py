"""Options of the networks, of PPO and of the curriculum."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of actor and critic."""

    actor: tuple[int, ...] = (256, 128, 64)
    """Hidden layers of the policy."""
    critic: tuple[int, ...] = (256, 128, 64)
    """Hidden layers of the critic, which also sees what only the simulator knows."""
    activation: str = "elu"
    """Activation of both."""
    initial_std: float = 0.3
    """Standard deviation of the policy's actions at the start."""


@dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimisation; the names are rsl-rl's."""

    num_steps_per_env: int = 24
    """Ticks per robot and iteration."""
    num_learning_epochs: int = 4
    """Passes over the data of an iteration."""
    num_mini_batches: int = 4
    """Mini-batches per pass."""
    learning_rate: float = 1e-3
    """At the start; then it follows desired_kl."""
    desired_kl: float = 0.02
    """Change of the policy per update that the learning rate aims at."""
    gamma: float = 0.99
    """Discount per tick of 20 ms."""
    lam: float = 0.95
    """Of generalised advantage estimation."""
    clip_param: float = 0.2
    """Clipping of the probability ratio."""
    entropy_coef: float = 0.003
    """Weight of the entropy."""


@dataclass(frozen=True)
class CurriculumConfig:
    """When the task becomes harder."""

    step: float = 0.004
    """Change of the difficulty per iteration."""
    few_falls: float = 0.02
    """Falls per robot and second, below which it becomes harder."""
    many_falls: float = 0.08
    """Above which it becomes easier."""
    tracking: float = 0.65
    """Mean of the velocity reward (1: perfect) that is also needed to make it harder."""
