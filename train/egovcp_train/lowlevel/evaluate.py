"""``egovcp-eval-lowlevel``: how well a controller stands, reaches, squats, walks, takes pushes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
from tqdm import tqdm

from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.cli import run_command
from egovcp.errors import UsageError, suggest
from egovcp.eval_scores import wilson
from egovcp.files import user_path, write_json
from egovcp.hardware import available_cores
from egovcp.outputs import require_output_file
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import SensorConfig
from egovcp.spec import JOINT_NAMES
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.skills import SKILLS, Skill

PROG = "egovcp-eval-lowlevel"
RESULT = "lowlevel.json"
_BATCH: Final = 200  # robots side by side


@dataclass(frozen=True)
class LowLevelEvalConfig:
    """Evaluate a low-level controller under randomised physics on the stock collision model.

    Every skill is played by --episodes robots of different mass, friction and gains, with
    delay and sensor noise. A fall is a tilt of more than 1 rad, a pelvis below 0.35 m, or
    a velocity above 100 m/s or rad/s. Errors, and the share of the time in which it steps (the gait
    moves a foot), are means over the time before a fall; errors leave out the first 2 s of walking,
    and the first 0.6 s of each target of reach and squat.
    The camera columns are the mean rotation of the head camera, one and eight planner steps (of
    40 ms) apart, in pixels of the depth image: up, across, and at the image's edge by roll.
    The column torque is the RMS torque of the most loaded joint, relative to its motor's peak
    torque; lowlevel.json has all joints.
    """

    output_dir: str
    """Folder for lowlevel.json and videos; its other files are left alone."""
    controller: str = "walk"
    """walk (which the package ships), stance, or the walk.safetensors of egovcp-train-lowlevel."""
    skills: str = ",".join(skill.name for skill in SKILLS)
    """Which skills, separated by commas."""
    episodes: int = bounded(400, least=1, most=1_000_000)
    """Robots per skill."""
    disturbances: DisturbanceConfig = field(default_factory=lambda: DisturbanceConfig(models=400))
    """Ranges of the physical parameters and of the delay."""
    sensors: SensorConfig = field(default_factory=SensorConfig)
    """Noise of proprioception."""
    feet: Literal["stock", "points"] = "stock"
    """Foot collision model."""
    videos: bool = False
    """Also write NAME.gif and NAME.rrd of the first robot of each skill; needs matplotlib and
    Rerun."""
    seed: int = bounded(1000, least=0)
    """Seed of robots, commands, pushes and noise."""
    threads: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """CPU threads; 0: all cores."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(LowLevelEvalConfig, evaluate, argv, prog=PROG)


def evaluate(config: LowLevelEvalConfig) -> None:
    """Play, write the JSON, print the table.

    If it ends early, the results of the robots that have played are written, marked incomplete.

    Raises:
        UsageError: an option makes no sense.
        ArtifactError: the controller's file cannot be used.
        DataError: the simulation diverged.
        EnvironmentFailure: a package is missing, or the folder cannot be written.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    skills = _chosen(config.skills)
    require_packages("egovcp-train", PROG, *SIMULATOR_MODULES)
    if config.videos:
        require_packages("egovcp-train", "--videos", "matplotlib", "rerun")
    controller = make_controller(config.controller)
    if not config.output_dir:
        raise UsageError("--output_dir is empty; expected a folder")
    output = user_path(config.output_dir)
    require_output_file(str(output / RESULT), "--output_dir")
    figures: dict[str, dict[str, Any]] = {}
    complete = False
    try:
        _play_all(config, skills, figures)
        complete = True
    finally:
        if figures:
            run = {
                "controller": controller.id,
                "command": [PROG, *sys.argv[1:]],
                "seed": config.seed,
                "complete": complete,
            }
            output.mkdir(parents=True, exist_ok=True)
            write_json(output / RESULT, figures | {"_run": run})
            echo(table(figures))
            if not complete:
                played = {skill.name: figures.get(skill.name, {}) for skill in skills}
                counts = (
                    f"{k} {f.get('episodes', 0)} of {config.episodes}" for k, f in played.items()
                )
                echo(f"INCOMPLETE: {', '.join(counts)} robots have played")
            echo(f"metrics: {output / RESULT}")


def _play_all(
    config: LowLevelEvalConfig, skills: Sequence[Skill], figures: dict[str, dict[str, Any]]
) -> None:
    """Every skill, into ``figures``.

    Raises:
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    from egovcp_train.lowlevel.trial import SkillRecorder, play  # MuJoCo; --help needs none

    recorders: dict[str, Any] = {}
    if config.videos:
        folder = user_path(config.output_dir)
        folder.mkdir(parents=True, exist_ok=True)
        recorders = {skill.name: SkillRecorder(skill.name, folder) for skill in skills}
    threads = config.threads or available_cores()
    total = len(skills) * config.episodes
    with (
        stop_on_signal() as received,
        tqdm(total=total, unit="robot", desc="skills") as bar,
    ):
        for skill in skills:
            bar.set_postfix_str(skill.name)
            parts: list[Any] = []
            for first in range(0, config.episodes, _BATCH):
                robots = min(_BATCH, config.episodes - first)
                recorder = None if first else recorders.get(skill.name)
                outcome = play(
                    make_controller(config.controller),
                    skill,
                    robots,
                    config.seed + first,
                    config.disturbances,
                    config.sensors,
                    config.feet,
                    threads,
                    lambda: bool(received),
                    on_tick=recorder.add if recorder else None,
                )
                if recorder:
                    recorder.write()
                parts.append(outcome)
                figures[skill.name] = _figures(skill, parts, config.episodes)
                bar.update(robots)


