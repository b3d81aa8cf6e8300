"""Every command and its arguments; the work is imported where a command needs it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from dwell import __version__
from dwell.cli.completion import Shell, script
from dwell.cli.exit_codes import ExitCode
from dwell.cli.keys import keys
from dwell.cli.live import agent, controller, live
from dwell.cli.new import Origin
from dwell.cli.options import (
    CellArgument,
    Estimator,
    Insecure,
    Json,
    Keys,
    Policy,
    Processes,
    Scenario,
    Seconds,
    Seed,
    Traces,
    Windows,
    require_one_length,
    respelt,
    windows_of,
)
from dwell.cli.profile import profile
from dwell.cli.testbed import testbed
from dwell.errors import (
    DwellError,
    MetricError,
    PlacementError,
    PolicyError,
    ProblemError,
    ProfileError,
    RunError,
    TrustError,
    missing_package,
)

# A TraceError is a ProblemError.
MISTAKES = (
    ProblemError,
    PolicyError,
    PlacementError,
    MetricError,
    ProfileError,
    RunError,
    TrustError,
)


class Commands(TyperGroup):
    """All commands; an error that is meant for the user is printed and becomes an exit code."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments; old spellings of options work, with a warning."""
        return super().parse_args(ctx, respelt(args))

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the arguments name."""
        try:
            return super().invoke(ctx)
        except DwellError as error:
            located = isinstance(error, ProblemError) and error.source is not None
            typer.echo(str(error) if located else f"error: {error}", err=True)
            raise typer.Exit(
                ExitCode.WRONG if isinstance(error, MISTAKES) else ExitCode.FAILED
            ) from None
        except ModuleNotFoundError as error:
            missing = missing_package(error)
            if missing is None:
                raise
            typer.echo(f"error: {missing}", err=True)
            raise typer.Exit(ExitCode.FAILED) from None
        except BrokenPipeError:
            raise
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            typer.echo(f"error: {where}{error.strerror or error}", err=True)
            raise typer.Exit(ExitCode.FAILED) from None
        except MemoryError:
            typer.echo("error: not enough memory; ask for fewer windows", err=True)
            raise typer.Exit(ExitCode.FAILED) from None
        except KeyboardInterrupt:
            raise typer.Exit(ExitCode.INTERRUPTED) from None


app = typer.Typer(
    cls=Commands,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    no_args_is_help=True,
    help="Decide, while a robot control pipeline runs, on which computer each stage runs.",
)
app.add_typer(profile, name="profile")


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"dwell {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Options before any command."""


@app.command()
def check(
    cell: CellArgument,
    traces: Traces = None,
    node: Annotated[
        str | None,
        typer.Option(
            help="Check instead that this computer can be that node of the live cell: import and "
            "make its stages and actuators."
        ),
    ] = None,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Find every fault in a cell, or say what it amounts to.

    Faults go to stderr, one a line as file:line: path: message, and the exit code is 2. Warnings
    go there too, but do not change it.
    """
    from dwell.cli.check import check_cell

    if not check_cell(cell, traces, node=node, keys=keys, insecure=insecure, as_json=as_json):
        raise typer.Exit(ExitCode.WRONG)


@app.command()
def run(
    cell: CellArgument,
    scenario: Scenario = "baseline",
    policy: Policy = None,
    estimator: Estimator = None,
    seed: Seed = 1,
    windows: Windows = None,
    seconds: Seconds = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Where to save the run; runs/CELL-SCENARIO-POLICY-SEED if not given.",
        ),
    ] = None,
    traces: Traces = None,
    jobs: Annotated[bool, typer.Option("--jobs", help="Keep every job's instants.")] = False,
    guard: Annotated[
        bool, typer.Option("--guard", help="Let the robots' guard move to a fallback by itself.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace another run in the folder.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Simulate a policy on a scenario, save the run, sum it up.

    300 windows, if neither --windows nor --seconds is given.
    """
    import dwell
    from dwell.cli.first_answer import prepare

    require_one_length(windows, seconds)
    problem = dwell.load(cell, traces=traces)
    if seconds is not None:
        windows = windows_of(seconds, problem)
    windows = windows or 300
    how = prepare(windows * problem.window_cycles)
    # Imports the kernels.
    from dwell.cli.run import run_cell

    saved = run_cell(
        problem,
        scenario=scenario,
        policy=policy,
        estimator=estimator,
        seed=seed,
        windows=windows,
        out=out,
        jobs=jobs,
        guard=guard,
        force=force,
        how=how,
        as_json=as_json,
    )
    if not saved:
        raise typer.Exit(ExitCode.FAILED)


@app.command()
def study(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Study file (YAML)."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Where parts and tables go; studies/NAME if not given."
        ),
    ] = None,
    processes: Processes = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Scheduler of a Dask cluster that does the work."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Seeds 1 to N of every run; the file's if not given."
        ),
    ] = None,
    windows: Windows = None,
    seconds: Seconds = None,
    # Options of what was `dwell study paper`; they say where that is.
    quick: Annotated[bool, typer.Option("--quick", hidden=True)] = False,
    chapter: Annotated[list[str] | None, typer.Option(hidden=True)] = None,
    real: Annotated[Path | None, typer.Option(hidden=True)] = None,
    examples: Annotated[Path | None, typer.Option(hidden=True)] = None,
    as_json: Json = False,
) -> None:
    """Simulate every scenario, policy, parameter and seed of a study.

    What is finished stays in the folder, whatever ends the work: the same command goes on. Runs are
    as long as the file says, if neither --windows nor --seconds is given.
    """
    if str(file) == "paper" or quick or chapter or real or examples:
        raise typer.BadParameter(
            "`dwell study paper` is now `make paper`, in the folder of Dwell's sources "
            "(reproduction/README.md)"
        )
    from dwell.cli.study import run_study_file

    require_one_length(windows, seconds)
    run_study_file(
        file,
        out=out,
        processes=processes,
        dask=dask,
        seeds=seeds,
        windows=windows,
        seconds=seconds,
        as_json=as_json,
    )


