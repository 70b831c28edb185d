"""Layouts of the Rerun viewer for recordings."""

from __future__ import annotations

from typing import Final

import rerun.blueprint as rrb

from egovcp.log import paths
from egovcp.robot_spec import RobotSpec

_DARK: Final = [24, 26, 32]
_FRONT: Final = (1.9, 1.5, 1.2)  # shows both hands and approaching objects
_SIDE: Final = (0.3, 3.1, 1.6)  # a surface in front of the robot does not hide it
_PLAN: Final = {
    "value of the plan": f"{paths.PLAN}/value",
    "termination probability": f"{paths.PLAN}/termination",
}
_UNITS: Final = {
    "angular_velocity": "rad/s",
    "command_velocity": "m/s, rad/s",
    "command_hands": "m",
    "command_height": "m",
    "joint_position": "rad",
    "joint_velocity": "rad/s",
}


def blueprint() -> rrb.Blueprint:
    """Layout for a run with a planner.

    Tab ``plan``: left, the 3D view above value maps and events; right, depth images above curves.
    Tab ``robot``: motors, connection and state of the runner.
    """
    plan = rrb.Horizontal(
        rrb.Vertical(_scene(_FRONT), _below_scene(), row_shares=[5, 2]),
        rrb.Vertical(
            rrb.Horizontal(_depth_view(), _reconstructed_view()),
            rrb.Horizontal(*(_imagined_view(i) for i in range(len(paths.IMAGINED_TICKS)))),
            _curves(_PLAN),
            _curves({"reward": paths.REWARD, "timing (ms)": paths.TIMING}),
            row_shares=[3.0, 2.0, 2.0, 2.0],
        ),
        column_shares=[3, 2],
        name="plan",
    )
    return _blueprint(rrb.Tabs(plan, _robot_tab(), active_tab=0))


def signals_blueprint(robot: RobotSpec) -> rrb.Blueprint:
    """Layout for a recording without a planner, and for another robot than the G1: left, 3D view
    and depth images; right, curves of every signal."""
    images: list[rrb.View] = [_depth_view()]
    curves = [
        _curves({"reward": paths.REWARD, "done, success": paths.OUTCOME}),
        _curves({"action in [-1, 1]": f"{paths.ACTION}/normalised"}),
    ]
    if robot.is_g1:
        scene = _scene(_SIDE)
        parts = ("left_hand", "right_hand", "height")
        targets = {f"{_title(part)} target (m)": f"{paths.ACTION}/{part}" for part in parts}
        curves.append(_curves(targets))
    else:
        scene = rrb.Spatial3DView(
            name="scene", origin=paths.WORLD, contents=[f"{paths.SCENE}/**"], background=_DARK
        )
        images += [_reconstructed_view(), _imagined_view(0)]
        curves.append(_curves(_PLAN))
    states = [
        rrb.TimeSeriesView(name=_title(name), origin=f"{paths.STATE}/{name}")
        for name in robot.state_slices
    ]
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(*images), row_shares=[3, 2]),
            rrb.Vertical(*curves, rrb.Tabs(*states, *_texts())),
        )
    )


def _title(signal: str) -> str:
    """``angular_velocity`` -> ``angular velocity (rad/s)``."""
    unit = f" ({_UNITS[signal]})" if signal in _UNITS else ""
    return signal.replace("_", " ") + unit


def _blueprint(root: rrb.Container) -> rrb.Blueprint:
    time = rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="all")
    return rrb.Blueprint(root, time, collapse_panels=True)


def _curves(origins: dict[str, str]) -> rrb.Container:
    """Plots side by side: title -> entity path."""
    views = [rrb.TimeSeriesView(name=title, origin=path) for title, path in origins.items()]
    return rrb.Horizontal(*views)


def _robot_tab() -> rrb.Container:
    motors = {
        "motor temperature (deg C)": paths.MOTOR_TEMPERATURE,
        "motor torque (N m)": paths.MOTOR_TORQUE,
    }
    link = {
        "connection, image age, mode machine": paths.LINK,
        "state of the runner": paths.RUNNER,
    }
    events = rrb.TextLogView(name="events", origin=paths.EVENTS)
    return rrb.Vertical(
        _curves(motors),
        _curves({"motor faults (status bits)": paths.MOTOR_FAULTS}),
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
    return rrb.Horizontal(*maps, rrb.Tabs(*_texts()), column_shares=[1, 1, 1.4])


def _texts() -> list[rrb.View]:
    return [
        rrb.TextLogView(name="events", origin=paths.EVENTS),
        rrb.TextDocumentView(name="run", origin=paths.INFO),
    ]


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


def _reconstructed_view() -> rrb.View:
    return rrb.Spatial2DView(name="reconstructed", origin=paths.RECONSTRUCTED)


def _imagined_view(i: int) -> rrb.View:
    """The image imagined the i-th number of `paths.IMAGINED_TICKS` ahead."""
    name = f"imagined +{paths.IMAGINED_TICKS[i]}"
    return rrb.Spatial2DView(name=name, origin=f"{paths.IMAGINED}/{i}")
