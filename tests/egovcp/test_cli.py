"""Command lines: what is accepted, what is refused with which words and exit code."""

import errno
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import draccus
import pytest

from egovcp.cli import parse_config, run_command, save_config
from egovcp.dataset_options import DatasetConfig
from egovcp.errors import (
    ArtifactError,
    DataError,
    EgovcpError,
    EnvironmentFailure,
    SafetyStop,
    UsageError,
)
from egovcp.flags import read_config

PROG = "egovcp-test"


@dataclass(frozen=True)
class Ball:
    """A ball."""

    radius: float = 0.1
    """Radius, m."""
    bounces: int = 3
    """Bounces."""
    colour: str = "red"
    """Colour."""


@dataclass(frozen=True)
class Stand:
    """What the lamp stands on."""

    height_range: tuple[float, float] = (0.5, 1.5)
    """Height, m."""

    def __post_init__(self) -> None:
        if self.height_range[0] > self.height_range[1]:
            raise DataError(f"expected low <= high, found {self.height_range} in height_range")


@dataclass(frozen=True)
class Lamp:
    """A lamp."""

    stand: Stand = field(default_factory=Stand)
    """Its stand."""
    watts: int | None = None
    """Power, W."""


@dataclass(frozen=True)
class Config:
    """A command for tests."""

    name: str = "none"
    """A name."""
    count: int = 1
    """How many."""
    loud: bool = False
    """Loud."""
    quiet: bool = True
    """Quiet."""
    mode: Literal["fast", "slow"] = "fast"
    """Mode. It is written in the log."""
    sizes: tuple[int, int, int] = (1, 2, 3)
    """Sizes."""
    preset: str = "small"
    """Preset."""
    ball: Ball = field(default_factory=Ball)
    """The ball."""
    lamp: Lamp = field(default_factory=Lamp)
    """The lamp."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset."""


def _parse(*argv: str) -> Config:
    return parse_config(Config, argv, PROG)


# --- what is accepted -------------------------------------------------------------------
def test_without_flags_everything_has_its_default() -> None:
    assert _parse() == Config()


@pytest.mark.parametrize(
    "argv",
    [
        ["--count=4", "--name=x", "--ball.radius=0.15"],
        ["--count", "4", "--name", "x", "--ball.radius", "0.15"],
        ["--ball.radius", "0.15", "--count=4", "--name", "x"],
    ],
)
def test_flags_take_values_with_or_without_equals(argv: list[str]) -> None:
    assert _parse(*argv) == Config(name="x", count=4, ball=Ball(radius=0.15))


@pytest.mark.parametrize("count", ["-3", "+3", "0"])
def test_a_negative_number_is_a_value(count: str) -> None:
    assert _parse("--count", count).count == int(count)
    assert _parse(f"--count={count}").count == int(count)


@pytest.mark.parametrize("argv", [["--loud"], ["--loud=true"], ["--loud", "true"]])
def test_a_bare_boolean_is_true(argv: list[str]) -> None:
    assert _parse(*argv).loud is True
    assert _parse(*argv, "--count=2") == Config(loud=True, count=2)
    assert _parse("--count=2", *argv) == Config(loud=True, count=2)


@pytest.mark.parametrize("value", ["false", "False", "no", "off"])
def test_a_boolean_can_be_switched_off(value: str) -> None:
    assert _parse(f"--quiet={value}").quiet is False


def test_a_value_may_hold_an_equals_sign_and_spaces() -> None:
    assert _parse("--name=a=b c").name == "a=b c"


