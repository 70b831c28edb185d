"""Shell completion of subcommands, flags and values: ``egovcp-info --completion=bash``."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module, metadata
from shlex import quote
from typing import Literal

from egovcp.entry_point import EntryPoint

Shell = Literal["bash", "zsh", "fish"]

_BASH = """
_egovcp() {
    local words= cut= line=${COMP_LINE:0:COMP_POINT}; local word=${line##* }
    (( COMP_CWORD > 1 )) && words=$(_egovcp_words "${COMP_WORDS[0]##*/} ${COMP_WORDS[1]}")
    [[ -n $words ]] || words=$(_egovcp_words "${COMP_WORDS[0]##*/}")
    mapfile -t COMPREPLY < <(compgen -W "$words" -- "$word")
    [[ $word == *=* && $COMP_WORDBREAKS == *=* ]] && cut=${word%=*}=
    if (( ${#COMPREPLY[@]} )); then
        COMPREPLY=("${COMPREPLY[@]#"$cut"}")
        [[ ${COMPREPLY[0]} != *= ]] || compopt -o nospace
    elif [[ $word != -* || -n $cut ]]; then
        mapfile -t COMPREPLY < <(compgen -f -- "${word#"$cut"}")
        compopt -o filenames
    fi
} 2>/dev/null
complete -F _egovcp"""
_ZSH = """
_egovcp() {
    local list
    (( CURRENT > 2 )) && list=$(_egovcp_words "${words[1]:t} ${words[2]}")
    [[ -n $list ]] || list=$(_egovcp_words "${words[1]:t}")
    local -a open=(${(M)${=list}:#*=}) closed=(${${=list}:#*=})
    compadd -S '' -a open
    compadd -a closed
    (( compstate[nmatches] )) || { compset -P '*='; _files; }
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }
compdef _egovcp"""


def completion_script(shell: Shell) -> str:
    """The script; commands whose packages are missing are left out."""
    points = metadata.entry_points(group="console_scripts")
    commands = {p.name: p.load() for p in points if p.name.startswith("egovcp-")}
    programs = {name: c.module for name, c in commands.items() if isinstance(c, EntryPoint)}
    flags = [flag for name in sorted(programs) for flag in _flags(name, programs[name])]
    if shell == "fish":
        return "\n".join(_fish(flags))
    words: dict[str, list[str]] = {}
    for name, subcommand, flag, *choices in flags:
        if subcommand and subcommand not in words.setdefault(name, []):
            words[name].append(subcommand)
        own = words.setdefault(f"{name} {subcommand}".strip(), ["--help"])
        own += [f"{flag}={choice}" for choice in choices] or [f"{flag}="]
    cases = [f"    {quote(key)}) echo {quote(' '.join(own))};;" for key, own in words.items()]
    table = "\n".join(["_egovcp_words() {", 'case "$1" in', *cases, "esac", "}"])
    names = " ".join(dict.fromkeys(name for name, *_ in flags))
    return f"{table}{_BASH if shell == 'bash' else _ZSH} {names}"


def _flags(name: str, module: str) -> Iterator[list[str]]:
    """Command, subcommand or empty, flag, choices: as ``--help=flags`` lists them."""
    printed = io.StringIO()
    quiet = suppress(ModuleNotFoundError, SystemExit)
    with quiet, redirect_stdout(printed), redirect_stderr(io.StringIO()):
        import_module(module).main(["--help=flags"])
    for line in printed.getvalue().splitlines():
        yield [name, *([""] if line.startswith("-") else []), *line.split()]


def _fish(flags: Iterable[list[str]]) -> Iterator[str]:
    for name, subcommand in dict.fromkeys((name, sub) for name, sub, *_ in flags if sub):
        yield f"complete -c {name} -n __fish_use_subcommand -f -a {subcommand}"
    for name, subcommand, flag, *choices in flags:
        only = f" -n '__fish_seen_subcommand_from {subcommand}'" if subcommand else ""
        values = f" -x -a '{' '.join(choices)}'" if choices else " -r"
        yield f"complete -c {name}{only} -l {flag.removeprefix('--')}{values}"