def _chosen(names: str) -> list[Skill]:
    """The skills, each once."""
    by_name = {skill.name: skill for skill in SKILLS}
    chosen = dict.fromkeys(name.strip() for name in names.split(","))
    for name in chosen:
        if name not in by_name:
            raise UsageError(f"unknown skill {name!r} in --skills{suggest(name, by_name)}")
    return [by_name[name] for name in chosen]


def _figures(skill: Skill, parts: Sequence[Any], requested: int) -> dict[str, Any]:
    """One row of the table, from the outcomes of batches."""
    survived = np.concatenate([part.survived for part in parts])
    low, high = wilson(int(survived.sum()), len(survived))
    out: dict[str, Any] = {
        "about": skill.about,
        "episodes": len(survived),
        "survival": float(survived.mean()),
        "survival_ci95": [low, high],
    }
    if len(survived) < requested:
        out |= {"incomplete": True, "episodes_requested": requested}
    for name in list(vars(parts[0]))[1:]:  # without ``survived``
        values = np.concatenate([getattr(part, name) for part in parts])
        known = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
        out[name] = known.mean(axis=0).tolist() if len(known) else None
    if torque := out["torque_rms_relative"]:
        out["torque_rms_relative"] = dict(zip(JOINT_NAMES, torque, strict=True))
    return out


def table(figures: dict[str, dict[str, Any]]) -> str:
    """One line per skill, at most 120 characters."""
    lines = [
        f"{'skill':<9}{'surv.':>7}  {'95 %':<11}{'hand':>5}{'lag':>4}{'height':>7}{'vel.':>6}"
        f"{'turn':>6}{'head':>6}{'steps':>6}  {'camera, px/step':<16}{'8 steps':<14}torque",
        f"{'':<9}{'%':>7}  {'%':<11}{'cm':>5}{'ms':>4}{'cm':>7}{'m/s':>6}{'rad/s':>6}"
        f"{'m':>6}{'%':>6}  {'up/across/roll':<16}{'':<14}%",
    ]
    for name, f in figures.items():
        low, high = f["survival_ci95"]
        lines.append(
            f"{name:<9}{f['survival'] * 100:>7.1f}  {f'{100 * low:.1f}-{100 * high:.1f}':<11}"
            f"{_cell(f['hand_error_m'], 100):>5}{_cell(f['hand_lag_s'], 1000, 0):>4}"
            f"{_cell(f['height_error_m'], 100):>7}{_cell(f['velocity_error_mps'], 1, 2):>6}"
            f"{_cell(f['turning_error_radps'], 1, 2):>6}{_cell(f['head_top_m'], 1, 2):>6}"
            f"{_cell(f['stepping_share'], 100, 0):>6}"
            f"  {_cells(f['camera_px_per_step'], 2):<16}{_cells(f['camera_px_8_steps'], 1):<14}"
            f"{_hottest(f['torque_rms_relative'])}"
        )
    return "\n".join(line.rstrip() for line in lines)


def _hottest(torques: dict[str, float] | None) -> str:
    """The most loaded joint of either side, such as ``9.7 knee``."""
    if torques is None:
        return ""
    joint = max(torques, key=lambda name: torques[name])
    name = joint.removesuffix("_joint").removeprefix("left_").removeprefix("right_")
    return f"{100 * torques[joint]:.1f} {name}"


def _cell(value: float | None, scale: float, digits: int = 1) -> str:
    return "" if value is None else f"{value * scale:.{digits}f}"


def _cells(values: Sequence[float] | None, digits: int) -> str:
    return "" if values is None else "/".join(f"{value:.{digits}f}" for value in values)