@app.command()
def report(
    folder: Annotated[
        Path,
        typer.Argument(metavar="FOLDER", help="Of a saved run, of a study, or of a campaign."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Page to write [default: FOLDER/report.html]."),
    ] = None,
    trace: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write every job as a trace for Perfetto; the run must have kept its jobs.",
        ),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Also write figures and tables for a paper: PDF, SVG, LaTeX, CSV.",
        ),
    ] = None,
    static: Annotated[
        bool, typer.Option("--static", help="A page without scripts: nothing to hover or choose.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write the report of a run, a study or a campaign: one HTML file that needs nothing else."""
    from dwell.cli.report import report_folder

    page = out or folder / "report.html"
    report_folder(folder, page, trace=trace, figures=figures, static=static, as_json=as_json)


@app.command()
def validate(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Folders of runs that were measured.")
    ],
    cell: Annotated[Path, typer.Option(metavar="FILE", help="Calibrated cell file (YAML).")],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Where page and table go; validations/CELL if not given."
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=2, metavar="N", help="Seeds 1 to N of every run.")] = 20,
    calibrated_from: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="A run that the cell was calibrated from, besides those that the file "
            "CELL.calibration.json beside it names; may be repeated.",
        ),
    ] = None,
    traces: Traces = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Set what a calibrated cell predicts beside what its runs measured, and judge it."""
    from dwell.cli.validate import validate_runs

    validate_runs(
        runs,
        cell,
        out=out,
        seeds=seeds,
        traces=traces,
        calibrated_from=calibrated_from or (),
        processes=processes,
        as_json=as_json,
    )


@app.command()
def new(
    name: Annotated[Path, typer.Argument(metavar="NAME", help="Folder to make.")],
    origin: Annotated[
        Origin, typer.Option("--from", help="Example to begin as: simulated, or live.")
    ] = Origin.CANONICAL,
) -> None:
    """Make a folder with a cell of your own: cell.yaml, policy.py, stages.py, test_cell.py.

    All of it works as it is; comments say what to change.
    """
    from dwell.cli.new import new_cell

    new_cell(name, origin)


@app.command()
def schema(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="What to write; cell.schema.json if not given."),
    ] = None,
    write: Annotated[
        bool, typer.Option("--write", help="Write it, for an editor, instead of printing it.")
    ] = False,
) -> None:
    """Print the JSON Schema of the cell file, or write it."""
    from dwell.cli.schema import SCHEMA_FILE, schema_text, write_schema

    if write:
        write_schema(file or Path(SCHEMA_FILE))
    elif file is not None:
        raise typer.BadParameter(f"say --write to write {file}")
    else:
        typer.echo(schema_text(), nl=False)


@app.command()
def demo(
    real: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Replay the measurements in this folder instead."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, metavar="N", help="Seeds 1 to N of every run.")] = 20,
    windows: Windows = None,
    seconds: Seconds = None,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where report.html goes.")] = Path(
        "demo-out"
    ),
    examples: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the example cells are, if not found."),
    ] = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Compare all policies in all scenarios of an example, and write the report.

    Runs are 150 windows long, if neither --windows nor --seconds is given.
    """
    from dwell.cli.demo import run_demo

    require_one_length(windows, seconds)
    run_demo(
        real,
        seeds=seeds,
        windows=windows,
        seconds=seconds,
        out=out,
        examples=examples,
        processes=processes,
        as_json=as_json,
    )


@app.command()
def doctor(
    cell: Annotated[
        Path | None,
        typer.Argument(metavar="CELL", help="Cell file whose ports, quotas and keys to look at."),
    ] = None,
    keys: Keys = None,
    clear_cache: Annotated[
        bool, typer.Option("--clear-cache", help="Remove the compiled simulator.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say what this computer has for Dwell and what it lacks, with the line that mends it.

    Compiled simulators of older versions are removed. The exit code is 1 where something is broken;
    an extra that is not installed is not.
    """
    import dwell
    from dwell.cli.doctor import consult

    problem = None if cell is None else dwell.load(cell)
    if not consult(problem, keys=keys, clear_cache=clear_cache, as_json=as_json):
        raise typer.Exit(ExitCode.FAILED)


@app.command()
def completion(
    shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")],
) -> None:
    """Print the script that has a shell complete commands, options and their values.

    Read it where your shell begins: source <(dwell completion bash) in ~/.bashrc, the same with zsh
    in ~/.zshrc after compinit, dwell completion fish | source in ~/.config/fish/config.fish.
    """
    typer.echo(script(shell), nl=False)


app.command()(agent)
app.command()(controller)
app.add_typer(live, name="live")
app.add_typer(keys, name="keys")
app.add_typer(testbed, name="testbed")