def test_a_config_file_keeps_parentheses_in_plain_text(tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("name: /data/Smith, (lab)/x\n", encoding="utf-8")
    assert read_config(file) == {"name": "/data/Smith, (lab)/x"}


def test_sequences_are_written_in_brackets() -> None:
    assert _parse("--sizes=[4,5,6]").sizes == (4, 5, 6)


@pytest.mark.parametrize("text", ["007", "1e5", "12e4567", "2024", "true", "null", "1_000"])
def test_text_stays_as_it_is_written(text: str) -> None:
    """A folder called 007 or a commit 12e4567 must not turn into a number."""
    assert _parse(f"--dataset.revision={text}").dataset.revision == text


@dataclass(frozen=True)
class Folders:
    """A command that takes one folder, or several."""

    folders: list[str] | str = ""
    """Folders."""


@pytest.mark.parametrize("text", ["007", "1e5", "2026", "2026-11-30", "true", "null"])
def test_text_that_may_be_a_list_stays_as_it_is_written(text: str) -> None:
    assert parse_config(Folders, [f"--folders={text}"], PROG).folders == text
    assert parse_config(Folders, [f"--folders=['{text}', b]"], PROG).folders == [text, "b"]


def test_what_is_saved_parses_to_the_same(tmp_path: Path) -> None:
    config = Config(name="x: y", sizes=(9, 8, 7), loud=True, ball=Ball(radius=0.2))
    save_config(config, str(tmp_path / "config.yaml"))
    assert _parse(f"--config_path={tmp_path}/config.yaml") == config
    changed = _parse(f"--config_path={tmp_path}/config.yaml", "--ball.bounces=9")
    assert changed.ball == Ball(radius=0.2, bounces=9)


@dataclass(frozen=True)
class Shop:
    """A config that wants other values of what it holds."""

    name: str
    """Its name."""
    ball: Ball = field(default_factory=lambda: Ball(radius=0.7, bounces=5))
    """Its ball."""
    lamp: Lamp = Lamp(stand=Stand((2.0, 3.0)), watts=40)
    """Its lamp."""


@pytest.mark.parametrize("flags", [["--ball.colour=blue"], ["--ball={colour: blue}"]])
def test_one_value_of_a_group_leaves_the_others_as_the_command_has_them(flags: list[str]) -> None:
    flags = ["--name=corner", *flags]
    shop = parse_config(Shop, flags, PROG)
    assert shop.ball == Ball(radius=0.7, bounces=5, colour="blue")
    assert shop.lamp == Shop("corner").lamp
    shop = parse_config(Shop, [*flags, "--ball.radius=0.1", "--lamp.watts=null"], PROG)
    assert shop.ball == Ball(radius=0.1, bounces=5, colour="blue")
    assert shop.lamp == Lamp(stand=Stand((2.0, 3.0)), watts=None)


def test_one_value_of_a_group_in_a_file_leaves_the_others_likewise(tmp_path: Path) -> None:
    (tmp_path / "shop.yaml").write_text("name: corner\nball: {colour: green}")
    shop = parse_config(Shop, [f"--config_path={tmp_path}/shop.yaml", "--ball.bounces=1"], PROG)
    assert shop.ball == Ball(radius=0.7, bounces=1, colour="green")


@pytest.mark.parametrize("option", ["name", "sizes", "ball"])
def test_aliases_that_stand_for_millions_of_values_are_not_expanded(
    option: str, tmp_path: Path
) -> None:
    lists = [f"&a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    (tmp_path / "bomb.yaml").write_text(f"{option}: [&a0 [x, x], {', '.join(lists)}]")
    with pytest.raises(UsageError, match=f"^--{option}=.*: expected"):
        _parse(f"--config_path={tmp_path}/bomb.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{radius: 1, radius: 2}", "key radius is given a second time in line 1"),
        ("{1: 2}", 'key 1 in line 1 is not text; write "1"'),
        (f"{{? 0x{'f' * 4000} : 1}}", "key 0xf+... in line 1 is not text"),
        ("{[1]: 2}", "a key in line 1 is a collection"),
        ("&a {radius: *a}", "--ball=&a {radius: ..}: expected {NAME: VALUE, ...}"),
    ],
)
def test_groups_have_distinct_text_keys_and_no_alias_to_themselves(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        _parse(f"--ball={text}")


def test_a_key_that_a_file_gives_twice_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("name: x\nball:\n  radius: 1\n  radius: 2\n")
    with pytest.raises(UsageError, match=r"a\.yaml .*key radius is given a second time in line 4"):
        _parse(f"--config_path={tmp_path}/a.yaml")


@pytest.mark.parametrize(("text", "kind"), [("- 1", "list"), ("x", "str")])
def test_a_file_without_options_is_refused(text: str, kind: str, tmp_path: Path) -> None:
    (tmp_path / "shop.yaml").write_text(text)
    with pytest.raises(UsageError, match=rf"shop\.yaml holds a {kind}; expected options"):
        _parse(f"--config_path={tmp_path}/shop.yaml")


# --- presets ----------------------------------------------------------------------------
PRESETS = {"small": Ball(), "large": Ball(radius=0.5, bounces=7, colour="blue")}


def _with_preset(*argv: str) -> Config:
    def defaults(args: Sequence[str]) -> dict[str, Any]:
        names = [a.split("=", 1)[1] for a in args if a.startswith("--preset=")]
        return {"ball": draccus.encode(PRESETS[names[-1]])} if names else {}

    return parse_config(Config, argv, PROG, defaults=defaults)


def test_a_preset_sets_nested_values_and_a_flag_overrides_one_of_them() -> None:
    assert _with_preset().ball == Ball()
    assert _with_preset("--preset=large").ball == PRESETS["large"]
    assert _with_preset("--preset", "large").ball == PRESETS["large"]
    for argv in (["--preset=large", "--ball.bounces=1"], ["--ball.bounces=1", "--preset=large"]):
        assert _with_preset(*argv).ball == Ball(radius=0.5, bounces=1, colour="blue")


def test_help_shows_the_defaults_of_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    for argv, bounces in (["--help=ball"], 3), (["--preset=large", "--help=ball"], 7):
        with pytest.raises(SystemExit):
            _with_preset(*argv)
        assert f"(default: {bounces})" in capsys.readouterr().out


# --- what is refused --------------------------------------------------------------------
@pytest.mark.parametrize(
    ("flag", "near"),
    [("--cuont=3", "--count"), ("--ball.raduis=1", "--ball.radius"), ("--lout", "--loud")],
)
def test_an_unknown_flag_is_refused_with_a_suggestion(flag: str, near: str) -> None:
    with pytest.raises(UsageError, match=f"unknown option .* did you mean '{near}'.*--help"):
        _parse(flag)


def test_an_unknown_flag_like_nothing_else_is_refused_plainly() -> None:
    with pytest.raises(UsageError, match="unknown option --xyzzy; see egovcp-test --help"):
        _parse("--xyzzy=1")


@pytest.mark.parametrize("argv", [["stray"], ["--count=1", "stray"], ["--count", "1", "stray"]])
def test_a_stray_argument_is_refused(argv: list[str]) -> None:
    with pytest.raises(UsageError, match="unexpected argument 'stray'"):
        _parse(*argv)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--count=many", "count"),
        ("--count=1.5", "count"),
        ("--ball.radius=wide", "ball.radius"),
        ("--loud=maybe", "loud"),
        ("--count", "count"),
        ("--mode=sideways", "mode"),
        ("--sizes=[1,2]", "sizes"),
        ("--ball=3", "ball"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused_by_name(flag: str, message: str) -> None:
    with pytest.raises(UsageError, match=f"{message}.*see egovcp-test --help"):
        _parse(flag)


@pytest.mark.parametrize(
    ("flag", "expected"),
    [
        ("--count=many", "int"),
        ("--count=100000000000000000000", "int between -2^63 and 2^63"),
        ("--loud=1", "true or false"),
        ("--sizes=1,2,3", "[int, int, int]"),
        ("--lamp.stand.height_range=3", "[float, float]"),
        ("--lamp.watts=x", "int or null"),
    ],
)
def test_a_wrong_value_is_shown_with_what_was_expected(flag: str, expected: str) -> None:
    words = re.escape(f"{flag}: expected {expected}; see")
    with pytest.raises(UsageError, match=f"^{words}"):
        _parse("--count=2", flag)


def test_an_error_of_a_config_class_is_reported_unchanged() -> None:
    """Neither the parser's own words around it, nor another exit code."""
    with pytest.raises(DataError, match=r"^expected low <= high, found \(2\.0, 1\.0\) in \w+$"):
        _parse("--lamp.stand.height_range=[2,1]")


def test_a_nested_group_goes_by_its_full_name_only() -> None:
    assert _parse("--lamp.stand={height_range: [1, 2]}").lamp.stand == Stand((1.0, 2.0))
    assert _parse("--lamp={stand: {height_range: [1, 2]}}").lamp.stand == Stand((1.0, 2.0))
    with pytest.raises(UsageError, match="unknown option --stand"):
        _parse("--stand={height_range: [1, 2]}")


def test_a_config_file_that_is_not_there_is_named() -> None:
    with pytest.raises(UsageError, match=r"cannot read absent\.yaml"):
        _parse("--config_path=absent.yaml")


def test_a_config_file_with_an_unknown_key_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(json.dumps({"cuont": 3}))
    with pytest.raises(UsageError, match="cuont"):
        _parse(f"--config_path={tmp_path}/config.yaml")


# --- exit codes -------------------------------------------------------------------------
def _run(*argv: str, error: BaseException | None = None) -> int:
    def run(config: Config) -> None:
        if error is not None:
            raise error

    return run_command(Config, run, argv, prog=PROG)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (None, 0),
        (EgovcpError("x"), 1),
        (UsageError("x"), 2),
        (DataError("x"), 3),
        (ArtifactError("x"), 4),
        (EnvironmentFailure("x"), 5),
        (SafetyStop("x"), 6),
        (KeyboardInterrupt(), 130),
        (PermissionError(errno.EACCES, "Permission denied", "/data"), 5),
        (OSError(errno.ENOSPC, "No space left on device"), 5),
    ],
)
def test_exit_codes_follow_the_kind_of_error(error: BaseException | None, code: int) -> None:
    assert _run(error=error) == code


