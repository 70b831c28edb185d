"""``egovcp-tune-gait``: optimises the parameters of the scripted gait by CMA-ES.

Each candidate walks with several robots at different velocities, under noise, delay and randomised
physics, without a policy. The score is the time before a fall, weighted by how well it follows the
velocity and how still the pelvis is.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.cli import run_command
from egovcp.files import write_json
from egovcp.hardware import available_cores
from egovcp.outputs import require_writable
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.robot.gait import GaitConfig
from egovcp.robot.walking import ACTIONS, Walk, WalkConfig
from egovcp.sim.config import SensorConfig, require_memory_for_robots
from egovcp.spec import ACTION_BOX, CONTROLLER_HZ
from egovcp.terminal import echo
from egovcp_train.lowlevel.config import DisturbanceConfig

PROG: Final = "egovcp-tune-gait"
RESULT: Final = "gait.json"
_DT: Final = 1.0 / CONTROLLER_HZ
_FIXED: Final = ("reach", "least_speed", "tipping", "rise", "fade", "linger")
_SPREAD: Final = 0.3  # of a parameter, relative to its size
_MIN_SIZE: Final = 0.1
_SPEEDS: Final = ((0.0, 0.0), (0.1, 0.3), (0.2, -0.3), (0.3, 0.0), (0.4, 0.2), (0.5, -0.2))

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TuneConfig:
    """Improve the scripted gait by CMA-ES, starting from the present parameters.

    Writes OUTPUT_DIR/gait.json, the options of `GaitConfig`; give them to egovcp-train-lowlevel as
    --walk.gait.NAME=....
    """

    output_dir: str
    """Folder for gait.json."""
    start: GaitConfig = field(default_factory=GaitConfig)
    """Initial parameters."""
    minutes: float = bounded(15.0, above=0)
    """Wall-clock limit."""
    population: int = bounded(28, least=4, most=65_536)
    """Candidates per generation."""
    seconds: float = bounded(6.0, above=0)
    """Length of a walk, s."""
    height: float = bounded(0.72, above=0)
    """Pelvis height, m."""
    seed: int = bounded(0, least=0)
    """Seed of candidates, physics and noise."""
    threads: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """CPU threads; 0: all cores."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(TuneConfig, tune, argv, prog=PROG)


def tune(config: TuneConfig) -> None:
    """Search until the time is over; the last mean is always on disk.

    Raises:
        UsageError: the population does not fit in memory.
        EnvironmentFailure: the package cma is missing, or the folder cannot be written.
    """
    require_memory_for_robots("--population", config.population, config.population * len(_SPEEDS))
    require_packages("egovcp-train", PROG, "cma", *SIMULATOR_MODULES)
    output = Path(config.output_dir)
    require_writable(output)
    import cma  # an optional package

    output.mkdir(parents=True, exist_ok=True)
    search = cma.CMAEvolutionStrategy(
        np.zeros(len(flat(config.start))),
        0.5,
        {"popsize": config.population, "seed": config.seed + 1, "verbose": -9},
    )
    end, generation = time.monotonic() + 60 * config.minutes, 0
    with tqdm(unit="generation", desc="gait") as bar:
        while time.monotonic() < end and not search.stop():
            candidates = search.ask()
            gaits = [shifted(config.start, x) for x in candidates]
            scores = score(gaits, config, generation)
            search.tell(candidates, (-scores).tolist())
            generation += 1
            _save(output / RESULT, shifted(config.start, search.mean), generation)
            most = config.seconds * _MAX_SCORE
            bar.set_postfix_str(f"best {scores.max() / most:.0%}, mean {scores.mean() / most:.0%}")
            bar.update(1)
    echo(f"gait: {output / RESULT}")


def flat(gait: GaitConfig) -> Array:
    """(D,) the parameters that are searched."""
    values = (getattr(gait, f.name) for f in fields(gait) if f.name not in _FIXED)
    return np.concatenate([np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in values])


