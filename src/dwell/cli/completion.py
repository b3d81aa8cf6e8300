"""`dwell completion`: what a shell may put at the end of a command line, and the shells' scripts.

A script runs `dwell` with the line so far in the environment (`LINE`), which prints one word a
line, each with a tab and its help, or `FILES` alone where the shell completes paths by itself.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

#: Variable of the environment with the line up to the cursor.
LINE = "DWELL_COMPLETE"


class Shell(StrEnum):
    """The shells that have a script."""

    BASH = "bash"
    ZSH = "zsh"
    FISH = "fish"


#: Stands alone for: paths, as the shell completes them.
FILES = ":files"
#: How helps call values that are paths.
PATHS = ("CELL", "CELL...", "[CELL]", "FILE", "FILE...", "FOLDER", "RUN", "RUN...")
#: A cell, a study and a folder of results each have a mark in their first bytes, or a file.
HEAD_BYTES = 10_000
RESULTS = ("run.json", "study.json", "campaign.json")

BASH = r"""
_dwell() {
    local line="${COMP_LINE:0:COMP_POINT}" cur="${COMP_WORDS[COMP_CWORD]}" kept='' words=() value
    mapfile -t words < <(DWELL_COMPLETE="$line" "$1" 2>/dev/null)
    COMPREPLY=()
    if [[ ${words[0]-} == :files ]]; then
        compopt -o default
        return
    fi
    # Bash ends words at = and :, too, and replaces only what follows the last.
    [[ $cur == [=:] ]] && cur=''
    line="${line##*[[:space:]]}"
    [[ $line == *"$cur" ]] && kept="${line%"$cur"}"
    for value in "${words[@]%%$'\t'*}"; do
        [[ $value == */ ]] && compopt -o nospace
        printf -v value %q "${value#"$kept"}"
        COMPREPLY+=("$value")
    done
}
complete -F _dwell dwell
"""
ZSH = r"""
#compdef dwell
_dwell() {
    local line="${(j: :)words[1,CURRENT-1]} $PREFIX" found value
    local -a told folders
    for found in "${(@f)$(DWELL_COMPLETE="$line" ${words[1]} 2>/dev/null)}"; do
        value="${found%%$'\t'*}"
        found="${found:${#value}}"
        if [[ $value == :files ]]; then
            _files
            return
        elif [[ $value == */ ]]; then
            folders+=("$value")
        elif [[ -n $value ]]; then
            told+=("${value//:/\\:}${found/$'\t'/:}")
        fi
    done
    (($#folders)) && compadd -S '' -- "${folders[@]}"
    (($#told)) && _describe dwell told
}
if [[ $funcstack[1] == _dwell ]]; then _dwell "$@"; else compdef _dwell dwell; fi
"""
FISH = r"""
function __dwell_complete
    set -lx DWELL_COMPLETE (commandline -cp | string collect)
    set -l words (commandline -opc)
    set -l found ($words[1] 2>/dev/null)
    if test "$found" = :files
        __fish_complete_path (commandline -ct)
    else
        printf '%s\n' $found
    end
end
complete --command dwell --no-files --keep-order --arguments '(__dwell_complete)'
"""


def completion(
    shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")],
) -> None:
    """Print the script that has a shell complete commands, options and their values.

    Read it where your shell begins: source <(dwell completion bash) in ~/.bashrc, the same with zsh
    in ~/.zshrc after compinit, dwell completion fish | source in ~/.config/fish/config.fish.
    """
    typer.echo(script(shell), nl=False)


def script(shell: Shell) -> str:
    """Return the script that has a shell complete the words of `dwell`."""
    return {Shell.BASH: BASH, Shell.ZSH: ZSH, Shell.FISH: FISH}[shell].lstrip("\n")


def answer(line: str) -> None:
    """Print what the last word of a line may become, for a script."""
    from dwell.cli.commands import app

    for value, about in completions(typer.main.get_command(app), line):
        typer.echo(f"{value}\t{about}" if about else value)


# ------------------------------------------------------------------------- the line so far


@dataclass(slots=True)
class _Line:
    """The words of a line before its last.

    Parameters
    ----------
    command : click.Command
        The innermost that is named.
    given : dict of str to list of str
        Values by the name of their parameter.
    waiting : click.Option, optional
        The option whose value comes next.
    """

    command: Any
    given: dict[str, list[str]] = field(default_factory=dict)
    waiting: Any = None
    only_arguments: bool = False

    def take(self, word: str) -> bool:
        """Read a word; return whether it makes sense here."""
        if self.waiting is not None:
            self.give(self.waiting, word)
            self.waiting = None
        elif word == "--" and not self.only_arguments:
            self.only_arguments = True
        elif word.startswith("-") and not self.only_arguments:
            name, equals, value = word.partition("=")
            option = self.option(name)
            if option is None:
                return False
            if equals or option.is_flag:
                self.give(option, value)
            else:
                self.waiting = option
        elif (commands := self.commands()) is not None:
            if word not in commands:
                return False
            self.command = commands[word]
        elif (argument := self.argument()) is not None:
            self.give(argument, word)
        return True

    def give(self, parameter: Any, value: str) -> None:
        self.given.setdefault(parameter.name, []).append(value)

    def parameters(self, kind: str) -> list[Any]:
        return [known for known in self.command.params if known.param_type_name == kind]

    def option(self, name: str) -> Any:
        return next((known for known in self.parameters("option") if name in known.opts), None)

    def argument(self) -> Any:
        """Return the argument whose turn it is."""
        arguments = self.parameters("argument")
        return next((a for a in arguments if a.nargs == -1 or a.name not in self.given), None)

    def commands(self) -> Mapping[str, Any] | None:
        commands: Mapping[str, Any] | None = getattr(self.command, "commands", None)
        return commands

    def cell(self) -> Mapping[str, Any]:
        """Return the content of the cell file that the line names, if it can be read."""
        from dwell.cellfile.document_faults import Faults
        from dwell.cellfile.yaml_text import read_yaml

        for path in self.given.get("cell", ()):
            content = read_yaml(str(Path(path).expanduser()), Faults())
            if isinstance(content, dict):
                return content
        return {}

    def keys(self, section: str) -> list[str]:
        """Return the keys of a section of the cell file."""
        keys = self.cell().get(section)
        return [key for key in keys if isinstance(key, str)] if isinstance(keys, dict) else []


def completions(root: Any, text: str) -> list[tuple[str, str]]:
    """Return what the last word of a line may become, each with its help.

    Parameters
    ----------
    root : click.Group
        All commands.
    text : str
        The line up to the cursor, from the name of the program on.
    """
    *before, last = _words(text)[1:] or [""]
    line = _Line(root)
    if not all(map(line.take, before)):
        return []
    if line.waiting is not None:
        return _values(line, line.waiting, last)
    if last.startswith("-") and not line.only_arguments:
        name, equals, begun = last.partition("=")
        option = line.option(name)
        if equals and option is not None and not option.is_flag:
            values = _values(line, option, begun)
            return [(f"{name}={value}", about) for value, about in values if value != FILES]
        return _beginning(last, _option_names(line))
    if (commands := line.commands()) is not None:
        visible = [(name, known) for name, known in commands.items() if not known.hidden]
        return _beginning(last, [(name, known.get_short_help_str(70)) for name, known in visible])
    argument = line.argument()
    return [] if argument is None else _values(line, argument, last)


def _words(text: str) -> list[str]:
    """Split a line as a shell does, whose last word may be within quotes yet."""
    words = text.split()
    for quote in ("", '"', "'"):
        with suppress(ValueError):
            words = shlex.split(f"{text}{quote}")
            break
    else:
        quote = ""
    return [*words, ""] if not quote and text[-1:].isspace() else words


def _beginning(begun: str, offers: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    return [(value, " ".join(about.split())) for value, about in offers if value.startswith(begun)]


def _option_names(line: _Line) -> list[tuple[str, str]]:
    visible = [known for known in line.parameters("option") if not known.hidden]
    free = [known for known in visible if known.multiple or known.name not in line.given]
    names = [(known.opts[0], known.help or "") for known in free]
    return [*names, ("--help", "Show this message and exit.")]


# ------------------------------------------------------------------------- values


def _values(line: _Line, parameter: Any, begun: str) -> list[tuple[str, str]]:
    """Return the values that a parameter may have."""
    if parameter.hidden:
        return []
    is_path = parameter.metavar in PATHS
    if is_path and begun.startswith("~"):
        return [(FILES, "")]
    for name in (f"{line.command.name} {parameter.name}", parameter.name):
        if name in OFFERS:
            return _beginning(begun, [(value, "") for value in OFFERS[name](line, begun)])
    return [(FILES, "")] if is_path else []


#: Makes the values that are offered for a word, by the line before it and how it begins.
Offer = Callable[[_Line, str], Iterable[str]]


def _scenarios(line: _Line, begun: str) -> list[str]:
    return list(dict.fromkeys(["baseline", *line.keys("scenarios")])) if line.cell() else []


def _estimators(line: _Line, begun: str) -> Sequence[str]:
    from dwell.estimators.registry import names

    return names()


def _policies(line: _Line, begun: str) -> list[str]:
    """Return policies and candidates; once a + is there, policies with their estimator."""
    from dwell.policies.registry import names

    policy, plus, _ = begun.partition("+")
    if plus:
        return [f"{policy}+{estimator}" for estimator in _estimators(line, "")]
    return [*names(), *line.keys("candidates")]


def _several(offer: Offer) -> Offer:
    """Offer the last of several names with commas."""

    def offered(line: _Line, begun: str) -> list[str]:
        head, comma, last = begun.rpartition(",")
        return [f"{head}{comma}{value}" for value in offer(line, last)]

    return offered


def _paths(wanted: Callable[[Path], bool]) -> Offer:
    """Offer the wanted paths, and the folders on the way to others."""

    def offered(_: _Line, begun: str) -> Iterator[str]:
        folder, slash, name = begun.rpartition("/")
        with suppress(OSError):
            for entry in sorted(Path(f"{folder}{slash}" or ".").expanduser().iterdir()):
                shown = name.startswith(".") or not entry.name.startswith(".")
                if not entry.name.startswith(name) or not shown:
                    continue
                if wanted(entry):
                    yield f"{folder}{slash}{entry.name}"
                elif entry.is_dir():
                    yield f"{folder}{slash}{entry.name}/"

    return offered


def _files_with(key: str) -> Offer:
    """Offer YAML files that begin with a key."""

    def wanted(path: Path) -> bool:
        if path.suffix not in (".yaml", ".yml") or not path.is_file():
            return False
        with suppress(OSError), path.open("rb") as file:
            lines = file.read(HEAD_BYTES).splitlines()
            return any(line.startswith(key.encode()) for line in lines)
        return False

    return _paths(wanted)


def _logged(line: _Line, begun: str) -> list[str]:
    from dwell.live.state_folder import logs, state_root

    return list(logs(state_root(*map(Path, line.given.get("state", ())))))


#: Folders of runs, studies and campaigns.
_results = _paths(lambda path: any((path / name).is_file() for name in RESULTS))

#: The offers for a parameter, by its name, or by its command's and its own.
OFFERS: Mapping[str, Offer] = {
    "cell": _files_with("dwell:"),
    "cells": _files_with("dwell:"),
    "study file": _files_with("dwell-study:"),
    "report folder": _results,
    "runs": _results,
    "calibrated_from": _results,
    "scenario": _scenarios,
    "scenarios": _several(_scenarios),
    "policy": _policies,
    "policies": _several(_policies),
    "estimator": _estimators,
    "candidate": lambda line, _: line.keys("candidates"),
    "node": lambda line, _: line.keys("nodes"),
    "log process": _logged,
    "new origin": lambda *_: ("canonical", "live"),
    "shell": lambda *_: tuple(Shell),
}
