"""False alarms of the motor watch: simulated walking, standing with moving hands, and pushes.

Robots of different mass, friction, gains and delay play the skills of `egovcp-eval-lowlevel` with
sensor noise; in push skills, a push every second, in any horizontal direction. A robot is watched
until it falls or raises an alarm. An alarm is a false alarm (exit code 1). With --dropped, the
left knee's motor gives almost no torque from 3 s on, only that of its damping: later alarms are
detections. Their share of the robots that are watched at 3 s and their delay are measured.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from report import parser, publish

from egovcp.log.tick import MotorReadings
from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.robot.geometry import rotation_matrix
from egovcp.sim.config import SensorConfig
from egovcp.sim.robot import noise_std
from egovcp.spec import CONTROLLER_HZ, JOINT_NAMES, STATE_SLICES
from egovcp_deploy.pilot.motor_watch import MotorWatch
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_train.lowlevel.commands import horizontal
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.physics import BatchPhysics, neutral_qpos, random_delays
from egovcp_train.lowlevel.sensing import measure
from egovcp_train.lowlevel.skills import SKILLS, Skill

_FALLEN_TILT = 0.8  # rad
_KNEE = JOINT_NAMES.index("left_knee_joint")
_DROPPED_TICK = 3 * CONTROLLER_HZ
_TICK_NS = 1_000_000_000 // CONTROLLER_HZ
_TEMPERATURE = np.full((len(JOINT_NAMES), 1), 40.0)  # deg C, below every limit


def run_skill(
    controller_name: str, skill: Skill, robots: int, seed: int, dropped: bool
) -> tuple[float, list[str], int, list[float]]:
    """Play a skill; return the total time the robots were watched (s), the false alarms, how many
    robots were watched at the fault, and the times of detections after the fault (s)."""
    rng = np.random.default_rng([seed, 1])
    config = DisturbanceConfig()
    physics = BatchPhysics(robots, "stock", config, 1, seed)
    controller = make_controller(controller_name)
    commands = skill.script(skill.ticks, robots, rng)
    qpos = neutral_qpos(robots)
    physics.place(np.arange(robots), qpos, qpos[:, 7:])
    delay = random_delays(robots, config, rng)
    std = noise_std(SensorConfig())
    snapshot = physics.snapshot()
    controller.reset(measure(snapshot, commands[0], std, rng))
    watches = [MotorWatch() for _ in range(robots)]
    watched: NDArray[np.bool_] = np.ones(robots, np.bool_)
    seconds, false_alarms, at_fault, detection_times = 0.0, list[str](), 0, list[float]()
    for tick, commands_now in enumerate(commands):
        if skill.push and tick % CONTROLLER_HZ == CONTROLLER_HZ // 2:
            physics.qvel[:, :2] += horizontal(skill.push, rng.uniform(-np.pi, np.pi, robots))
        if tick == _DROPPED_TICK:
            at_fault = int(watched.sum())
        target = controller.step(measure(snapshot, commands_now, std, rng))
        sent = target.copy()
        if dropped and tick >= _DROPPED_TICK:
            sent[:, _KNEE] = snapshot.joints[:, _KNEE]  # leaves the damping only
        physics.step(sent, delay)
        snapshot = physics.snapshot()
        state = measure(snapshot, commands_now, std, rng)
        watched &= (
            rotation_matrix(snapshot.quaternion)[:, 2, 2] > np.cos(_FALLEN_TILT)
        ) & ~snapshot.broken
        for i in np.flatnonzero(watched):
            torque = snapshot.torque[i].copy()
            if dropped and tick >= _DROPPED_TICK:
                torque[_KNEE] = 0.0
            reading = LowState(
                tick * _TICK_NS,
                state[i, STATE_SLICES["joint_position"]],
                state[i, STATE_SLICES["joint_velocity"]],
                snapshot.quaternion[i],
                np.zeros(3),
                motors=MotorReadings(torque, _TEMPERATURE),
            )
            command = MotorCommand(target[i], STIFFNESS, DAMPING)
            verdict = watches[i].update(reading, command)
            seconds += 1.0 / CONTROLLER_HZ
            if reason := verdict.damp or verdict.hold:
                if dropped and tick >= _DROPPED_TICK and JOINT_NAMES[_KNEE] in reason:
                    detection_times.append((tick - _DROPPED_TICK) / CONTROLLER_HZ)
                else:
                    false_alarms.append(f"{skill.name} {tick / CONTROLLER_HZ:.2f} s: {reason}")
                watched[i] = False
    physics.close()
    return seconds, false_alarms, at_fault, detection_times


def main() -> None:
    p = parser(__doc__, rounds=1, rounds_help="seeds of each skill")
    p.add_argument("--controller", default="walk", help="low-level controller")
    p.add_argument("--robots", type=int, default=16, help="robots of each skill")
    p.add_argument(
        "--skills",
        nargs="+",
        choices=[skill.name for skill in SKILLS],
        default=["stand", "walk", "crouch", "push"],
        help="skills of egovcp-eval-lowlevel",
    )
    p.add_argument("--dropped", action="store_true", help="the left knee fails after 3 s")
    args = p.parse_args()
    total, false_alarms, at_fault, detection_times = 0.0, list[str](), 0, list[float]()
    for skill in (skill for skill in SKILLS if skill.name in args.skills):
        for seed in range(args.rounds):
            seconds, found, watched, times = run_skill(
                args.controller, skill, args.robots, seed, args.dropped
            )
            alarms = f"{len(found) + len(times)} alarms ({len(times)} detections)"
            print(f"{skill.name:8} {seconds:7.0f} s watched, {alarms}", flush=True)
            total, false_alarms = total + seconds, false_alarms + found
            at_fault, detection_times = at_fault + watched, detection_times + times
    for line in false_alarms[:20]:
        print(f"false alarm: {line}")
    metrics: dict[str, object] = {"seconds": total, "false_alarms": len(false_alarms)}
    if args.dropped:
        metrics |= {"watched_at_fault": at_fault, "detections": len(detection_times)}
        metrics["detection_rate"] = len(detection_times) / at_fault if at_fault else None
    if detection_times:
        p50, p99 = np.percentile(detection_times, [50, 99])
        metrics |= {"detection_s_p50": p50, "detection_s_p99": p99}
    publish(metrics, args.json)
    if false_alarms:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
