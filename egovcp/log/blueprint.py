"""Layouts of the Rerun viewer for recordings."""

from __future__ import annotations

from typing import Final

import rerun.blueprint as rrb

from egovcp.log import paths
from egovcp.robot_spec import RobotSpec

_DARK: Final = [24, 26, 32]
_FRONT: Final = (1.9, 1.5, 1.2)  # shows both hands and approaching objects
_SIDE: Final = (0.3, 3.1, 1.6)  # a surface in front of the robot does not hide it


def blueprint() -> rrb.Blueprint:
    """Layout for a run with a planner.

    Tab ``plan``: left, the 3D view above value maps and events; right, depth images above curves.
    Tab ``robot``: motors, connection and state of the runner.
    """
    decoded = rrb.Spatial2DView(name="reconstructed", origin=paths.RECONSTRUCTED)
    imagined = [
        rrb.Spatial2DView(name=f"imagined +{k}", origin=f"{paths.IMAGINED}/{i}")
        for i, k in enumerate(paths.IMAGINED_TICKS)
    ]
    plan = rrb.Horizontal(
        rrb.Vertical(_scene(_FRONT), _below_scene(), row_shares=[5, 2]),
        rrb.Vertical(
            rrb.Horizontal(_depth_view(), decoded),
            rrb.Horizontal(*imagined),
            _curves(
                {
                    "value of the plan": f"{paths.PLAN}/value",
                    "termination probability": f"{paths.PLAN}/termination",
                }
            ),
            _curves({"reward": paths.REWARD, "timing (ms)": paths.TIMING}),
            row_shares=[3.0, 2.0, 2.0, 2.0],
        ),
        column_shares=[3, 2],
        name="plan",
    )
    return _blueprint(rrb.Tabs(plan, _robot_tab(), active_tab=0))


def signals_blueprint() -> rrb.Blueprint:
    """Layout for a recording without a planner: left, 3D view and depth; right, curves."""
    action, state = paths.ACTION, paths.STATE
    hands = {
        "left hand target (m)": f"{action}/left_hand",
        "right hand target (m)": f"{action}/right_hand",
    }
    height = {
        "height target (m)": f"{action}/height",
        "action in [-1, 1]": f"{action}/normalised",
    }
    imu = {
        "angular velocity (rad/s)": f"{state}/angular_velocity",
        "projected gravity": f"{state}/projected_gravity",
    }
    command = {
        "velocity (m/s, rad/s)": f"{state}/command_velocity",
        "hands (m)": f"{state}/command_hands",
        "height (m)": f"{state}/command_height",
    }
    tabs = rrb.Tabs(
        _curves(imu, "IMU"),
        _curves(command, "command in o_t"),
        rrb.TimeSeriesView(name="joint angles (rad)", origin=f"{state}/joint_position"),
        rrb.TimeSeriesView(name="joint velocities (rad/s)", origin=f"{state}/joint_velocity"),
        rrb.TextLogView(name="events", origin=paths.EVENTS),
        rrb.TextDocumentView(name="episode", origin=paths.INFO),
    )
    curves = [
        _curves({"reward": paths.REWARD, "done, success": paths.OUTCOME}),
        _curves(hands),
        _curves(height),
    ]
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(_scene(_SIDE), _depth_view(), row_shares=[3, 2]),
            rrb.Vertical(*curves, tabs),
            column_shares=[1, 1],
        )
    )


def robot_blueprint(robot: RobotSpec) -> rrb.Blueprint:
    """Layout for a robot of another kind than the G1: scene and depth images; plan and signals."""
    decoded = rrb.Spatial2DView(name="reconstructed", origin=paths.RECONSTRUCTED)
    imagined = rrb.Spatial2DView(name="imagined", origin=f"{paths.IMAGINED}/0")
    plan = {
        "value of the plan": f"{paths.PLAN}/value",
        "termination probability": f"{paths.PLAN}/termination",
    }
    states = {name: f"{paths.STATE}/{name}" for name in robot.state_slices}
    tabs = rrb.Tabs(
        *(rrb.TimeSeriesView(name=name, origin=path) for name, path in states.items()),
        rrb.TextLogView(name="events", origin=paths.EVENTS),
        rrb.TextDocumentView(name="run", origin=paths.INFO),
    )
    scene = rrb.Spatial3DView(
        name="scene", origin=paths.WORLD, contents=[f"{paths.SCENE}/**"], background=_DARK
    )
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(_depth_view(), decoded, imagined)),
            rrb.Vertical(
                _curves({"reward": paths.REWARD, "done, success": paths.OUTCOME}),
                _curves(plan),
                _curves({"action in [-1, 1]": f"{paths.ACTION}/normalised"}),
                tabs,
            ),
        )
    )


def _blueprint(root: rrb.Container) -> rrb.Blueprint:
    time = rrb.TimePanel(
        state="collapsed", timeline="time", fps=25.0, play_state="playing", loop_mode="all"
    )
    return rrb.Blueprint(root, time, collapse_panels=True)


def _curves(origins: dict[str, str], name: str | None = None) -> rrb.Container:
    """Plots side by side: title -> entity path."""
    views = [rrb.TimeSeriesView(name=title, origin=path) for title, path in origins.items()]
    return rrb.Horizontal(*views, name=name)


def _robot_tab() -> rrb.Container:
    link = {
        "connection, image age, mode machine": paths.LINK,
        "state of the runner": paths.RUNNER,
    }
    temperature = {
        "motor temperature (deg C)": paths.MOTOR_TEMPERATURE,
        "motor torque (N m)": paths.MOTOR_TORQUE,
    }
    faults = {
        "motor faults (status bits)": paths.MOTOR_FAULTS,
    }
    events = rrb.TextLogView(name="events", origin=paths.EVENTS)
    return rrb.Vertical(
        _curves(temperature),
        _curves(faults),
        rrb.Horizontal(_curves(link), events, column_shares=[2, 1]),
        name="robot",
    )


def _below_scene() -> rrb.Container:
    maps = [
        rrb.Spatial2DView(
            name=f"Q over x, z of the {hand} hand",
            origin=f"{paths.VALUE_MAP}/{hand}",
            background=_DARK,
        )
        for hand in ("left", "right")
    ]
    texts = rrb.Tabs(
        rrb.TextLogView(name="events", origin=paths.EVENTS),
        rrb.TextDocumentView(name="run", origin=paths.INFO),
    )
    return rrb.Horizontal(*maps, texts, column_shares=[1, 1, 1.4])


def _scene(eye: tuple[float, float, float]) -> rrb.View:
    """The 3D scene, seen from the world position ``eye``."""
    return rrb.Spatial3DView(
        name="robot",
        origin=paths.WORLD,
        contents=[f"{paths.WORLD}/**"],
        background=_DARK,
        eye_controls=rrb.EyeControls3D(
            position=eye, look_target=(0.45, 0.0, 0.68), eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _depth_view() -> rrb.View:
    return rrb.Spatial2DView(name="depth seen", origin=paths.CAMERA, contents=[paths.DEPTH])
