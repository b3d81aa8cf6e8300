"""Options that several commands have: one spelling, one meaning, declared once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dwell.cli.completion import estimators, nodes, policies, scenarios

if TYPE_CHECKING:
    from dwell.model import Problem
    from dwell.model.bounds import Bound


def require_few(seeds: int | None) -> int | None:
    """Refuse more seeds than a study may have.

    Raises
    ------
    typer.BadParameter
        If they are more.
    """
    from dwell.model.bounds import SEEDS

    _require(SEEDS, seeds)
    return seeds


def require_held(seconds: float | None) -> float | None:
    """Refuse a length that 64 bits of nanoseconds do not hold.

    Raises
    ------
    typer.BadParameter
        If they do not.
    """
    from dwell.model.bounds import LENGTH_S

    _require(LENGTH_S, seconds)
    return seconds


def _require(bound: Bound, value: float | None) -> None:
    if value is not None and not bound.holds(value):
        shown = value if isinstance(value, int) else f"{value:g}"
        raise typer.BadParameter(f"{shown} is not allowed; it must be {bound}")


def option(metavar: str, sentence: str, *names: str, **more: Any) -> Any:
    """Return an option that takes a value, under the parameter's name or others."""
    return typer.Option(*names, metavar=metavar, help=sentence, **more)


def argument(metavar: str, sentence: str, **more: Any) -> Any:
    """Return an argument."""
    return typer.Argument(metavar=metavar, help=sentence, **more)


def flag(name: str, sentence: str, **more: Any) -> Any:
    """Return an option that is there or not."""
    return typer.Option(name, help=sentence, **more)


CellArgument = Annotated[Path, argument("CELL", "Cell file (YAML).")]
Node = Annotated[
    str,
    typer.Option(help="Node of the cell that this computer is.", autocompletion=nodes),
]
Traces = Annotated[
    Path | None, option("FOLDER", "Where its trace files are; beside it if not given.")
]
Scenario = Annotated[str, option("NAME", "One of the cell's scenarios.", autocompletion=scenarios)]
Policy = Annotated[
    str | None,
    option(
        "NAME",
        "A policy, as dtp, or with its estimator, as cusum+corrected; a class of your own, as "
        "package.module:Class, beside the cell file or installed; or a candidate's name for the "
        "placement that never moves; what the cell says if not given.",
        autocompletion=policies,
    ),
]
Estimator = Annotated[
    str | None,
    option(
        "NAME",
        "An estimator, or a class of your own, as package.module:Class; what the cell says if "
        "not given.",
        autocompletion=estimators,
    ),
]
Seed = Annotated[
    int, option("S", "Seed of all that is drawn; one seed, one course of events.", min=0)
]
Windows = Annotated[int | None, option("N", "Length in windows, the warm-up included.", min=1)]
Seconds = Annotated[
    float | None,
    option("S", "Length in seconds instead, the warm-up included.", min=1, callback=require_held),
]
Processes = Annotated[int | None, option("N", "How many to use; one a CPU if not given.", min=1)]
Samples = Annotated[int, option("N", "Samples of each measurement.", min=1, max=1_000_000)]
Warmup = Annotated[
    int, option("N", "Rounds before the samples that are left out.", min=0, max=1_000_000)
]
Keys = Annotated[
    Path | None,
    option(
        "FOLDER",
        "Keyring: all connections are encrypted and authenticated with it.",
        envvar="DWELL_KEYS",
    ),
]
Insecure = Annotated[
    bool,
    flag(
        "--insecure",
        "Without keys: leave this computer all the same, in a network that you trust.",
        envvar="DWELL_INSECURE",
    ),
]

TestbedName = Annotated[
    str, typer.Option("--name", help="Of the testbed, among others on this machine.")
]
Json = Annotated[bool, flag("--json", "Print JSON on stdout.")]


def require_one_length(windows: int | None, seconds: float | None) -> None:
    """Refuse a length that is given twice.

    Raises
    ------
    typer.BadParameter
        If it is.
    """
    if windows is not None and seconds is not None:
        raise typer.BadParameter("--windows and --seconds: give one of them")


def windows_of(seconds: float, *problems: Problem) -> int:
    """Return the least number of whole windows that last so many seconds, at least 1.

    Raises
    ------
    typer.BadParameter
        If the problems' windows have not all the same length.
    ProblemError
        If they are more than a run may have.
    """
    from dwell.model.instants import require_length

    each_s = sorted({one.window_ms / 1e3 for one in problems})
    if len(each_s) > 1:
        lengths = ", ".join(f"{window_s:g}" for window_s in each_s)
        raise typer.BadParameter(
            f"--seconds {seconds:g}: windows last {lengths} s here; give --windows"
        )
    windows = max(1, math.ceil(round(seconds / each_s[0], 9)))
    for problem in problems:
        period_ms = problem.pipeline.period_ms
        require_length(windows, problem.window_cycles, period_ms, f"--seconds {seconds:g}")
    return windows
