"""Scenes that no model was trained on: other things, other sizes, noise and delay, and several
tasks in one episode (figure 4a)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from egovcp.robot.controllers import WALK, make_controller
from egovcp.sim.config import STANDING_PUSHES, STEPPING_PUSHES
from egovcp.sim.scenario import SEQUENCE
from egovcp_experiment.cell import Cell, Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import ALL, Grid, Variant
from egovcp_experiment.outcomes import Outcome, outcome
from egovcp_experiment.report.document import (
    Plot,
    Report,
    Table,
    percent,
    percent_range,
    points_range,
)
from egovcp_experiment.report.svg import drawn
from egovcp_experiment.store import Record

#: What the conditions of a task are compared with: the first of them.
TRAINED: Final = "as_trained"
_REFERENCES: Final = ("hold", "oracle")

#: Conditions of every task. Training has noise of 0.001 to 0.004 z^2, up to 1 % holes, actions
#: that take effect 0 to 2 ticks of 20 ms late, and pictures 20 to 80 ms old.
_SENSING: Final[dict[str, Flags]] = {
    "noise_x4": {"env.camera.noise_per_z2": [0.008, 0.016]},
    "holes_10": {"env.camera.hole_probability": [0.1, 0.1]},
    "no_noise": {
        "env.camera.noise_per_z2": [0, 0],
        "env.camera.hole_probability": [0, 0],
        "env.camera.edge_probability": [0, 0],
    },
    "delay_0": {"env.delay.action_ticks": [0, 0], "env.delay.image_age": [0.02, 0.02]},
    "delay_action_80ms": {"env.delay.action_ticks": [4, 4]},
    "delay_image_120ms": {"env.delay.image_age": [0.12, 0.12]},
}
_OWN: Final[dict[str, dict[str, Flags]]] = {
    "ball": {
        "box": {"env.ball.shape": "box"},
        "small": {"env.ball.radius_range": [0.05, 0.08]},
        "large": {"env.ball.radius_range": [0.14, 0.18]},
        "fast": {"env.ball.flight_range": [0.5, 0.6]},
        "slow": {"env.ball.flight_range": [1.0, 1.2]},
        "from_aside": {"env.ball.bearing_range": [0.35, 0.5]},
    },
    "wall": {
        "nearer": {"env.wall.distance_range": [0.52, 0.58]},
        "further": {"env.wall.distance_range": [0.72, 0.8]},
        "turned": {"env.wall.yaw_range": [0.15, 0.3]},
        "slippery": {"env.wall.friction_range": [0.3, 0.5]},
    },
    "arch": {
        "lower": {"env.arch.clearance_range": [1.08, 1.14]},
        "higher": {"env.arch.clearance_range": [1.26, 1.34]},
        "thick": {"env.arch.depth_range": [0.3, 0.5]},
        "slower": {"env.arch.speed_range": [0.2, 0.28], "env.arch_episode.ticks": 400},
        "faster": {"env.arch.speed_range": [0.55, 0.65]},
    },
}
#: Conditions of a sequence, which no model is trained on: the first is made of scenes that one is.
_SEQUENCES: Final[dict[str, Flags]] = {
    "arch_then_ball": {"env.sequence.parts": ["arch", "ball"]},
    "arch_then_box": {"env.sequence.parts": ["arch", "ball"], "env.ball.shape": "box"},
    "arch_then_box_then_wall": {
        "env.sequence.parts": ["arch", "ball", "wall"],
        "env.ball.shape": "box",
    },
}


@dataclass(frozen=True)
class _Played:
    """The outcomes in one condition."""

    planner: Outcome
    references: dict[str, Outcome]


def conditions(config: ExperimentConfig, task: str) -> dict[str, Flags]:
    """Condition -> the flags of scenes in which it differs from training, the first not at all; of
    a sequence those whose parts are all among the tasks."""
    if task == SEQUENCE:
        return {
            name: flags
            for name, flags in _SEQUENCES.items()
            if set(flags["env.sequence.parts"]) <= set(config.tasks)
        }
    own = {TRAINED: {}, **_OWN[task]}
    if task == "wall":
        low, high = _pushes(config)
        own["harder"] = {"env.wall.push_speed_range": [high, high + (high - low) / 2]}
    return {**own, **_SENSING}


def _pushes(config: ExperimentConfig) -> tuple[float, float]:
    """What the controller of the scenes is pushed with, m/s."""
    scenes = dict(flag.removeprefix("--").split("=", 1) for flag in config.scenes)
    walks = make_controller(scenes.get("env.controller", WALK)).walks
    return STEPPING_PUSHES if walks else STANDING_PUSHES


def _chosen(config: ExperimentConfig) -> dict[str, dict[str, Flags]]:
    """Task -> its conditions that are asked for and the first, unless none is."""
    every = {task: conditions(config, task) for task in (*config.tasks, SEQUENCE)}
    if not config.only:
        return {task: config.chosen(row) for task, row in every.items() if row}
    wanted = config.chosen({name: 0 for row in every.values() for name in row})
    return {
        task: {name: row[name] for k, name in enumerate(row) if name in wanted or k == 0}
        for task, row in every.items()
        if wanted.keys() & row.keys()
    }


def _plays(config: ExperimentConfig, grid: Grid) -> dict[tuple[str, str], tuple[list[str], str]]:
    """(task, condition) -> names of the planner's cells, one for each seed, and the references'."""
    found = {}
    for task, row in _chosen(config).items():
        for name, flags in row.items():
            variant = Variant(f"in_{name}", play=flags)
            model = ALL if task == SEQUENCE else task
            planner = [grid.play(task, seed, variant, model).name for seed in config.train.seeds]
            others = grid.references(task, f"references-{task}-{name}", flags, _REFERENCES)
            found[task, name] = (planner, others.name)
    return found


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    _plays(config, grid)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    shows: list[str] = []
    parts: list[str | Table | Plot] = [
        "The model knows scenes `as_trained` only. All conditions draw the same scenarios, so that "
        "differences are paired. `hold` and `oracle` (scripted, sees the truth, same delays) say "
        "what a condition asks for: where the oracle fails, too, it may be out of reach."
    ]
    if SEQUENCE in _chosen(config):
        parts.append(
            "A sequence is several tasks in one episode, and won if each of them is. It is played "
            "by the model of all tasks, which is told neither what comes nor when. Each part draws "
            "what its task draws alone; what a fall keeps from beginning is lost."
        )
    figures: dict[str, Any] = {}
    plays = _plays(config, Grid(config))
    for task, row in _chosen(config).items():
        found = {}
        for name in row:
            planner, others = plays[task, name]
            played = outcome(records, planner, task)
            if played is not None:
                known = {r: outcome(records, [others], task, r) for r in _REFERENCES}
                references = {r: o for r, o in known.items() if o is not None}
                found[name] = _Played(played, references)
        if next(iter(row)) in found:
            parts += [_table(task, found, row), _plot(task, found)]
            shows += _shows(task, found)
        figures[task] = {
            name: {
                "planner": played.planner.figures(),
                **{r: o.figures() for r, o in played.references.items()},
            }
            for name, played in found.items()
        }
    title = "Generalisation: scenes that no model was trained on"
    return Report(title, tuple(shows), tuple(parts), figures)


def _table(task: str, found: Mapping[str, _Played], flags: Mapping[str, Flags]) -> Table:
    base = next(iter(flags))
    trained = found[base].planner
    kinds = list(dict.fromkeys(part for p in found.values() for part in p.planner.parts))
    rows = []
    for name, played in found.items():
        gain, interval = played.planner.success_gain(trained)
        beside = ("", "") if name == base else (f"{100 * gain:+.1f}", points_range(interval))
        shares = played.planner.part_rates
        rows.append(
            (
                name,
                percent(played.planner.success_rate),
                percent_range(played.planner.success_interval),
                *beside,
                *(percent(shares.get(kind)) for kind in kinds),
                *(_rate(played.references.get(r)) for r in _REFERENCES),
                " ".join(f"`{k}={v}`" for k, v in flags[name].items()),
            )
        )
    won = (f"planner's {kind}" for kind in kinds)
    beside = (f"- {base} (points)", "95 %")
    head = ("condition", "planner", "95 %", *beside, *won, *_REFERENCES, "scene")
    return Table(f"{task}: success", head, tuple(rows))


def _rate(played: Outcome | None) -> str:
    return percent(None if played is None else played.success_rate)


def _plot(task: str, found: Mapping[str, _Played]) -> Plot:
    def paint(figure: Any) -> None:
        axes = figure.subplots()
        at = list(range(len(found)))
        planner = [100 * p.planner.success_rate for p in found.values()]
        ranges = [p.planner.success_interval for p in found.values()]
        axes.bar(at, planner, color="C0", width=0.6, label="planner")
        for x, (low, high) in zip(at, ranges, strict=True):
            axes.plot([x, x], [100 * low, 100 * high], color="0.2", linewidth=1)
        for reference, mark in zip(_REFERENCES, ("_", "x"), strict=True):
            known = [
                (x, p.references.get(reference)) for x, p in zip(at, found.values(), strict=True)
            ]
            xs = [x for x, o in known if o is not None]
            ys = [100 * o.success_rate for _, o in known if o is not None]
            axes.plot(xs, ys, mark, color="C3", markersize=8, label=reference)
        axes.set_xticks(at, list(found), rotation=30, ha="right")
        axes.set(ylabel="success, %", ylim=(0, 103))
        axes.legend(fontsize=7, loc="lower right")

    return drawn(f"conditions-{task}", f"{task}: success with 95 % intervals", paint, (8.0, 3.4))


def _shows(task: str, found: Mapping[str, _Played]) -> list[str]:
    (base, first), *others = found.items()
    trained = first.planner
    worse, same = [], []
    for name, played in others:
        gain, (_, high) = played.planner.success_gain(trained)
        if high < 0:
            worse.append(f"`{name}` {100 * gain:+.0f}")
        else:
            same.append(f"`{name}`")
    scenes = "scenes as trained" if base == TRAINED else f"episodes of `{base}`"
    lines = [f"{task}: {percent(trained.success_rate)} of {scenes}"]
    for name, played in found.items():
        shares = (f"{kind} {percent(r)}" for kind, r in played.planner.part_rates.items())
        if played.planner.parts:
            lines.append(f"{task}: parts won in `{name}`: {', '.join(shares)}")
    if worse:
        lines.append(f"{task}: worse by more than chance, points: {', '.join(worse)}")
    if same:
        lines.append(f"{task}: no loss beyond chance (95 %) in {', '.join(same)}")
    return lines


EXPERIMENT: Final = Experiment(
    "unseen boxes, sizes, speeds, walls and arches; noise and delay; several tasks in one episode "
    "(fig. 4a)",
    _cells,
    _report,
)
