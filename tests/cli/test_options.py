"""Options that mean the same are called the same."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import click
import polars as pl
import pytest
import typer
import yaml

import dwell
from dwell.cli.commands import app
from dwell.cli.options import windows_of
from tests.cli.small_cell import CANONICAL, call

#: Options that mean the same wherever they are.
SHARED = (
    *("--scenario", "--scenarios", "--policy", "--policies", "--estimator", "--seed", "--seeds"),
    *("--windows", "--seconds", "--processes", "--samples", "--warmup", "--traces", "--json"),
    *("--cell", "--keys", "--insecure"),
)


def options(command: click.Command) -> Iterator[click.Option]:
    """Yield the options of a command and of all below it."""
    for one in command.params:
        if one.param_type_name == "option":
            yield cast(click.Option, one)
    for inner in getattr(command, "commands", {}).values():
        yield from options(inner)


def test_a_shared_option_takes_the_same_in_every_command() -> None:
    taken = defaultdict(set)
    for one in options(cast(click.Command, typer.main.get_command(app))):
        for name in one.opts:
            taken[name].add((one.metavar, one.is_flag, one.envvar))
    assert {name: taken[name] for name in SHARED if len(taken[name]) != 1} == {}


def test_no_command_takes_a_length_in_windows_or_seconds_alone_where_it_has_one_cell() -> None:
    root = cast(click.Group, typer.main.get_command(app))
    testbed = cast(click.Group, root.commands["testbed"])
    for command in (root.commands["run"], *map(testbed.commands.get, ("run", "campaign"))):
        assert command is not None
        assert {"--windows", "--seconds"} <= {name for one in options(command) for name in one.opts}


def test_seconds_are_whole_windows() -> None:
    problem = dwell.load(CANONICAL)
    window_s = problem.window_cycles * problem.pipeline.period_ms / 1e3
    assert windows_of(3 * window_s, problem) == 3
    assert windows_of(3.01 * window_s, problem, problem) == 4
    assert windows_of(window_s / 10, problem) == 1


def test_a_run_may_be_given_its_length_in_seconds(tmp_path: Path) -> None:
    problem = dwell.load(CANONICAL)
    seconds = str(4 * problem.window_cycles * problem.pipeline.period_ms / 1e3)
    words = ["run", str(CANONICAL), "--policy", "cusum+corrected", "--out", str(tmp_path / "run")]
    done = call(*words, "--seconds", seconds)
    assert done.exit_code == 0, done.output
    made = dwell.open_run(tmp_path / "run")
    assert made.meta["windows"] == 4
    assert (made.meta["estimator"], made.meta["policy"][:5]) == ("Corrected", "Cusum")
    both = call(*words, "--seconds", seconds, "--windows", "4")
    assert (both.exit_code, "give one of them" in both.stderr) == (2, True)


def test_a_study_may_be_given_its_length_in_seconds(tmp_path: Path) -> None:
    problem = dwell.load(CANONICAL)
    window_s = problem.window_cycles * problem.pipeline.period_ms / 1e3
    study = tmp_path / "study.yaml"
    study.write_text(
        yaml.safe_dump(
            {"dwell-study": 1, "name": "short", "cell": str(CANONICAL), "policies": ["LOC"]}
        )
    )
    words = ["study", str(study), "--seeds", "1", "--processes", "1"]
    words += ["--out", str(tmp_path / "out")]
    done = call(*words, "--seconds", str(6.5 * window_s))
    assert done.exit_code == 0, done.output
    runs = pl.read_parquet(tmp_path / "out" / "runs.parquet")
    assert set(runs["windows"]) == {7 - problem.warmup_windows}
    both = call(*words, "--seconds", "20", "--windows", "4")
    assert (both.exit_code, "give one of them" in both.stderr) == (2, True)


def test_seconds_of_windows_that_differ_in_length_are_refused(tmp_path: Path) -> None:
    told = {"dwell-study": 1, "name": "s", "cell": str(CANONICAL), "policies": ["LOC"]}
    study = tmp_path / "study.yaml"
    study.write_text(yaml.safe_dump({**told, "parameters": {"window_cycles": [100, 200]}}))
    refused = call("study", study, "--seconds", "20")
    assert refused.exit_code == 2
    assert (
        "--seconds 20: the cells have windows of 3.33333, 6.66667 s; give --windows"
        in refused.stderr
    )


@pytest.mark.parametrize(
    "words",
    [
        ("study", "no.yaml"),
        ("demo",),
        ("live", "run", str(CANONICAL)),
        ("testbed", "run", str(CANONICAL)),
        ("testbed", "campaign", str(CANONICAL)),
        ("testbed", "calibrate", str(CANONICAL), "--out", "o.yaml"),
    ],
)
def test_more_seconds_than_64_bits_of_nanoseconds_hold_are_refused(words: tuple[str, ...]) -> None:
    refused = call(*words, "--seconds", "1e15")
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert "'--seconds': 1e+15 is not allowed; it must be a number from 0 to 9.2e9" in (
        refused.stderr
    )


@pytest.mark.parametrize(
    "words", [("study", "no.yaml"), ("demo",), ("validate", "r", "--cell", "c")]
)
def test_more_seeds_than_a_study_has_are_refused(words: tuple[str, ...]) -> None:
    refused = call(*words, "--seeds", "1000000000000")
    assert refused.exit_code == 2
    assert "--seeds" in refused.stderr
    assert "from 1 to 100000" in refused.stderr


def test_an_estimator_that_is_named_twice_is_refused(tmp_path: Path) -> None:
    words = ["run", str(CANONICAL), "--policy", "cusum+corrected", "--estimator", "shadow"]
    refused = call(*words, "--out", str(tmp_path / "run"))
    assert refused.exit_code == 2
    assert "'cusum+corrected' names its estimator" in refused.stderr
