"""All commands: each is declared in a light module, which imports its work when it is called."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from dwell import __version__
from dwell.cli.check import check
from dwell.cli.completion import completion
from dwell.cli.demo import demo
from dwell.cli.fleet import fleet
from dwell.cli.new import new
from dwell.cli.options import Json, Keys, argument
from dwell.cli.report import report
from dwell.cli.run import run
from dwell.cli.schema import schema
from dwell.cli.study import study
from dwell.errors import INSTALL_LAB, ExitCode, MissingPartError, line_and_code
from dwell.model.entry_points import COMMANDS, added


class Commands(TyperGroup):
    """All commands; an error that is meant for the user is printed and becomes an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the arguments name."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise
        except MemoryError:
            typer.echo("error: not enough memory; ask for fewer windows", err=True)
            raise typer.Exit(ExitCode.FAILED) from None
        except Exception as error:
            known = line_and_code(error)
            if known is None:
                raise
            line, code = known
            typer.echo(line, err=True)
            raise typer.Exit(code) from None
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


def doctor(
    cell: Annotated[
        Path | None, argument("CELL", "Cell file whose ports, quotas and keys to look at.")
    ] = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Say what this computer has for Dwell and what it lacks, with the line that mends it.

    The exit code is 1 where something is broken; an extra that is not installed is not.
    """
    import dwell
    from dwell.cli.doctor import consult

    problem = None if cell is None else dwell.load(cell)
    if not consult(problem, keys=keys, as_json=as_json):
        raise typer.Exit(ExitCode.FAILED)


#: Commands of dwell-lab.
OF_LAB = ("testbed", "validate")

for command in (check, run, study, report, new, schema, demo, doctor, completion):
    app.command()(command)
app.add_typer(fleet, name="fleet")
for name, command in added(COMMANDS).items():
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=name)
    else:
        app.command(name)(command)


def _missing(name: str) -> Callable[[], None]:
    def command() -> None:
        raise MissingPartError(f"dwell {name} needs dwell-lab; {INSTALL_LAB}")

    return command


for name in set(OF_LAB) - added(COMMANDS).keys():
    settings = {
        "allow_extra_args": True,
        "help_option_names": [],
        "ignore_unknown_options": True,
    }
    app.command(name, hidden=True, context_settings=settings)(_missing(name))
