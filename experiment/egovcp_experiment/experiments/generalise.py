"""Scenes and physics at the edges of the training ranges and beyond them: other objects, sizes,
noise, delay, feet, payload and gains, and several tasks in one episode (figure 4a)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from egovcp.eval_scores import EvalScores
from egovcp.sim.config import CameraConfig, DelayConfig
from egovcp.sim.tasks.arch import ArchConfig
from egovcp.sim.tasks.sequence import SequenceTask
from egovcp.sim.tasks.wall import WallConfig
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.gain_plot import Difference, gain_plot
from egovcp_experiment.grid import DEFAULT, Grid
from egovcp_experiment.report import ExperimentReport, Plot, Table, percent

#: The first condition of a task, which the others are compared with.
TRAINED: Final = "as_trained"
_REFERENCES: Final = ("hold", "oracle")
#: Success that a condition within the training ranges may lose.
_LOSS: Final = 0.03
_WORDS: Final = ("at most 3 points lost", "more than 3 points lost", "undecided")

_CAMERA, _DELAY = CameraConfig(), DelayConfig()


def _only(value: float) -> list[float]:
    """The range of a single value."""
    return [value, value]


#: Conditions of every task at the edges of the training ranges.
_EVERY_EDGE: Final[dict[str, Flags]] = {
    "noise_most": {"env.camera.noise_per_z2": _only(_CAMERA.noise_per_z2[1])},
    "holes_most": {
        "env.camera.hole_probability": _only(_CAMERA.hole_probability[1]),
        "env.camera.edge_probability": _only(_CAMERA.edge_probability[1]),
    },
    **{
        name: {
            "env.delay.action_ticks": _only(_DELAY.action_ticks[end]),
            "env.delay.image_age": _only(_DELAY.image_age[end]),
        }
        for end, name in enumerate(("delay_least", "delay_most"))
    },
}
_EDGES: Final[dict[str, dict[str, Flags]]] = {
    "ball": _EVERY_EDGE,
    "wall": {
        "turned_most": {"env.wall.yaw_range": _only(WallConfig().yaw_range[1])},
        **_EVERY_EDGE,
    },
    "arch": {
        "thickest": {"env.arch.depth_range": _only(ArchConfig().depth_range[1])},
        **_EVERY_EDGE,
    },
}
#: Conditions of every task beyond the training ranges.
_EVERY_TASK: Final[dict[str, Flags]] = {
    "noise_x4": {"env.camera.noise_per_z2": [0.008, 0.016]},
    "holes_10": {"env.camera.hole_probability": [0.1, 0.1]},
    "no_noise": {
        "env.camera.noise_per_z2": [0, 0],
        "env.camera.hole_probability": [0, 0],
        "env.camera.edge_probability": [0, 0],
    },
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


type ConditionScores = dict[str, EvalScores]
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
    own = {TRAINED: {}, **_EDGES[task], **_OWN[task]}
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
    config = grid.config
    chosen = _chosen(config)
    page = ExperimentReport(
        "Generalisation: the edges of the training ranges, and scenes that no model was trained on",
        sections=[
            "The model was trained on scenes `as_trained`, which draw every quantity from its "
            "training range. All conditions draw the same scenarios, so that differences are "
            "paired. The bar within the training ranges is a loss of at most 3 points of success; "
            "a verdict needs the whole interval of the difference on one side of it. `hold` and "
            "`oracle` (scripted, with the simulator's state and the same delays) show how hard a "
            "condition is: where the oracle fails, too, it may be infeasible."
        ],
    )
    if SequenceTask.name in chosen:
        page.sections.append(
            "A sequence is several tasks in one episode; it succeeds if each of them does. It is "
            "played by the same model, whose input names neither tasks nor times. Each part draws "
            "what its task draws alone; parts after a fall are failures."
        )
    found: dict[str, ConditionScores] = {}
    for task, row in chosen.items():
        planner: ConditionScores = {}
        references: dict[str, ConditionScores] = {}
        for name, flags in row.items():
            plays = grid.plays(task, f"in_{name}" if flags else DEFAULT, flags)
            scores = results.eval_scores(records, plays, task)
            cell = grid.references(task, f"references-{task}-{name}", flags, _REFERENCES)
            if scores is not None:
                planner[name] = scores
                references[name] = results.controller_scores(records, cell, task, _REFERENCES)
        if next(iter(row)) in planner:
            found[task] = planner
            for title, names in _groups(task, planner).items():
                part = {name: planner[name] for name in names}
                page.sections.append(_table(f"{task}: {title}", part, references, row))
        page.metrics[task] = {
            name: results.metrics_of({"planner": scores, **references[name]})
            for name, scores in planner.items()
        }
    verdicts = {
        (task, name): _verdict(scores, planner)
        for task, planner in found.items()
        for name, scores in planner.items()
    }
    page.lead = _lead(found, verdicts)
    page.findings = _conclusions(found, verdicts)
    if tasks := {task: planner for task, planner in found.items() if task in config.tasks}:
        page.plot = _plot(tasks)
    return page


def _groups(task: str, names: Iterable[str]) -> dict[str, list[str]]:
    """Title -> conditions, each after the first condition; without empty groups."""
    first, *others = names
    if task == SequenceTask.name:
        return {"several tasks in one episode": [first, *others]}
    edges = [name for name in others if name in _EDGES[task]]
    beyond = [name for name in others if name not in _EDGES[task]]
    groups = {"within the training ranges": edges, "beyond the training ranges": beyond}
    return {title: [first, *part] for title, part in groups.items() if part} or {first: [first]}


def _same_episodes(flags: Flags, other: Flags) -> bool:
    """Whether the episodes have the same length and parts."""
    timing = {name for name in (*flags, *other) if name.endswith(("_episode.ticks", ".parts"))}
    return all(flags.get(name) == other.get(name) for name in timing)


def _verdict(scores: EvalScores, planner: ConditionScores) -> str:
    """One of `_WORDS`; empty for the first condition, and for episodes of other parts."""
    base = next(iter(planner.values()))
    if scores is base or len(scores.parts) != len(base.parts):
        return ""
    low, high = scores.gain(base).success_interval
    return _WORDS[0] if low > -_LOSS else _WORDS[1] if high < -_LOSS else _WORDS[2]


def _table(
    title: str,
    planner: ConditionScores,
    references: Mapping[str, ConditionScores],
    flags: Mapping[str, Flags],
) -> Table:
    """The comparison with the first condition, rates of parts and references, and the scenes."""
    table = results.comparison(title, planner, next(iter(planner)))
    kinds = list(dict.fromkeys(part for scores in planner.values() for part in scores.parts))
    head = ("verdict", *(f"planner's {kind}" for kind in kinds), *_REFERENCES, "scene")
    base, rows = flags[next(iter(planner))], list[Sequence[str]]()
    for cells, (name, scores) in zip(table.rows, planner.items(), strict=True):
        line = list(cells)
        if not _same_episodes(flags[name], base):  # rewards per step are not comparable
            other = ("reward", "its sd", *([] if _verdict(scores, planner) else ["success above"]))
            pairs = zip(table.head, line, strict=True)
            line = ["-" if column.startswith(other) else cell for column, cell in pairs]
        rates = scores.part_rates | {r: s.success_rate for r, s in references[name].items()}
        scene = " ".join(f"`{k}={v}`" for k, v in flags[name].items())
        columns = (percent(rates.get(r)) for r in (*kinds, *_REFERENCES))
        rows.append((*line, _verdict(scores, planner), *columns, scene))
    return Table(title, (*table.head, *head), rows)


def _lead(
    found: Mapping[str, ConditionScores], verdicts: Mapping[tuple[str, str], str]
) -> list[str]:
    edges = {k: v for k, v in verdicts.items() if v and k[1] in _EDGES.get(k[0], ())}
    beyond = {k: v for k, v in verdicts.items() if v and k not in edges}
    lines = []
    for place, own in (("Within", edges), ("Beyond", beyond)):
        if own:
            counts = ", ".join(f"{list(own.values()).count(word)} {word}" for word in _WORDS)
            losses = {k: _points(found, k) for k in own}
            task, name = worst = min(losses, key=losses.__getitem__)
            lines.append(
                f"{place} the training ranges, of {len(own)} conditions: {counts}; the worst is "
                f"`{name}` of {task} ({losses[worst]:+.0f} points)."
            )
    if SequenceTask.name in found:
        rates = ", ".join(
            f"{percent(scores.success_rate)} of `{name}`"
            for name, scores in found[SequenceTask.name].items()
        )
        lines.append(f"Several tasks in one episode: {rates} succeed in whole.")
    return lines


def _points(found: Mapping[str, ConditionScores], key: tuple[str, str]) -> float:
    """Success above the first condition, points."""
    task, name = key
    first = next(iter(found[task].values()))
    return 100 * (found[task][name].success_rate - first.success_rate)


def _conclusions(
    found: Mapping[str, ConditionScores], verdicts: Mapping[tuple[str, str], str]
) -> list[str]:
    lines = []
    for task, planner in found.items():
        base, first = next(iter(planner.items()))
        scenes = "scenes as trained" if base == TRAINED else f"episodes of `{base}`"
        line = f"{task}: {percent(first.success_rate)} of {scenes}"
        for word in _WORDS[1:]:
            shown_names = planner if word == _WORDS[1] else _EDGES.get(task, ())
            own = [n for n in planner if verdicts[task, n] == word and n in shown_names]
            if own:
                shown = ", ".join(f"`{name}` {_points(found, (task, name)):+.0f}" for name in own)
                line += f"; {word}: {shown}"
        lines.append(line)
    return lines


def _plot(found: Mapping[str, ConditionScores]) -> Plot:
    """Success above the first condition, one panel per task."""
    panels: dict[str, dict[str, Difference]] = {}
    for task, planner in found.items():
        (_, base), *others = planner.items()
        panels[task] = {}
        for name, scores in others:
            gain = scores.gain(base)
            low, high = gain.success_interval
            colour = "C0" if name in _EDGES.get(task, ()) else "C1"
            panels[task][name] = Difference(100 * gain.success, (100 * low, 100 * high), colour)
    caption = (
        "Success above that of scenes as trained, within the training ranges (blue) and beyond "
        "them (orange); dotted: a loss of 3 points"
    )
    return gain_plot("conditions", caption, panels, "points", [-100 * _LOSS])