def test_a_usage_error_of_the_parser_has_its_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert _run("--cuont=3") == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    "error",
    [DataError("the dataset is bad"), OSError(errno.ENOSPC, "the dataset is bad", "/data")],
)
def test_an_error_is_one_line_and_a_traceback_only_with_debug(
    error: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(error=error) > 0
    plain = capsys.readouterr()
    assert plain.out == ""
    assert plain.err.startswith(f"{PROG}: error: the dataset is bad")
    assert plain.err.count("\n") == 1
    for line in ("--debug", "--count=2 --debug", "--debug --loud", "--debug=True", "--debug yes"):
        assert _run(*line.split(), error=error) > 0
        assert "Traceback" in capsys.readouterr().err
    for line in ("--debug --debug=false", "--debug off"):
        assert _run(*line.split(), error=error) > 0
        assert "Traceback" not in capsys.readouterr().err
    assert _run("--debug=maybe", error=error) == 2
    assert "--debug=maybe: expected true or false" in capsys.readouterr().err


def test_debug_is_no_option_of_the_command_itself() -> None:
    seen: list[Config] = []
    assert run_command(Config, seen.append, ["--debug", "--loud"], prog=PROG) == 0
    assert seen == [Config(loud=True)]


@pytest.mark.parametrize(
    "bug", [RuntimeError("bug"), KeyError("bug"), OSError(errno.EBADF, "Bad file descriptor")]
)
def test_a_bug_raises(bug: Exception) -> None:
    with pytest.raises(type(bug)):
        _run(error=bug)


def test_help_ends_well_and_shows_defaults_and_units(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        _run("--help")
    assert end.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    for part in ("--ball.radius", "Radius, m", "0.1", "A command for tests", "--debug"):
        assert part in text


def test_help_shows_where_a_description_is_shortened(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        _run("--help")
    short = " ".join(capsys.readouterr().out.split())
    assert "Mode ... (default: fast)" in short
    assert "How many. (default: 1)" in short
    assert "'...': shortened, see --help=all" in short
    with pytest.raises(SystemExit):
        _run("--help=all")
    assert "Mode. It is written in the log." in capsys.readouterr().out


def test_help_lists_every_option_once(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        _run("--help=all")
    listed = re.findall(r"^  (--[\w.]+)", capsys.readouterr().out, flags=re.MULTILINE)
    assert {"--lamp", "--lamp.stand", "--lamp.stand.height_range", "--count"} <= set(listed)
    assert len(set(listed)) == len(listed)
    assert "--stand" not in listed


@pytest.mark.parametrize("topic", ["lamp", "lamp.stand"])
def test_help_of_a_group_shows_its_options_only(
    topic: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        _run(f"--help={topic}")
    text = capsys.readouterr().out
    assert "--lamp.stand.height_range" in text
    assert ("--lamp.watts" in text) == (topic == "lamp")
    assert "--count" not in text


def test_help_of_an_unknown_group_names_the_one_that_was_meant(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _run("--help=lmap") == 2
    assert "did you mean 'lamp'?; --help lists the groups" in capsys.readouterr().err


def test_help_lists_the_groups_that_it_leaves_out(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        _run("--help")
    text = capsys.readouterr().out
    assert "--lamp.stand.height_range" not in text
    assert re.search(r"^  lamp\.stand \(1 option\) ", text, re.MULTILINE)


@pytest.mark.parametrize("sizes", ["(4,5,6)", "[4,5,6]", "( 4, 5, 6 )", "[4, 5, 6,]"])
def test_a_sequence_may_be_written_as_a_tuple_or_as_a_list(sizes: str) -> None:
    assert _parse(f"--sizes={sizes}").sizes == (4, 5, 6)


@dataclass(frozen=True)
class Evaluation:
    """Options under names of this project."""

    task: str = "ball"
    episodes: int = 1
    eval_freq: int = 1


def test_lerobots_names_stand_for_the_same_options() -> None:
    argv = ["--env.task=wall", "--eval.n_episodes", "7", "--env_eval_freq=3"]
    assert parse_config(Evaluation, argv, PROG) == Evaluation("wall", 7, 3)
    assert parse_config(Evaluation, ["--eval_steps=5"], PROG) == Evaluation(eval_freq=5)


def test_a_lerobot_name_without_counterpart_is_unknown() -> None:
    with pytest.raises(UsageError, match=r"unknown option --env\.task"):
        _parse("--env.task=wall")
