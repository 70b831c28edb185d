"""The curves of a recording show every number of a row once."""

from __future__ import annotations

from typing import Any

import numpy as np

from egovcp.log import paths
from egovcp.log.signals import limb, signals_of
from egovcp.robot_spec import G1
from egovcp.spec import ACTION_BOX, JOINT_NAMES, STATE_DIM

SIGNALS = tuple(signals_of(G1))


def test_every_joint_belongs_to_a_limb() -> None:
    counts: dict[str, int] = {}
    for joint in JOINT_NAMES:
        counts[limb(joint)] = counts.get(limb(joint), 0) + 1
    assert counts == {"left_leg": 6, "right_leg": 6, "waist": 3, "left_arm": 7, "right_arm": 7}


def test_every_number_of_the_state_is_on_one_curve(make_tick: Any) -> None:
    tick = make_tick(0, bare=True)
    tick.state[:] = np.arange(STATE_DIM)
    states = [signal for signal in SIGNALS if signal.path.startswith(paths.STATE)]
    shown = np.concatenate([np.asarray(signal.values(tick)) for signal in states])
    assert sorted(shown.tolist()) == list(range(STATE_DIM))


def test_every_curve_has_a_name(make_tick: Any) -> None:
    tick = make_tick(1)
    for signal in SIGNALS:
        assert len(signal.names) == len(set(signal.names)) == len(signal.values(tick))
    assert len({signal.path for signal in SIGNALS}) == len(SIGNALS)


def test_targets_are_those_of_the_action_that_was_sent(make_tick: Any) -> None:
    tick = make_tick(2)
    by_path = {signal.path: signal for signal in SIGNALS}
    parts = [by_path[f"{paths.ACTION}/{name}"] for name in ("left_hand", "right_hand", "height")]
    shown = np.concatenate([np.asarray(part.values(tick)) for part in parts])
    np.testing.assert_allclose(shown, ACTION_BOX.to_metric(tick.action_sent))