def shifted(gait: GaitConfig, by: Sequence[float] | Array) -> GaitConfig:
    """``gait`` with its parameters moved by ``by`` (D,), in units of their spread."""
    now = flat(gait)
    moved = now + np.asarray(by) * _SPREAD * np.maximum(np.abs(now), _MIN_SIZE)
    change: dict[str, Any] = {}
    for f in fields(gait):
        old = getattr(gait, f.name)
        if f.name in _FIXED:
            continue
        size = len(old) if isinstance(old, tuple) else 1
        part, moved = moved[:size].tolist(), moved[size:]
        change[f.name] = tuple(part) if isinstance(old, tuple) else part[0]
    change["step_time"] = float(np.clip(change["step_time"], 0.25, 0.6))
    change["soften"] = float(np.clip(change["soften"], 0.05, 1.0))
    change["shift"] = float(np.clip(change["shift"], 0.0, change["step_time"]))
    change["velocity_filter"] = float(np.clip(change["velocity_filter"], 0.05, 1.0))
    return replace(gait, **change)


_MAX_SCORE: Final = 3.0  # per second


def score(gaits: Sequence[GaitConfig], config: TuneConfig, generation: int) -> Array:
    """(len(gaits),) score of each, the mean over its robots, at most 3 per second."""
    # These modules need the simulator, whose presence `tune` has checked.
    from egovcp.sim.robot import noise_std
    from egovcp_train.lowlevel import physics, rewards
    from egovcp_train.lowlevel.sensing import measure

    each = len(_SPEEDS)
    robots = each * len(gaits)
    rng = np.random.default_rng([config.seed, generation])
    threads = config.threads or available_cores()
    disturbances = DisturbanceConfig(
        stiffness_scale=(0.9, 1.1), damping_scale=(0.9, 1.1), friction=(0.6, 1.0)
    )
    seed = int(rng.integers(1 << 31))
    batch = physics.BatchPhysics(robots, "points", disturbances, threads, seed)
    qpos = physics.random_qpos(robots, rng)
    batch.place(np.arange(robots), qpos, qpos[:, 7:])
    delay = physics.random_delays(robots, disturbances, rng)
    walks = [Walk(WalkConfig(gait=gait)) for gait in gaits]
    rows = [slice(i * each, (i + 1) * each) for i in range(len(gaits))]
    command = np.zeros((robots, 10))
    command[:, 3:] = ACTION_BOX.neutral
    command[:, 9] = config.height
    command[:, [0, 2]] = np.tile(_SPEEDS, (len(gaits), 1))
    command[:, 0] = np.maximum(command[:, 0], 0.06)  # the slowest steps, too
    std, velocity = noise_std(SensorConfig()), rewards.AverageVelocity(robots)
    total, up = np.zeros(robots), np.ones(robots, dtype=bool)
    x = batch.snapshot()
    for tick in range(round(config.seconds * CONTROLLER_HZ)):
        state = measure(x, command, std, rng)
        targets = []
        for w, r in zip(walks, rows, strict=True):
            if tick == 0:
                w.reset(state[r])
            w.observe(state[r])
            targets.append(w.targets(np.zeros((each, ACTIONS))))
        batch.step(np.concatenate(targets), delay)
        x = batch.snapshot()
        height = np.concatenate([w.height for w in walks])
        pitch = np.concatenate([w.pitch for w in walks])
        up &= ~rewards.fallen(x, height, pitch)
        velocity.add(x)
        total += up * _DT * _quality(x.angular_velocity, velocity.value, command)
        if not up.any():
            break
    batch.close()
    return np.asarray(total.reshape(len(gaits), each).mean(axis=1))


def _quality(rate: Array, motion: Array, command: Array) -> Array:
    """(N,) per second, at most 3: up 1, velocity 1, turning 0.5, a still pelvis 0.5."""
    off = np.sum((motion[:, :2] - command[:, :2]) ** 2, axis=1)
    turn = (motion[:, 2] - command[:, 2]) ** 2
    still = np.nan_to_num(np.sum(rate[:, :2] ** 2, axis=1), nan=1e3)
    out = 1.0 + np.exp(-off / 0.04) + 0.5 * np.exp(-turn / 0.1) + 0.5 * np.exp(-still / 2.0)
    return np.asarray(out)


def _save(path: Path, gait: GaitConfig, generation: int) -> None:
    content = {"gait": asdict(gait), "generations": generation, "command": [PROG, *sys.argv[1:]]}
    write_json(path, content)


if __name__ == "__main__":
    sys.exit(main())
