"""`dwell completion`: the shells' scripts, and the names that options take from a cell file.

Typer completes commands, options and choices, and leaves paths to the shell. Each
function here completes the value of an option, from the words before it and its beginning.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

#: Variable of the environment by which a shell's script asks what a line may become.
LINE = "_DWELL_COMPLETE"


class Shell(StrEnum):
    """The shells that have a script."""

    BASH = "bash"
    ZSH = "zsh"
    FISH = "fish"


def completion(
    context: typer.Context,
    shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")],
) -> None:
    """Print the completion script of bash, zsh or fish.

    Put `source <(dwell completion bash)` into ~/.bashrc, the same with zsh into ~/.zshrc after
    compinit, or `dwell completion fish | source` into ~/.config/fish/config.fish.
    """
    from typer.completion import show_callback

    show_callback(context, context.command.params[0], shell.value)


def learn_shells() -> None:
    """Have Typer answer the scripts, which it does by itself where it adds options of its own."""
    from typer.completion import get_completion_inspect_parameters

    get_completion_inspect_parameters()


def _cell(context: typer.Context) -> Mapping[str, Any]:
    """Return the content of the cell file that the line names, if it can be read."""
    from dwell.cellfile.document_faults import Faults
    from dwell.cellfile.yaml_text import read_yaml
    from dwell.errors import ProblemError

    given = context.params.get("of_cell") or context.params.get("cell")
    named = given if isinstance(given, list) else [given] if given else []
    # Arguments before an option without its value are not taken apart yet.
    for path in (*named, *context.args):
        with suppress(ProblemError):
            content = read_yaml(str(Path(path).expanduser()), Faults())
            if isinstance(content, dict):
                return content
    return {}


def _keys(section: str) -> Callable[[typer.Context], list[str]]:
    """Offer the keys of a section of the cell file."""

    def offered(context: typer.Context) -> list[str]:
        keys = _cell(context).get(section)
        return [key for key in keys if isinstance(key, str)] if isinstance(keys, dict) else []

    return offered


candidates, nodes = _keys("candidates"), _keys("nodes")


def with_old_cell(offered: Callable[[typer.Context], list[str]]) -> Callable[..., list[str]]:
    """Offer words for an argument CELL if the option --cell names the cell; paths otherwise."""

    def words(context: typer.Context) -> list[str]:
        return offered(context) if context.params.get("of_cell") else []

    return words


def scenarios(context: typer.Context) -> list[str]:
    """Offer the scenarios of the cell file and `baseline`."""
    return list(dict.fromkeys(["baseline", *_keys("scenarios")(context)]))


def estimators() -> list[str]:
    """Offer all estimators."""
    from dwell.estimators.registry import names

    return list(names())


def policies(context: typer.Context, incomplete: str) -> list[str]:
    """Offer policies and candidates; after a +, policies with their estimator."""
    from dwell.policies.registry import names

    policy, plus, _ = incomplete.partition("+")
    if plus:
        return [f"{policy}+{estimator}" for estimator in estimators()]
    return [*names(), *candidates(context)]


def several_scenarios(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the last of several scenarios with commas."""
    head, comma, _ = incomplete.rpartition(",")
    return [f"{head}{comma}{name}" for name in scenarios(context)]


def several_policies(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the last of several policies with commas."""
    head, comma, last = incomplete.rpartition(",")
    return [f"{head}{comma}{name}" for name in policies(context, last)]
