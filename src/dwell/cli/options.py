"""Options that several commands share."""

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
        If there are more.
    """
    from dwell.model.bounds import SEEDS

    _require(SEEDS, seeds)
    return seeds


def require_held(seconds: float | None) -> float | None:
    """Refuse a length that does not fit into 64 bits of nanoseconds.

    Raises
    ------
    typer.BadParameter
        If it does not fit.
    """
    from dwell.model.bounds import LENGTH_S

    _require(LENGTH_S, seconds)
    return seconds


def _require(bound: Bound, value: float | None) -> None:
    if value is not None and not bound.holds(value):
        shown = value if isinstance(value, int) else f"{value:g}"
        raise typer.BadParameter(f"{shown} is not allowed; it must be {bound}")


def option(metavar: str, sentence: str, *names: str, default: str = "", **more: Any) -> Any:
    """Return an option that takes a value, under the parameter's name or others.

    `default` describes a default that the command computes.
    """
    shown = f"{sentence} [default: {default}]" if default else sentence
    return typer.Option(*names, metavar=metavar, help=shown, **more)


def argument(metavar: str, sentence: str, **more: Any) -> Any:
    """Return an argument."""
    return typer.Argument(metavar=metavar, help=sentence, **more)


def flag(name: str, sentence: str, **more: Any) -> Any:
    """Return an option without a value."""
    return typer.Option(name, help=sentence, **more)


CellArgument = Annotated[Path, argument("CELL", "Cell file (YAML).")]
Node = Annotated[
    str,
    option("NAME", "This computer's node in the cell.", autocompletion=nodes),
]
Traces = Annotated[
    Path | None, option("FOLDER", "Folder of the trace files.", default="the cell's folder")
]
Scenario = Annotated[str, option("NAME", "Scenario of the cell.", autocompletion=scenarios)]
Policy = Annotated[
    str | None,
    option(
        "NAME",
        "Policy, such as dtp; policy and estimator, such as cusum+corrected; your own class, as "
        "package.module:Class; or a candidate, which never moves.",
        default="the cell's",
        autocompletion=policies,
    ),
]
Estimator = Annotated[
    str | None,
    option(
        "NAME",
        "Estimator, or your own class, as package.module:Class.",
        default="the cell's",
        autocompletion=estimators,
    ),
]
Seed = Annotated[
    int, option("S", "Seed of all random numbers; the same seed gives the same run.", min=0)
]
Windows = Annotated[int | None, option("N", "Length in windows, including the warm-up.", min=1)]
Seconds = Annotated[
    float | None,
    option("S", "Length in seconds, in place of --windows.", min=1, callback=require_held),
]
Processes = Annotated[int | None, option("N", "Number of processes.", default="one per CPU", min=1)]
Samples = Annotated[int, option("N", "Samples of each measurement.", min=1, max=1_000_000)]
Warmup = Annotated[
    int, option("N", "Rounds before the samples, not counted.", min=0, max=1_000_000)
]
Keys = Annotated[
    Path | None,
    option(
        "FOLDER",
        "Keyring, which encrypts and authenticates all connections.",
        envvar="DWELL_KEYS",
    ),
]
Insecure = Annotated[
    bool,
    flag(
        "--insecure",
        "Connect to other computers without keys, in a network that you trust.",
        envvar="DWELL_INSECURE",
    ),
]

TestbedName = Annotated[str, option("NAME", "Name of the testbed on this machine.", "--name")]
Json = Annotated[bool, flag("--json", "Print JSON on stdout.")]


def require_one_length(windows: int | None, seconds: float | None) -> None:
    """Refuse a length in windows and in seconds.

    Raises
    ------
    typer.BadParameter
        If both are given.
    """
    if windows is not None and seconds is not None:
        raise typer.BadParameter("--windows and --seconds: give one of them")


def windows_of_study(windows: int | None, seconds: float | None, *problems: Problem) -> int | None:
    """Return the length of a study's runs in windows; None if neither length is given.

    Raises
    ------
    typer.BadParameter
        If both are given, or the problems' windows differ in length.
    ProblemError
        If the runs are too long, or not longer than the warm-up.
    """
    require_one_length(windows, seconds)
    path = "--windows"
    if seconds is not None:
        path, windows = f"--seconds {seconds:g}", windows_of(seconds, *problems)
    if windows is not None:
        for problem in problems:
            problem.require_counted(windows, path)
    return windows


def windows_of(seconds: float, *problems: Problem) -> int:
    """Return the smallest number of windows, at least 1, that lasts `seconds`.

    Raises
    ------
    typer.BadParameter
        If the problems' windows differ in length.
    ProblemError
        If a run with this number of windows is too long.
    """
    from dwell.model.instants import require_length

    each_s = sorted({one.window_ms / 1e3 for one in problems})
    if len(each_s) > 1:
        lengths = ", ".join(f"{window_s:g}" for window_s in each_s)
        raise typer.BadParameter(
            f"--seconds {seconds:g}: the cells have windows of {lengths} s; give --windows"
        )
    windows = max(1, math.ceil(round(seconds / each_s[0], 9)))
    for problem in problems:
        period_ms = problem.pipeline.period_ms
        require_length(windows, problem.window_cycles, period_ms, f"--seconds {seconds:g}")
    return windows
