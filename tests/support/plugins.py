"""Task plugins in the tests: a distribution with metadata in a folder on the module path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import egovcp.sim.tasks.registry as registry

#: A post that is always there.
SOURCE = '''
import mujoco, numpy as np
from dataclasses import dataclass
from egovcp.sim.tasks import *

@dataclass(frozen=True)
class PostConfig(TaskConfig):
    """A post."""
    distance_range: Range = bounded((2.0, 3.0), least=0.5, most=9)
    """Post before the pelvis, m."""

class PostTask(Task):
    name = "post"
    description = "leave a post alone"
    terms = {"touch": "block"}
    config: PostConfig = PostConfig()
    episode = EpisodeConfig(ticks=6, event_ticks=(1, 2), empty_probability=0.5)

    def __init__(self, config, scenario, robot):
        super().__init__(config, scenario, robot)
        self.sample("distance")

    @classmethod
    def add_objects(cls, spec):
        body = spec.worldbody.add_body(name="post", mocap=True, pos=[20, 0, 1])
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(name="post", type=kind, size=[0.1, 1, 0], contype=1, conaffinity=0)

    def place(self):
        self.robot.data.mocap_pos[-1] = [self.parameters["distance"], 0, 1]

    def rewards(self):
        return {"touch": 0.25}

    @property
    def achieved(self):
        return True

    @property
    def object_w(self):
        return self.robot.data.mocap_pos[-1].copy()
'''
ENTRY = "post = post_task:PostTask"


def install(
    folder: Path, name: str, source: str, entry: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Install the module ``<name>_task`` of distribution ``egovcp-task-<name>``, version 1.2.

    Args:
        folder: a folder for it.
        name: names module and distribution.
        source: content of the module.
        entry: the line of its entry point.
        monkeypatch: undoes it, and makes the registry search again.
    """
    info = folder / f"egovcp_task_{name}-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: egovcp-task-{name}\nVersion: 1.2\n"
    )
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{entry}\n")
    (folder / f"{name}_task.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv(registry.VARIABLE, "")
    monkeypatch.delitem(sys.modules, f"{name}_task", raising=False)
    monkeypatch.setattr(registry, "_found", None)
