"""Videos of simulated episodes that are played side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egovcp.log.tick import Tick
from egovcp.plan import Policy, PolicyStep
from egovcp.rate import NS_PER_S
from egovcp.robot_spec import G1
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
        self._stems = stems
        self._robot = G1
        self._ticks: list[list[Tick]] = [[] for _ in stems]

    def add(
        self, env: BaseVectorEnv, observation: Observation, policy: RolloutPolicy, step: PolicyStep
    ) -> None:
        """Keep o_t and what the model imagines; call it before ``env`` advances."""
        self._robot = env.robot
        rows = [i for i in range(len(self._stems)) if not env.done[i]]
        if not rows:
            return
        from egovcp.log.picture import AHEAD

        imagined = policy.imagine(step.plan, AHEAD) if isinstance(policy, Policy) else None
        for i in rows:
            base, scene = true_poses(env, i)
            index = len(self._ticks[i])
            self._ticks[i].append(
                Tick(
                    index=index,
                    time_ns=index * NS_PER_S // env.robot.planner_hz,
                    depth=observation.depth[i].copy(),
                    state=observation.state[i].copy(),
                    action_planned=step.action[i],
                    action_sent=step.action[i],
                    base=base,
                    scene=scene,
                    depth_imagined=None if imagined is None else imagined[i],
                )
            )

    def write(self) -> None:
        """Draw the files."""
        if not self._stems:
            return  # matplotlib may be missing
        from egovcp.log.picture import write_videos

        for stem, ticks in zip(self._stems, self._ticks, strict=True):
            write_videos(ticks, video_paths(stem), self._robot)
