"""The search for the gait's numbers."""

import json
from dataclasses import asdict, fields

import numpy as np
import pytest

from egovcp.robot.gait import GaitConfig
from egovcp_train.lowlevel.tune import TuneConfig, flat, main, score, shifted

CONFIG = TuneConfig(output_dir="", seconds=0.4, threads=1)


def test_no_shift_changes_nothing():
    gait = GaitConfig()
    assert shifted(gait, np.zeros(len(flat(gait)))) == gait


def test_each_number_is_searched_but_those_that_bound_or_decide():
    gait = GaitConfig()
    moved = shifted(gait, np.full(len(flat(gait)), 0.3))
    same = {f.name for f in fields(gait) if getattr(gait, f.name) == getattr(moved, f.name)}
    assert same == {"reach", "least_speed", "tipping", "rise", "fade", "linger"}


def test_numbers_stay_where_they_mean_something():
    wild = shifted(GaitConfig(), np.full(len(flat(GaitConfig())), 100.0))
    assert wild.step_time == 0.6
    assert wild.soften == 1.0
    assert wild.shift <= wild.step_time


def test_a_gait_that_keeps_the_robot_up_scores_more_than_one_that_throws_it():
    good = GaitConfig()
    bad = GaitConfig(hip_pitch=(-8.0, -1.0), hip_roll=(-8.0, -1.0))
    scores = score([good, bad], TuneConfig(output_dir="", seconds=1.5, threads=1), 0)
    assert scores[0] > scores[1] + 0.5


def test_the_same_seed_gives_the_same_score():
    gaits = [GaitConfig()]
    np.testing.assert_array_equal(score(gaits, CONFIG, 3), score(gaits, CONFIG, 3))


def test_it_leaves_numbers_that_a_gait_can_be_made_of(tmp_path):
    flags = ["--minutes=0.02", "--population=4", "--seconds=0.2", "--threads=1"]
    assert main([f"--output_dir={tmp_path}", *flags]) == 0
    content = json.loads((tmp_path / "gait.json").read_text())
    assert content["generations"] >= 1
    numbers = {k: tuple(v) if isinstance(v, list) else v for k, v in content["gait"].items()}
    assert set(asdict(GaitConfig(**numbers))) == set(asdict(GaitConfig()))


@pytest.mark.parametrize("flag", ["--population=2", "--seconds=0", "--minutes=-1"])
def test_nonsense_is_refused(flag, tmp_path, capsys):
    assert main([f"--output_dir={tmp_path / 'x'}", flag]) == 2
    assert flag.split("=")[0] in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
