"""All commands. Each is declared in a light module, which imports the rest when it is called."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from dwell import __version__
from dwell.cli.candidates import candidates
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

#: Most characters of a command's line in the help.
SHORT = 64
#: Headings of the help, with their commands; the others follow under `Other`.
GROUPS = {
    "Simulate": ("new", "check", "candidates", "run", "study", "demo"),
    "See": ("report", "dash"),
    "Fleet": ("fleet",),
    "Live": ("live", "ros2", "keys", "doctor"),
    "Measure": ("profile", "testbed", "validate"),
}
EXAMPLES = """\
Examples:
  dwell run examples/first.yaml --scenario robot-cpu-stress
  dwell fleet capacity examples/fleet.yaml --policy SO --phases even
  dwell live run examples/live/cell.yaml --seconds 30
"""


class Commands(TyperGroup):
    """All commands. A user's error is printed and becomes an exit code."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands under their headings."""
        left = {name: one for name, one in self.commands.items() if not one.hidden}
        for heading, names in GROUPS.items():
            found = {name: left.pop(name) for name in names if name in left}
            _write_commands(formatter, heading, found)
        _write_commands(formatter, "Other", left)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples."""
        formatter.write(f"\n{EXAMPLES}")

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


class Command(TyperCommand):
    """A command whose help shows arguments by their names, without types and braces."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the line of usage."""
        pieces = super().collect_usage_pieces(ctx)
        return [piece.replace("{", "").replace("}", "") for piece in pieces]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options under their headings."""
        rows: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            name, text = record
            if parameter.param_type_name == "argument":
                rows["Arguments"].append((name.partition(" <")[0], text))
            else:
                rows["Options"].append((name, text))
        for heading, found in rows.items():
            if found:
                with formatter.section(heading):
                    formatter.write_dl(found)


def _write_commands(formatter: Any, heading: str, commands: Mapping[str, Any]) -> None:
    if commands:
        rows = [(name, one.get_short_help_str(SHORT)) for name, one in commands.items()]
        with formatter.section(heading):
            formatter.write_dl(rows)


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
        Path | None, argument("CELL", "Cell file; also check its ports, quotas and keys.")
    ] = None,
    keys: Keys = None,
    as_json: Json = False,
) -> None:
    """Check this computer; print a command for each missing part.

    The exit code is 1 if something is broken. A missing extra is not broken.
    """
    import dwell
    from dwell.cli.doctor import consult

    problem = None if cell is None else dwell.load(cell)
    if not consult(problem, keys=keys, as_json=as_json):
        raise typer.Exit(ExitCode.FAILED)


#: Commands of dwell-lab.
OF_LAB = ("testbed", "validate")

#: Commands that the help leaves out; `dwell live agent` and `dwell live controller` are in it.
HIDDEN = ("agent", "controller", "schema")

for command in (check, candidates, run, study, report, new, demo, doctor, completion):
    app.command()(command)
app.command(hidden=True)(schema)
app.add_typer(fleet, name="fleet")
for name, command in added(COMMANDS).items():
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=name)
    else:
        app.command(name, hidden=name in HIDDEN)(command)


def _use_plain_help(group: typer.Typer) -> None:
    for one in group.registered_commands:
        one.cls = Command
    for below in group.registered_groups:
        if below.typer_instance is not None:
            _use_plain_help(below.typer_instance)


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

_use_plain_help(app)
