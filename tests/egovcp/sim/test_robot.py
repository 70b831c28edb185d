"""The simulated robot: objects whose shapes are set per episode."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import pytest

from egovcp.sim.robot import SimulatedRobot


@pytest.mark.parametrize("at", [-0.5, 2.0])
def test_a_reshaped_geom_touches_what_is_there(at: float) -> None:
    """An object of two boxes, whose centre of mass is not the origin of its body."""
    spec = mujoco.MjSpec()
    box, sphere = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
    post = spec.worldbody.add_body(name="post", mocap=True)
    for name, x in (("fixed", 2.0), ("shaped", 0.0)):
        post.add_geom(name=name, type=box, size=[0.1, 0.1, 0.1], pos=[x, 0, 0])
    probe = spec.worldbody.add_body(name="probe", pos=[at, 0, 0])
    probe.add_freejoint()
    for y in (-0.05, 0.05):
        probe.add_geom(type=sphere, size=[0.02, 0, 0], pos=[0, y, 0])
    model = spec.compile()
    scene: Any = SimpleNamespace(model=model, index=None)
    robot = SimulatedRobot(scene)
    robot.shape_geom(robot.model.geom("shaped").id, (0.3, 0.1, 0.1), (-0.5, 0.0, 0.0))
    mujoco.mj_setConst(robot.model, robot.data)  # as `SimulatedRobot.reset`
    robot.forward()
    assert robot.data.ncon
