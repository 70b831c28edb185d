"""Scenes and physics that the model of all tasks was not trained on: other objects, sizes, noise,
delay, feet, payload and gains, and several tasks in one episode (figure 4a)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from egovcp.eval_scores import EvalScores
from egovcp.sim.tasks.sequence import SequenceTask
from egovcp.sim.tasks.wall import WallConfig
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.grid import DEFAULT, Grid
from egovcp_experiment.report import ExperimentReport, Table, percent

#: The first condition of a task, which the others are compared with.
TRAINED: Final = "as_trained"
_REFERENCES: Final = ("hold", "oracle")

#: Conditions of every task. Training has noise of 0.001 to 0.004 z^2, up to 1 % holes, actions
#: delayed by 0 to 2 ticks of 20 ms, images 20 to 80 ms old, a camera that looks up by 10 to 15
#: degrees, feet of four points each, a payload of -0.5 to 1.5 kg, and gains within 5 % (stiffness)
#: and 10 % (damping).
_EVERY_TASK: Final[dict[str, Flags]] = {
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
    "pitch_20_up": {"env.camera.pitch_range": [-0.349, -0.349]},
    "pitch_5_up": {"env.camera.pitch_range": [-0.087, -0.087]},
    "stock_feet": {"env.feet": "stock"},
    "payload_3kg": {"env.randomise.payload": [3, 3]},
    "gains_80": {
        "env.randomise.stiffness_scale": [0.8, 0.8],
        "env.randomise.damping_scale": [0.8, 0.8],
    },
    "gains_120": {
        "env.randomise.stiffness_scale": [1.2, 1.2],
        "env.randomise.damping_scale": [1.2, 1.2],
    },
}
_OWN: Final[dict[str, dict[str, Flags]]] = {
    "ball": {
        "box": {"env.ball.shape": "box"},
        "radius_6cm": {"env.ball.radius_range": [0.06, 0.06]},
        "radius_15cm": {"env.ball.radius_range": [0.15, 0.15]},
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
#: Conditions of a sequence of tasks; the first has only scenes of training.
_SEQUENCES: Final[dict[str, Flags]] = {
    "arch_then_ball": {"env.sequence.parts": ["arch", "ball"]},
    "arch_then_box": {"env.sequence.parts": ["arch", "ball"], "env.ball.shape": "box"},
    "arch_then_box_then_wall": {
        "env.sequence.parts": ["arch", "ball", "wall"],
        "env.ball.shape": "box",
    },
}


type Scores = dict[str, EvalScores]
"""Condition or controller -> scores."""


def conditions(config: ExperimentConfig, task: str) -> dict[str, Flags]:
    """Condition -> changed flags of scenes, none for the first; of a sequence those whose parts are
    all among the tasks."""
    if task == SequenceTask.name:
        return {
            name: flags
            for name, flags in _SEQUENCES.items()
            if set(flags["env.sequence.parts"]) <= set(config.tasks)
        }
    own = {TRAINED: {}, **_OWN[task]}
    if task == "wall":
        low, high = WallConfig().push_speed_range
        own["harder"] = {"env.wall.push_speed_range": [high, high + (high - low) / 2]}
    return {**own, **_EVERY_TASK}


def _chosen(config: ExperimentConfig) -> dict[str, dict[str, Flags]]:
    """Task -> its chosen conditions; with --only, also the first one of each task that has any."""
    every = {task: conditions(config, task) for task in (*config.tasks, SequenceTask.name)}
    if not config.only:
        return {task: config.chosen(row) for task, row in every.items() if row}
    wanted = config.chosen({name: 0 for row in every.values() for name in row})
    return {
        task: {name: row[name] for k, name in enumerate(row) if name in wanted or k == 0}
        for task, row in every.items()
        if wanted.keys() & row.keys()
    }


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    chosen = _chosen(grid.config)
    page = ExperimentReport(
        "Generalisation: scenes that no model was trained on",
        sections=[
            "The model knows scenes `as_trained` only. All conditions draw the same scenarios, so "
            "that differences are paired. `hold` and `oracle` (scripted, with the simulator's "
            "state and the same delays) show how hard a condition is: where the oracle fails, too, "
            "it may be infeasible."
        ],
    )
    if SequenceTask.name in chosen:
        page.sections.append(
            "A sequence is several tasks in one episode; it succeeds if each of them does. It is "
            "played by the same model, whose input names neither tasks nor times. Each part draws "
            "what its task draws alone; parts after a fall are failures."
        )
    for task, row in chosen.items():
        planner: Scores = {}
        references: dict[str, Scores] = {}
        for name, flags in row.items():
            plays = grid.plays(task, f"in_{name}" if flags else DEFAULT, flags)
            scores = results.eval_scores(records, plays, task)
            cell = grid.references(task, f"references-{task}-{name}", flags, _REFERENCES)
            if scores is not None:
                planner[name] = scores
                references[name] = results.controller_scores(records, cell, task, _REFERENCES)
        base = next(iter(row))
        if base in planner:
            page.sections.append(_table(task, planner, references, row))
            plot = results.comparison_plot(f"conditions-{task}", task, planner, base)
            page.sections.append(plot)
            page.findings += _conclusions(task, planner)
        page.figures[task] = {
            name: results.figures_of({"planner": scores, **references[name]})
            for name, scores in planner.items()
        }
    return page


def _table(
    task: str, planner: Scores, references: Mapping[str, Scores], flags: Mapping[str, Flags]
) -> Table:
    """The comparison with the first condition, rates of parts and references, and the scenes."""
    table = results.comparison(task, planner, next(iter(flags)))
    kinds = list(dict.fromkeys(part for scores in planner.values() for part in scores.parts))
    head = (*(f"planner's {kind}" for kind in kinds), *_REFERENCES, "scene")
    rows = []
    for line, (name, scores) in zip(table.rows, planner.items(), strict=True):
        rates = scores.part_rates | {r: s.success_rate for r, s in references[name].items()}
        scene = " ".join(f"`{k}={v}`" for k, v in flags[name].items())
        rows.append((*line, *(percent(rates.get(r)) for r in (*kinds, *_REFERENCES)), scene))
    return Table(task, (*table.head, *head), rows)


def _conclusions(task: str, planner: Scores) -> list[str]:
    (base, first), *others = planner.items()
    worse, same = [], []
    for name, scores in others:
        gain = scores.gain(first)
        if gain.success_interval[1] < 0:
            worse.append(f"`{name}` {100 * gain.success:+.0f}")
        else:
            same.append(f"`{name}`")
    scenes = "scenes as trained" if base == TRAINED else f"episodes of `{base}`"
    lines = [f"{task}: {percent(first.success_rate)} of {scenes}"]
    for name, scores in planner.items():
        rates = ", ".join(f"{kind} {percent(r)}" for kind, r in scores.part_rates.items())
        if rates:
            lines.append(f"{task}: parts won in `{name}`: {rates}")
    if worse:
        lines.append(f"{task}: worse by more than chance, points: {', '.join(worse)}")
    if same:
        lines.append(f"{task}: no loss beyond chance (95 %) in {', '.join(same)}")
    return lines
