"""`dwell agent`, `dwell controller` and `dwell live`: cells of real processes."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dwell.cli.completion import candidates, nodes, scenarios, with_old_cell
from dwell.cli.options import (
    CellArgument,
    Estimator,
    Insecure,
    Json,
    Keys,
    Node,
    Policy,
    Seed,
    argument,
    flag,
    option,
    require_held,
)
from dwell.cli.output import json_text, print_json, proof
from dwell.errors import ExitCode
from dwell.live.commands.log_format import LogFormat, Logs, begin_log
from dwell.live.host.state_folder import state_root

if TYPE_CHECKING:
    from dwell.live.host.operator_client import OperatorClient

#: Period of ``status --watch``.
WATCH_S = 1.0
#: Longest wait for the end of a requested move.
MOVES_S = 3.0

Cpus = Annotated[
    str | None, option("LIST", "CPUs to use, such as 0,2-3.", default="this process's")
]

Owner = Annotated[int | None, option("PID", "End with this process.", hidden=True)]

Cell = Annotated[Path | None, argument("CELL", "Cell file (YAML).")]
#: With it, the first argument is the candidate, node or process.
OldCell = Annotated[Path | None, option("FILE", "Cell file (YAML).", "--cell", hidden=True)]


def _first(offered: Any) -> Any:
    """Return the argument CELL of a command with a word after it."""
    return argument("CELL", "Cell file (YAML).", autocompletion=with_old_cell(offered))


def _second(metavar: str, sentence: str, offered: Any) -> Any:
    return argument(metavar, sentence, autocompletion=offered)


live = typer.Typer(no_args_is_help=True, help="Run live cells; show and steer them.")


def agent(
    node: Node,
    cell: Cell = None,
    of_cell: OldCell = None,
    state: Annotated[
        Path | None,
        option("FOLDER", "Folder for the files of processes.", default="below ~/.local"),
    ] = None,
    cpus: Cpus = None,
    cpus_of: Annotated[
        list[str] | None,
        option("PROCESS=LIST", "CPUs of processes, such as perception@*=2-3; may be repeated."),
    ] = None,
    realtime: Annotated[
        list[str] | None,
        option(
            "PROCESS=PRIORITY",
            "SCHED_FIFO priority of processes, such as sink.*=20; may be repeated.",
        ),
    ] = None,
    accelerator: Annotated[
        str | None,
        option(
            "MODULE:FUNCTION",
            "Function returning the utilisation of the accelerator (0 to 1).",
        ),
    ] = None,
    keys: Keys = None,
    insecure: Insecure = False,
    log_format: Logs = LogFormat.TEXT,
    owner: Owner = None,
    renews: Annotated[
        bool, typer.Option("--renews", help="Restart the processes that it finds.", hidden=True)
    ] = False,
) -> None:
    """Run a node of a live cell: each stage in a process."""
    from dwell.live.host import node_command

    begin_log(log_format, f"agent@{node}")
    with _bad_parameters():
        node_command.agent(
            node,
            _the_cell(cell, of_cell),
            state=state,
            cpus=cpus,
            cpus_of=cpus_of or (),
            realtime=realtime or (),
            accelerator=accelerator,
            keys=keys,
            insecure=insecure,
            owner=owner,
            renews=renews,
        )


def controller(
    cell: Annotated[list[Path] | None, argument("CELL", "Cell files (YAML).")] = None,
    of_cell: Annotated[
        list[Path] | None, option("FILE", "Cell file (YAML).", "--cell", hidden=True)
    ] = None,
    out: Annotated[Path, option("FOLDER", "Folder for the runs.")] = Path("runs"),
    state: Annotated[
        Path | None,
        option("FOLDER", "Folder for the cell file in use.", default="below ~/.local"),
    ] = None,
    policy: Policy = None,
    name: Annotated[
        str | None, option("NAME", "Name of this controller.", default="its process id")
    ] = None,
    jobs: Annotated[
        bool,
        typer.Option(
            envvar="DWELL_JOBS",
            help="Keep every job, and the CPU time of each process, in the runs.",
        ),
    ] = False,
    cpus: Cpus = None,
    keys: Keys = None,
    insecure: Insecure = False,
    log_format: Logs = LogFormat.TEXT,
    owner: Owner = None,
    continues: Annotated[str, option("JSON", "Runs to continue.", hidden=True)] = "{}",
) -> None:
    """Decide where the stages of live cells run; record it."""
    from dwell.live.host import node_command

    begin_log(log_format, "controller")
    with _bad_parameters():
        node_command.controller(
            [_the_cell(one, None) for one in (*(cell or ()), *(of_cell or ())) or [None]],
            out,
            state=state,
            policy=policy,
            name=name,
            jobs=jobs,
            cpus=cpus,
            keys=keys,
            insecure=insecure,
            owner=owner,
            continues=continues,
        )


@contextmanager
def _bad_parameters() -> Iterator[None]:
    """Report an invalid option together with the command's usage."""
    from dwell.live.host.node_command import OptionError

    try:
        yield
    except OptionError as error:
        raise typer.BadParameter(str(error)) from None


