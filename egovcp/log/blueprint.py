"""How a recording looks when it is opened: nothing to click before something is seen."""

from __future__ import annotations

import rerun.blueprint as rrb

from egovcp.log.paths import (
    CAMERA,
    DEPTH,
    EVENTS,
    IMAGINED,
    INFO,
    PLAN,
    RECONSTRUCTED,
    REWARD,
    TIMING,
    WORLD,
)


def blueprint(imagined: tuple[int, ...] = ()) -> rrb.Blueprint:
    """3D view at the left; at the right the depth images over the time series.

    Args:
        imagined: horizons of the imagined depth images, ticks ahead; none leaves them out.
    """
    return rrb.Blueprint(
        rrb.Horizontal(
            _scene(),
            rrb.Vertical(*_pictures(imagined), *_curves(), row_shares=_shares(imagined)),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(
            state="collapsed", timeline="time", fps=25.0, play_state="playing", loop_mode="all"
        ),
        collapse_panels=True,
    )


def _shares(imagined: tuple[int, ...]) -> list[float]:
    return [3.0, *([2.0] if imagined else []), 2.0, 2.0, 1.5]


def _scene() -> rrb.View:
    """The scene from the front left, where both the hands and what approaches are seen."""
    return rrb.Spatial3DView(
        name="robot",
        origin=WORLD,
        contents=[f"{WORLD}/**"],
        background=[24, 26, 32],
        eye_controls=rrb.EyeControls3D(
            position=(1.9, 1.5, 1.2), look_target=(0.45, 0.0, 0.68), eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _pictures(imagined: tuple[int, ...]) -> list[rrb.Container]:
    seen = rrb.Spatial2DView(name="depth seen", origin=CAMERA, contents=[DEPTH])
    decoded = rrb.Spatial2DView(name="reconstructed", origin=RECONSTRUCTED)
    rows: list[rrb.Container] = [rrb.Horizontal(seen, decoded)]
    if imagined:
        views = [
            rrb.Spatial2DView(name=f"imagined +{k}", origin=f"{IMAGINED}/{i}")
            for i, k in enumerate(imagined)
        ]
        rows.append(rrb.Horizontal(*views))
    return rows


def _curves() -> list[rrb.View | rrb.Container]:
    return [
        rrb.Horizontal(
            rrb.TimeSeriesView(name="value of the plan", origin=f"{PLAN}/value"),
            rrb.TimeSeriesView(name="termination probability", origin=f"{PLAN}/termination"),
        ),
        rrb.TimeSeriesView(name="reward", origin=REWARD),
        rrb.Tabs(
            rrb.TextLogView(name="events", origin=EVENTS),
            rrb.TimeSeriesView(name="timing (ms)", origin=TIMING),
            rrb.TextDocumentView(name="run", origin=INFO),
        ),
    ]
