"""Variants of the physics, and the differences that are printed."""

import numpy as np
import pytest
import sim_to_sim
from sim_to_sim import VARIANTS, Variant

from egovcp_train.lowlevel.skills import SKILLS, Skill, neutral

STAND = Skill("trial", "", 0.2, neutral)


@pytest.mark.parametrize("name", VARIANTS)
def test_robots_stand_in_every_variant(name: str):
    assert sim_to_sim.survived("stance", STAND, VARIANTS[name], 2, 0, 1).all()


def test_a_difference_is_paired_by_robot():
    reference = np.array([True, True, True, False])
    points, (low, high) = sim_to_sim.difference(np.array([True, False, True, False]), reference)
    assert points == -25.0
    assert low == -75.0
    assert high == 0.0
    assert sim_to_sim.difference(reference, reference) == (0.0, (0.0, 0.0))


def test_what_is_too_far_below_is_marked():
    line = sim_to_sim.row("2 ms steps", [-3.0, -3.1, 1.0])
    assert line.split() == ["2", "ms", "steps", "-3.0", "-3.1*", "+1.0"]
    skills = len(SKILLS) - len(sim_to_sim._NOT_PLAYED)
    assert len(sim_to_sim.row("reference", [0.0] * skills)) <= 120


def test_the_reference_is_that_of_the_evaluation():
    from egovcp_train.lowlevel.evaluate import LowLevelEvalConfig

    config = LowLevelEvalConfig("out")
    assert (config.feet, config.disturbances) == (Variant().feet, Variant().disturbances)
