"""Conclusions about values, open-loop images and behaviour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egovcp_experiment.cell import ARTIFACT, CellOutput
from egovcp_experiment.config import SCALES
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.experiments.interpret import _edges
from egovcp_experiment.report import Plot
from egovcp_experiment.studies.open_loop import HORIZONS


@pytest.mark.parametrize(
    ("empty", "after", "words"),
    [
        ((0.02, 0.04), (0.05, 0.09), "raised for the ball"),
        ((0.02, 0.04), (0.03, 0.09), "not raised"),
        ((0.25, 0.30), (0.40, 0.50), "raised in empty scenes, too"),
    ],
)
def test_intervals_decide_whether_hands_are_raised(
    empty: tuple[float, float], after: tuple[float, float], words: str
) -> None:
    metrics: dict[str, Any] = {
        name: {"mean": sum(ci95) / 2, "ci95": list(ci95), "episodes": 20}
        for name, ci95 in (("empty_scene", empty), ("after_throw", after))
    }
    found = EXPERIMENTS["interpret"].report(
        SCALES["small"](), {"behaviour-ball": {"metrics": metrics}}
    )
    (line,) = found.lead
    assert line.endswith(f"after a throw ({words}).")


def test_bracing_is_compared_with_the_autoregressive_model() -> None:
    def metrics(contact: float, gain: float) -> Mapping[str, Any]:
        def row(name: str, value: float) -> Mapping[str, Any]:
            return {name: value, "ci95": [value - 0.01, value + 0.01], "episodes": 20}

        shares = ("undisturbed_without_contact", "hands_back")
        return {
            **{name: row("share", 0.9) for name in shares},
            "hand_contact": row("share", contact),
            "contact_s": row("mean", 0.4),
            "bracing_q": row("mean", gain),
            "bracing_j": row("mean", gain - 0.1),
        }

    config = SCALES["small"]()
    cells = {c.name: c for c in EXPERIMENTS["interpret"].cells(config)}
    arwm = cells["behaviour-wall-arwm"].flags
    assert arwm["policy.path"] == CellOutput("train-all-arwm-s0", ARTIFACT)
    assert {**cells["behaviour-wall"].flags, "policy.path": arwm["policy.path"]} == arwm
    found = {
        "behaviour-wall": {"metrics": metrics(0.98, 0.5)},
        "behaviour-wall-arwm": {"metrics": metrics(0.1, -0.5)},
    }
    made = EXPERIMENTS["interpret"].report(config, found)
    assert len(made.lead) == 1
    ours, other = made.findings
    assert ours.startswith("wall: a hand touches the wall after 98.0 % of the pushes; Q prefers ")
    assert "+0.40 with the costs" in ours
    assert other.startswith("wall, ARWM: a hand touches the wall after 10.0 %")
    assert "Q does not prefer " in other
    given = replace(config, train=replace(config.train, policies={"all": "contact"}))
    assert "behaviour-wall-arwm" not in {c.name for c in EXPERIMENTS["interpret"].cells(given)}


def test_open_loop_errors_of_all_pixels_lead() -> None:
    row = {"model": 0.1, "repeat": 0.2, "model_changed": 0.3, "repeat_changed": 0.9}
    image = np.ones((len(HORIZONS), 2, 2)).tolist()
    strips = [{"seen": image, "imagined": image}]
    metrics = {"episodes": 3, "errors_m": {str(k): row for k in HORIZONS}, "strips": strips}
    found = {f"open_loop-{task}": {"metrics": metrics} for task in ("ball", "arch")}
    made = EXPERIMENTS["interpret"].report(SCALES["small"](), found)
    assert made.lead[0].endswith(
        "is 4 ticks ahead ball 10.0 cm (20.0 cm), arch 10.0 cm (20.0 cm); "
        "16 ticks ahead ball 10.0 cm (20.0 cm), arch 10.0 cm (20.0 cm)."
    )
    assert made.plot is not None
    assert made.plot.name == "open-loop-ball"
    assert [part.name for part in made.sections if isinstance(part, Plot)] == ["open-loop-arch"]


def test_a_value_map_has_a_frame_around_what_can_be_reached() -> None:
    shown = {
        "moment": "before",
        "tick": 3,
        "hand": "left",
        "best": (0.2, 0.1),
        "reach": ([0.1, 0.3], [0.0, 0.2]),
        "values": [[0.0, 1.0], [2.0, 3.0]],
    }
    summary = {"episodes": 2, "spread": 0.5, "height_error_m": 0.1}
    metrics = {
        "summary": {"before": summary, "75%": summary},
        "x": [0.0, 0.4],
        "z": [0.0, 0.4],
        "aim": [0.1, 0.3],
        "maps": [shown],
    }
    found = {"value_maps-ball": {"metrics": metrics}}
    made = EXPERIMENTS["interpret"].report(SCALES["small"](), found)
    assert made.plot is not None
    assert "what the rate limit can reach" in made.plot.caption
    assert len(made.lead) == 1


def test_the_cells_of_a_value_map_are_around_their_centres() -> None:
    assert _edges([0.0, 0.5, 1.0]) == (-0.25, 1.25)
