"""Every option of every command with values that are not of its type, too large, or malformed."""

from __future__ import annotations

import io
from collections import Counter
from contextlib import redirect_stderr
from typing import Any

import draccus
import pytest

from egovcp.cli import parse_config, run_command
from egovcp.decode import require_type
from egovcp.errors import EgovcpError

from .listing import Option, all_commands, all_options, options_of, required_flags

PROG = "egovcp-test"
BOMB = "[&a [x,x,x,x,x,x,x,x,x,x]," + ",".join(
    f"&{name} [{','.join([f'*{before}'] * 10)}]"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
VALUES = [
    *("", " ", "null", "true", "x", "x" * 300, "/", "~", "~nobody/x", ",", "*", "&", "%s", "{0}"),
    *("nan", ".nan", "inf", "-.inf", "1e309", "1e308", "-1e308", "0", "-0", "-1", "0.5", "1e6"),
    *("0x10", "1_0", "\u0661", "9" * 30, "-" + "9" * 30, "9" * 5000, str(2**63), "01", "+1", "1 2"),
    *("[]", "[null]", "[[]]", "[1]", "[nan, nan]", "[1, x]", "[-1, -1]", "[2, 1]", "(1, 2)"),
    *("(1, 2", "1, 2)", "((1, 2), (3, 4))", "()", "[1, 2, 3, 4, 5, 6, 7, 8, 9]", "[true, false]"),
    *("{}", "{a: 1}", "{ball: 1}", "{ball: x}", "{ball: [x]}", "{ball: null}", "{1: 2}", "[{}]"),
    *("[" * 3000, "(" * 3000, "{a: " * 3000, "&a [*a]", f"{BOMB}]", "[!!python/name:os.system ]"),
    *(
        "\x1b[31m",
        "\x00",
        "a\0b",
        "\udcff",
        "a\nb",
        "\u202e",
        "[\x1b]",
        "['\udcff']",
        "\t",
        "'",
        '"',
    ),
]
#: Types of twenty options or more, with bounds but without rules of their own.
COMMON_KINDS = (float, int, bool, tuple[float, float])
#: Integers that allocate nothing.
UNBOUNDED = {
    *("seed", "seeds", "steps", "warmup_steps", "attempts"),
    *("log_freq", "eval_freq", "save_freq", "decode_every", "multistep_stride", "stride"),
    *("episode", "max_problems", "most", "mode"),
}


def _run(option: Option, value: str) -> tuple[int, str, Any]:
    """(exit code, what is printed, the parsed value) of a command with this one option."""
    flags = [*required_flags(option.config_class), f"--{option.name}={value}"]
    printed = io.StringIO()
    parsed: list[Any] = [None]

    def keep(config: Any) -> None:
        parsed[0] = getattr(config, option.name)

    with redirect_stderr(printed):
        code = run_command(option.config_class, keep, flags, prog=PROG)
    return code, printed.getvalue(), parsed[0]


def _problem(option: Option, value: str) -> str:
    """What is wrong with how the value is treated; empty: nothing."""
    try:
        code, printed, parsed = _run(option, value)
    except Exception as error:  # noqa: BLE001 - every one is reported
        return f"{type(error).__name__}: {error}"
    if code == 0:
        try:
            require_type(draccus.encode(parsed), option.kind, option.name)
        except ValueError as error:
            return f"accepted, although {error}"
        return ""
    message = printed.removeprefix(f"{PROG}: error: ").removesuffix("\n")
    if option.name not in message:
        return f"does not name the option: {message}"
    if not message.isprintable() or len(message) > 2010 or not 2 <= code <= 5:
        return f"exit code {code}: {message}"
    return ""


def _values(option: Option, number: int) -> list[str]:
    """Values for the option of this number; a twelfth of them if many options are parsed alike."""
    return VALUES[number % 12 :: 12] if option.kind in COMMON_KINDS else VALUES


def test_a_value_of_another_type_is_refused_by_name() -> None:
    problems = []
    numbers = Counter[str]()
    for name, option in all_options().items():
        numbers[str(option.kind)] += 1
        for value in _values(option, numbers[str(option.kind)]):
            if problem := _problem(option, value):
                problems.append(f"{name}={value[:40]!a}: {problem[:200]}")
    assert not problems, f"{len(problems)} problems\n" + "\n".join(problems[:50])


def test_every_integer_has_an_upper_bound() -> None:
    """A huge integer must be refused before anything is allocated."""
    options = {n: o for n, o in all_options().items() if o.name not in UNBOUNDED}
    unbounded = []
    for name, option in options.items():
        value = _large(option.kind)
        if value is None:
            continue
        if _run(option, value)[0] == 0:
            unbounded.append(name)
    assert not unbounded


def _large(kind: Any) -> str | None:
    number = str(2**62)
    if kind in (int, int | None, tuple[int, ...]):
        return f"[{number}]" if kind == tuple[int, ...] else number
    if kind in (tuple[int, int], list[int]):
        return f"[1, {number}]"
    return f"{{ball: {number}}}" if kind == dict[str, int] else None


@pytest.mark.parametrize("text", ["x", "[1, x, {}]", "nan"])
def test_every_flag_of_every_command_is_named_in_full(text: str) -> None:
    """Those of nested groups too."""
    missing = []
    for command in all_commands():
        for flag, option in options_of(command.config_class):
            if option.kind is str or "str" in str(option.kind):
                continue
            flags = [*required_flags(command.config_class), f"{flag}={text}"]
            try:
                parse_config(command.config_class, flags, command.prog)
            except EgovcpError as error:
                if flag not in str(error):
                    missing.append(f"{command.prog} {flag}={text}: {error}")
            else:
                missing.append(f"{command.prog} {flag}={text}: accepted")
    assert not missing, "\n".join(missing[:20])
