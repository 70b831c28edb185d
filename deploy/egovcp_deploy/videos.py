"""Videos of simulated episodes that are played side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egovcp.log.picture import AHEAD, PictureSink
from egovcp.log.tick import RunInfo, Tick
from egovcp.plan import Policy, PolicyStep
from egovcp.rate import NS_PER_S
from egovcp.sim.base_env import BaseVectorEnv, Observation
from egovcp_deploy.options import video_paths
from egovcp_deploy.pilot.planner import RolloutPolicy
from egovcp_deploy.robots.sim import true_poses


class VideoRecorder:
    """Collects and draws the episodes of the first instances of an environment.

    Args:
        stems: their files without suffix.
    """

    def __init__(self, stems: Sequence[Path]) -> None:
        self._sinks = [PictureSink(*video_paths(stem)) for stem in stems]
        self._index = 0  # of o_t

    def add(
        self, env: BaseVectorEnv, observation: Observation, policy: RolloutPolicy, step: PolicyStep
    ) -> None:
        """Keep o_t and what the model imagines; call it before ``env`` advances."""
        rows = [i for i in range(len(self._sinks)) if not env.done[i]]
        if not rows:
            return
        imagined = policy.imagine(step.plan, AHEAD) if isinstance(policy, Policy) else None
        for i in rows:
            base, scene = true_poses(env, i)
            if self._index == 0:
                self._sinks[i].open(RunInfo("", robot=env.robot))
            self._sinks[i].write(
                Tick(
                    index=self._index,
                    time_ns=self._index * NS_PER_S // env.robot.planner_hz,
                    depth=observation.depth[i].copy(),
                    state=observation.state[i].copy(),
                    action_planned=step.action[i],
                    action_sent=step.action[i],
                    base=base,
                    scene=scene,
                    depth_imagined=None if imagined is None else imagined[i],
                )
            )
        self._index += 1

    def write(self) -> None:
        """Draw the files."""
        for sink in self._sinks:
            sink.close()
