"""Layouts of the Rerun viewer for recordings."""

from __future__ import annotations

from typing import Final

import rerun.blueprint as rrb

from egovcp.log.paths import (
    ACTION,
    CAMERA,
    DEPTH,
    EVENTS,
    IMAGINED,
    INFO,
    LINK,
    MOTOR_FAULTS,
    MOTOR_LOST,
    MOTOR_TEMPERATURE,
    MOTOR_TORQUE,
    OUTCOME,
    PLAN,
    RECONSTRUCTED,
    REWARD,
    RUNNER,
    STATE,
    TIMING,
    VALUE_MAP,
    WORLD,
)


def blueprint(imagined: tuple[int, ...] = ()) -> rrb.Blueprint:
    """Layout for a run with a planner.

    Tab ``plan``: left, the 3D view above value maps and events; right, depth images above curves.
    Tab ``robot``: motors, connection and state of the runner.

    Args:
        imagined: horizons of the imagined depth images, ticks ahead; none leaves them out.
    """
    return rrb.Blueprint(
        rrb.Tabs(
            rrb.Horizontal(
                rrb.Vertical(_scene(), _below_scene(), row_shares=[5, 2]),
                rrb.Vertical(*_images(imagined), *_curves(), row_shares=_shares(imagined)),
                column_shares=[3, 2],
                name="plan",
            ),
            _robot_tab(),
            active_tab=0,
        ),
        _time_panel(),
        collapse_panels=True,
    )


def signals_blueprint() -> rrb.Blueprint:
    """Layout for a recording without a planner: left, 3D view and depth; right, curves."""
    seen = rrb.Spatial2DView(name="depth seen", origin=CAMERA, contents=[DEPTH])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_scene(_SIDE), seen, row_shares=[3, 2]),
            rrb.Vertical(*_outcome_curves(), *_action_curves(), _state_tabs()),
            column_shares=[1, 1],
        ),
        _time_panel(),
        collapse_panels=True,
    )


def _robot_tab() -> rrb.Container:
    """Motors and connection."""
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TimeSeriesView(name="motor temperature (deg C)", origin=MOTOR_TEMPERATURE),
            rrb.TimeSeriesView(name="motor torque (N m)", origin=MOTOR_TORQUE),
        ),
        rrb.Horizontal(
            rrb.TimeSeriesView(name="motor faults (status bits)", origin=MOTOR_FAULTS),
            rrb.TimeSeriesView(name="packets lost by motors", origin=MOTOR_LOST),
        ),
        rrb.Horizontal(
            rrb.TimeSeriesView(name="connection, image age, mode machine", origin=LINK),
            rrb.TimeSeriesView(name="state of the runner", origin=RUNNER),
            rrb.TextLogView(name="events", origin=EVENTS),
        ),
        name="robot",
    )


def _time_panel() -> rrb.TimePanel:
    return rrb.TimePanel(
        state="collapsed", timeline="time", fps=25.0, play_state="playing", loop_mode="all"
    )


def _outcome_curves() -> list[rrb.View | rrb.Container]:
    return [
        rrb.Horizontal(
            rrb.TimeSeriesView(name="reward", origin=REWARD),
            rrb.TimeSeriesView(name="done, success", origin=OUTCOME),
        )
    ]


def _action_curves() -> list[rrb.View | rrb.Container]:
    return [
        rrb.Horizontal(
            rrb.TimeSeriesView(name="left hand target (m)", origin=f"{ACTION}/left_hand"),
            rrb.TimeSeriesView(name="right hand target (m)", origin=f"{ACTION}/right_hand"),
        ),
        rrb.Horizontal(
            rrb.TimeSeriesView(name="height target (m)", origin=f"{ACTION}/height"),
            rrb.TimeSeriesView(name="action in [-1, 1]", origin=f"{ACTION}/normalised"),
        ),
    ]


def _state_tabs() -> rrb.Container:
    return rrb.Tabs(
        rrb.Horizontal(
            rrb.TimeSeriesView(name="angular velocity (rad/s)", origin=f"{STATE}/angular_velocity"),
            rrb.TimeSeriesView(name="projected gravity", origin=f"{STATE}/projected_gravity"),
            name="IMU",
        ),
        _command_curves(),
        rrb.TimeSeriesView(name="joint angles (rad)", origin=f"{STATE}/joint_position"),
        rrb.TimeSeriesView(name="joint velocities (rad/s)", origin=f"{STATE}/joint_velocity"),
        rrb.TextLogView(name="events", origin=EVENTS),
        rrb.TextDocumentView(name="episode", origin=INFO),
    )


def _command_curves() -> rrb.Container:
    return rrb.Horizontal(
        rrb.TimeSeriesView(name="velocity (m/s, rad/s)", origin=f"{STATE}/command_velocity"),
        rrb.TimeSeriesView(name="hands (m)", origin=f"{STATE}/command_hands"),
        rrb.TimeSeriesView(name="height (m)", origin=f"{STATE}/command_height"),
        name="command in o_t",
    )


def _shares(imagined: tuple[int, ...]) -> list[float]:
    return [3.0, *([2.0] if imagined else []), 2.0, 2.0]


def _below_scene() -> rrb.Container:
    maps = [
        rrb.Spatial2DView(
            name=f"Q over x, z of the {hand} hand", origin=f"{VALUE_MAP}/{hand}", background=_DARK
        )
        for hand in ("left", "right")
    ]
    words = rrb.Tabs(
        rrb.TextLogView(name="events", origin=EVENTS),
        rrb.TextDocumentView(name="run", origin=INFO),
    )
    return rrb.Horizontal(*maps, words, column_shares=[1, 1, 1.4])


_DARK: Final = [24, 26, 32]
_FRONT: Final = (1.9, 1.5, 1.2)  # shows both hands and approaching objects
_SIDE: Final = (0.3, 3.1, 1.6)  # a surface in front of the robot does not hide it


def _scene(eye: tuple[float, float, float] = _FRONT) -> rrb.View:
    """The scene, seen from the world position ``eye``."""
    return rrb.Spatial3DView(
        name="robot",
        origin=WORLD,
        contents=[f"{WORLD}/**"],
        background=_DARK,
        eye_controls=rrb.EyeControls3D(
            position=eye, look_target=(0.45, 0.0, 0.68), eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _images(imagined: tuple[int, ...]) -> list[rrb.Container]:
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
        rrb.Horizontal(
            rrb.TimeSeriesView(name="reward", origin=REWARD),
            rrb.TimeSeriesView(name="timing (ms)", origin=TIMING),
        ),
    ]
