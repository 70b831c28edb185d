"""Checks of the live runner on a healthy simulated robot: no check may reject a reading or cause
HOLD or DAMP.

Fails (exit code 1) if one does, or if the robot falls. It walks, is pushed, braces and blocks; see
`tests.support.robots.healthy_run`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from report import parser, publish

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests.support

from tests.support.robots.healthy_run import SITUATIONS, HealthyRun


def main() -> None:
    p = parser(__doc__, rounds=None)
    p.add_argument("--minutes", type=float, default=10.0, help="total simulated time, min")
    p.add_argument("--seed", type=int, default=0, help="seed of the scenarios")
    args = p.parse_args()
    share = 60.0 * args.minutes / len(SITUATIONS)
    metrics: dict[str, object] = {}
    total = dict.fromkeys(("seconds", "readings", "rejected", "alarms", "falls"), 0.0)
    for situation in SITUATIONS:
        healthy, episode = HealthyRun(situation, args.seed), 0
        while (alarms := healthy.alarms).seconds < share:
            healthy.play(episode)
            episode += 1
        found = {
            "seconds": alarms.seconds,
            "readings": alarms.readings,
            "rejected": len(alarms.rejected),
            "alarms": len(alarms.events),
            "falls": alarms.falls,
        }
        name = "".join(c if c.isalnum() else "_" for c in situation.name)
        for key, value in found.items():
            metrics[f"{name}_{key}"] = value
            total[key] += value
        for line in [*alarms.rejected[:5], *alarms.events[:5]]:
            print(f"{situation.name}: {line}", file=sys.stderr)
    publish(metrics | total, args.json)
    if total["rejected"] or total["alarms"] or total["falls"]:
        sys.exit(1)


if __name__ == "__main__":
    main()