live.command()(agent)
live.command()(controller)


def _the_cell(cell: Path | None, of_cell: Path | None) -> Path:
    """Return the cell file, given as an argument or by the hidden option --cell."""
    if cell is not None and of_cell is not None:
        raise typer.BadParameter(f"name one cell, {cell} or {of_cell}")
    if (found := cell or of_cell) is None:
        raise typer.BadParameter("missing argument CELL")
    return found


def _cell_and(
    name: str, cell: Path | None, word: str | None, of_cell: Path | None
) -> tuple[Path, str]:
    """Return the cell file and the required word after it (see `_cell_or`)."""
    found, word = _cell_or(cell, word, of_cell)
    if word is None:
        raise typer.BadParameter(f"missing argument {name}")
    return found, word


def _cell_or(cell: Path | None, word: str | None, of_cell: Path | None) -> tuple[Path, str | None]:
    """Return the cell file and the word after it, which is the first argument with --cell."""
    if of_cell is not None and word is None and cell is not None:
        cell, word = None, str(cell)
    return _the_cell(cell, of_cell), word


@live.command()
def check(
    cell: CellArgument,
    node: Node,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Check that this computer can be a node of a live cell."""
    import dwell
    from dwell.live.commands.check_node import check_node

    if not check_node(dwell.load(cell), cell, node, keys, insecure=insecure, as_json=as_json):
        raise typer.Exit(ExitCode.WRONG)


@live.command()
def status(
    cell: Cell = None,
    of_cell: OldCell = None,
    check: Annotated[bool, flag("--check", "Exit with 1 unless the cell's health is ok.")] = False,
    watch: Annotated[
        bool, flag("--watch", "Repeat every second; with --json, one line each time.")
    ] = False,
    stages: Annotated[
        bool, flag("--stages", "Also show times of stages and counts of flows.")
    ] = False,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Show the state of a cell, faults first."""
    if check and watch:
        raise typer.BadParameter("--check looks once; leave --watch out")
    from dwell.live.host.kept_cell import cell_here
    from dwell.live.host.operator_client import OperatorClient
    from dwell.live.host.security import environment
    from dwell.live.wire.local_addresses import running_elsewhere

    problem = cell_here(_the_cell(cell, of_cell), state_root()).problem()
    with OperatorClient(problem, environment(keys, insecure=insecure)) as visitor:
        if watch:
            _watch(visitor, stages=stages, as_json=as_json)
        answer = visitor.look()
    absent = answer["health"] == "absent"
    if as_json:
        print_json(answer)
    elif absent:
        typer.echo(f"error: {answer['headline']} {running_elsewhere(problem)}".rstrip(), err=True)
    else:
        typer.echo("\n".join(status_lines(answer, stages=stages)))
    if absent or (check and answer["health"] != "ok"):
        raise typer.Exit(ExitCode.FAILED)


def _watch(visitor: OperatorClient, *, stages: bool, as_json: bool) -> None:
    """Print the status of a cell every second until interrupted."""
    screen = sys.stdout.isatty() and not as_json
    for answer in visitor.watch(WATCH_S):
        if as_json:
            typer.echo(json_text(answer, None))
        elif screen:
            typer.echo(_drawn(status_lines(answer, stages=stages)), nl=False)
        else:
            typer.echo("\n".join((*status_lines(answer, stages=stages), "")))


def _drawn(lines: list[str]) -> str:
    """Return text that replaces the content of a terminal by as many lines as fit."""
    width, height = shutil.get_terminal_size()
    more = len(lines) - (height - 1)
    if more > 0:
        lines = [*lines[: -more - 1], f"  and {more + 1} more lines"]
    rows = "".join(f"{line[:width]}\x1b[K\n" for line in lines)
    return f"\x1b[H{rows}\x1b[J"


@live.command()
def pin(
    cell: Annotated[Path | None, _first(candidates)] = None,
    candidate: Annotated[str | None, _second("CANDIDATE", "Candidate to keep.", candidates)] = None,
    of_cell: OldCell = None,
    off: Annotated[bool, flag("--off", "Let the policy decide again.")] = False,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Keep a cell on one candidate, against its policy."""
    if off:
        unpin(cell, of_cell, keys, insecure, as_json)
        return
    file, name = _cell_and("CANDIDATE", cell, candidate, of_cell)
    _ask(file, "pin", name, keys, insecure=insecure, as_json=as_json)


@live.command(hidden=True)
def unpin(
    cell: Cell = None,
    of_cell: OldCell = None,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Let the policy decide again."""
    _ask(_the_cell(cell, of_cell), "unpin", "", keys, insecure=insecure, as_json=as_json)


@live.command()
def drain(
    cell: Annotated[Path | None, _first(nodes)] = None,
    node: Annotated[str | None, _second("NODE", "Node to drain.", nodes)] = None,
    of_cell: OldCell = None,
    off: Annotated[bool, flag("--off", "Let stages run on the node again.")] = False,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Move all stages off a node, to stop or change it."""
    file, name = _cell_and("NODE", cell, node, of_cell)
    what = "undrain" if off else "drain"
    _ask(file, what, name, keys, insecure=insecure, as_json=as_json)


@live.command(hidden=True)
def undrain(
    cell: Annotated[Path | None, _first(nodes)] = None,
    node: Annotated[str | None, _second("NODE", "Node to drain.", nodes)] = None,
    of_cell: OldCell = None,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Let stages run on a node again."""
    file, name = _cell_and("NODE", cell, node, of_cell)
    _ask(file, "undrain", name, keys, insecure=insecure, as_json=as_json)


@live.command()
def run(
    cell: CellArgument,
    scenario: Annotated[
        str | None,
        option(
            "NAME",
            "Scenario of the cell.",
            default="the first with disturbances",
            autocompletion=scenarios,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        option(
            "S",
            "Length, including the warm-up.",
            default="the scenario's",
            min=5,
            callback=require_held,
        ),
    ] = None,
    policy: Policy = None,
    estimator: Estimator = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        option("FOLDER", "Folder for logs, run and report.", default="live-out/CELL"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Run a cell on this machine, with emulated links; report."""
    from dwell.live.commands.live_run import run_live

    run_live(
        cell,
        scenario=scenario,
        seconds=seconds,
        policy=policy,
        estimator=estimator,
        seed=seed,
        out=out,
        as_json=as_json,
    )


def processes(context: typer.Context) -> list[str]:
    """Offer the processes on this computer that have a log."""
    from dwell.live.host.state_folder import logs, state_root

    return list(logs(state_root(context.params.get("state"))))


Root = Annotated[
    Path | None,
    option("FOLDER", "Folder with a folder per cell.", "--state", default="below ~/.local"),
]


@live.command()
def up(
    cell: CellArgument,
    node: Annotated[
        list[str] | None,
        option(
            "NAME",
            "This computer's node in the cell; may be repeated.",
            default="the nodes with an address of this computer",
            autocompletion=nodes,
        ),
    ] = None,
    policy: Policy = None,
    out: Annotated[Path, option("FOLDER", "Folder for the runs.")] = Path("runs"),
    again: Annotated[
        bool, flag("--again", "Apply an edited cell file or module to the running processes.")
    ] = False,
    yes: Annotated[
        bool, flag("--yes", "With --again: restart everything if that is necessary.")
    ] = False,
    state: Root = None,
    keys: Keys = None,
    insecure: Insecure = False,
) -> None:
    """Start a cell's agents and controller on this computer."""
    from dwell.live.commands import background
    from dwell.live.host.kept_cell import cell_here
    from dwell.live.host.security import environment

    if again:
        given = environment(keys, insecure=insecure)
        node = background.again(cell, state_root(state), given, typer.echo, yes=yes)
        if not node:
            return
    kept = cell_here(cell, state_root(state))
    if kept.folder is not None:
        kept.install()
    problem = kept.problem()
    nodes = background.nodes_here(problem, node or ())
    if problem.controller_node in nodes:
        problem = kept.problem(traces=True)
    if changed := kept.told(", ".join(nodes)):
        typer.echo(f"warning: {changed}", err=True)
    folder = state_root(state) / problem.name
    names = background.up(
        cell,
        problem,
        folder,
        out.resolve(),
        nodes=nodes,
        environment=environment(keys, insecure=insecure),
        policy=policy,
    )
    typer.echo(f"{problem.name} is up: {', '.join(names)}; logs in {folder}")


@live.command()
def down(cell: CellArgument, state: Root = None) -> None:
    """End the processes of `up`; actuators stop in order."""
    from dwell.live.commands import background
    from dwell.live.host.kept_cell import cell_here, forget

    root = state_root(state)
    problem = cell_here(cell, root).problem()
    names = background.down(problem, root / problem.name)
    forget(cell, root)
    ended = f"is down: {', '.join(names)}" if names else "does not run here"
    typer.echo(f"{problem.name} {ended}")


@live.command()
def log(
    cell: Annotated[Path | None, _first(processes)] = None,
    process: Annotated[
        str | None,
        argument(
            "PROCESS",
            "Such as agent@R1, controller@E, perception@E.",
            autocompletion=processes,
        ),
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Print new lines until interrupted.")
    ] = False,
    of_cell: OldCell = None,
    state: Root = None,
) -> None:
    """Print the log of a process on this computer, or list them."""
    from dwell.cellfile import load_without_traces
    from dwell.live.commands import background

    file, process = _cell_or(cell, process, of_cell)
    name, root = load_without_traces(file).name, state_root(state)
    if process is None:
        typer.echo("\n".join(background.logs_of(root, name)))
    else:
        background.print_log(background.log_of(root, process, name), follow=follow)


@live.command()
def units(
    cell: CellArgument,
    node: Node,
    out: Annotated[Path, option("FOLDER", "Folder for the units; made if it is missing.")] = Path(
        "units"
    ),
    user: Annotated[str | None, option("NAME", "User of the services.", default="you")] = None,
    keys: Keys = None,
    insecure: Insecure = False,
) -> None:
    """Write the systemd units of a node."""
    from dwell.cellfile import load_without_traces
    from dwell.live.commands.units import write_units

    problem = load_without_traces(cell)
    files = write_units(problem, node, cell, out, user=user, keys=keys, insecure=insecure)
    copied = " ".join(shlex.quote(str(file)) for file in files)
    names = " ".join(shlex.quote(file.stem) for file in files)
    typer.echo(
        f"sudo cp {copied} /etc/systemd/system/\n"
        "sudo systemctl daemon-reload\n"
        f"sudo systemctl enable --now {names}"
    )


def _ask(
    cell: Path, what: str, about: str, keys: Path | None, *, insecure: bool, as_json: bool
) -> None:
    from dwell.live.host.kept_cell import cell_here
    from dwell.live.host.operator_client import OperatorClient
    from dwell.live.host.security import environment

    problem = cell_here(cell, state_root()).problem()
    with OperatorClient(problem, environment(keys, insecure=insecure)) as visitor:
        answer = visitor.ask(what, about)
        # The controller answers before the end of the requested move.
        until_s = time.monotonic() + MOVES_S
        while answer.get("moving_to") and time.monotonic() < until_s:
            time.sleep(0.1)
            answer = visitor.ask("status")
    if as_json:
        print_json(answer)
        return
    for line in status_lines(answer):
        typer.echo(line)


def status_lines(status: dict[str, Any], *, stages: bool = False) -> list[str]:
    """Return a status as lines of text, troubles first, and with `stages` also stages and flows."""
    from dwell.record import shown_reason
    from dwell.study.metric import METRICS

    headline = status["headline"]
    lines = [f"{status['cell']} is {status['health']}: {headline}"] if headline else []
    if status["health"] == "absent":
        return lines
    where = status["placement"] or "not known yet"
    extras = [
        f"{word} {status[key]}"
        for word, key in (("moving to", "moving_to"), ("pinned to", "pinned"))
        if status[key]
    ]
    if status["fallback"]:
        extras.append("moved there by the guard")
    if proving := status["proving"]:
        extras.append(proof(proving))
    if status["drained"]:
        extras.append(f"without {', '.join(status['drained'])}")
    if status["refused"]:
        extras.append(f"last order refused: {status['refused']}")
    lines.append(f"{status['cell']}: {where}{''.join(f'; {extra}' for extra in extras)}")
    lines.append(
        f"mode {status['mode']}, term {status['term']}, migrations {status['migrations']}, moves "
        f"of the guard {status['guard_moves']}"
    )
    if window := status["window"]:
        used = ", ".join(
            f"{name} {'not measured' if share is None else f'{share:.0%}'}"
            for name, share in window["utilisation"].items()
        )
        ratio = status["release_ratio"]
        released = "" if ratio is None else f"released {ratio:.0%} of one cycle per period, "
        shown = (METRICS[name] for name in ("l95_ms", "violation_rate", "cost"))
        metrics = ", ".join(
            f"{metric.name} {metric.text(window[metric.column])}" for metric in shown
        )
        lines.append(
            f"window {window['number']}, {window['age_ms'] / 1e3:.1f} s ago: {metrics}, "
            f"{shown_reason(window['reason'])}; "
            f"{released}silences {status['silences']}; utilisation {used}"
        )
        lines += _ages(window)
    for who, topic in status["topics"].items():
        stamp_ms = topic["stamp_ms"]
        lines.append(
            f"  {who:24} {topic['topic']}: {topic['rate_hz']:.3g} Hz of "
            f"{1e3 / topic['period_ms']:.3g}, jitter {topic['jitter_ms']:.1f} ms, {topic['lost']} "
            f"lost, stamp to arrival {'not known' if stamp_ms is None else f'{stamp_ms:.1f} ms'}"
        )
    if status["changed"]:
        lines.append(f"controller: {status['changed']}")
    lines += [f"  {who:24} differs    {why}" for who, why in sorted(status["strangers"].items())]
    lines += [f"  {who:24} not heard" for who in status["silent"]]
    processes = status["processes"]
    for who, process in sorted(processes.items(), key=lambda item: (item[1]["ready"], item[0])):
        state = "ready" if process["ready"] else "not ready" if process["heard"] else "silent"
        note = f"  {process['note']}" if process["note"] else ""
        lines.append(f"  {who:24} {state:10} {process['age_ms']:8.0f} ms{note}")
    return lines + _stage_lines(status) if stages else lines


def _ages(window: dict[str, Any]) -> Iterator[str]:
    """Yield L95 of the data ages of chains, if there are any."""
    ages = [
        f"{name.removeprefix('age_l95_')} {'none' if ms is None else f'{ms:.1f} ms'}"
        for name, ms in window.get("ages", {}).items()
        if name.startswith("age_l95_")
    ]
    if ages:
        yield f"L95 of data age: {', '.join(ages)}"


def _stage_lines(status: dict[str, Any]) -> list[str]:
    """Return tables of stages and flows, or a note before the first complete window."""
    if not status.get("stages"):
        return ["stages and flows: no window has been counted yet"]
    columns: tuple[str, ...] = ("jobs", "replaced", "dropped")
    lines = [f"{'stage':32}median ms   p95 ms{''.join(f'{name:>10}' for name in columns)}"]
    for name, one in status["stages"].items():
        times = (one["exec_median_ms"], one["exec_p95_ms"])
        shown = "".join(f"{'-' if ms is None else f'{ms:.1f}':>9}" for ms in times)
        lines.append(f"  {name:30}{shown}{''.join(f'{one[name]:10}' for name in columns)}")
    columns = "sent", "taken", "replaced", "dropped", "lost", "in_flight"
    lines.append(f"{'flow':32}{''.join(f'{name:>10}' for name in columns)}      kB/s")
    for name, one in status["flows"].items():
        counts = "".join(f"{one[name]:10}" for name in columns)
        lines.append(f"  {name:30}{counts}{one['bytes_per_s'] / 1e3:10.1f}")
    return lines
