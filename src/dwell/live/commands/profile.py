"""`dwell profile`: measures samples of tasks and links, which cells replay."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dwell.cli.options import Json, Samples, Warmup, argument, flag, option
from dwell.cli.output import aligned, file_name, print_json
from dwell.errors import ProfileError
from dwell.live.log import say

if TYPE_CHECKING:
    from dwell.calibration.measure import Settings
    from dwell.calibration.profile_file import Measurement

FOLDER = Path("profiles")
PORT = 7411

profile = typer.Typer(no_args_is_help=True)

Out = Annotated[Path | None, option("FILE", "Parquet file to write.")]
Period = Annotated[
    float | None, option("MS", "Interval between starts.", default="none: one after another")
]


@profile.callback(invoke_without_command=True)
def measure(
    context: typer.Context,
    node: Annotated[str | None, option("NAME", "This computer's node in the cell.")] = None,
    task: Annotated[
        list[str] | None,
        option("TASK=MODULE:FUNCTION", "Function to measure; may be repeated."),
    ] = None,
    inputs: Annotated[
        list[str] | None,
        option(
            "[TASK=]MODULE:FUNCTION",
            "Function that gets the number of a run and returns the input of the task (of all "
            "tasks without a name).",
        ),
    ] = None,
    samples: Samples = 500,
    warmup: Warmup = 50,
    core: Annotated[str | None, option("CORES", "Cores to run on: 2, 0,2 or 0-3.")] = None,
    period_ms: Period = None,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Time tasks on this computer; cells can replay the samples.

    Without a subcommand, each task, a Python function, is run repeatedly on pinned cores: the
    highest core without --core. The results go to profiles/NODE.parquet without --out.
    """
    if context.invoked_subcommand is not None:
        _refuse_options(context, context.invoked_subcommand)
        return
    if node is None or not task:
        raise ProfileError(
            "measuring needs --node and at least one --task; see `dwell profile --help`"
        )
    from dwell.calibration.pinning import choose_cores, pinned

    path = out or FOLDER / f"{file_name(node)}.parquet"
    sources = _sources(task)
    factories = _factories(inputs or (), sources)
    # Set the cores first: at their import, numerical packages start one thread per available core.
    # Keep the output of the tasks out of the results.
    with pinned(choose_cores(core)), redirect_stdout(sys.stderr):
        from dwell.calibration.measure import Settings
        from dwell.calibration.profile_file import require_free, task_name, write_profile
        from dwell.live.host.memory import keep_memory

        require_free(path, [task_name(name, node) for name in sources])
        keep_memory()  # as the processes of a live cell do
        measured = _measured(node, sources, factories, Settings(samples, warmup, period_ms))
    write_profile(path, measured)
    _print_measured(path, measured, as_json=as_json)


@profile.command()
def merge(
    files: Annotated[list[Path], argument("FILE", "Profiles.")],
    out: Annotated[Path, option("FILE", "Parquet file to write.")],
    as_json: Json = False,
) -> None:
    """Merge the profiles of several nodes and links."""
    from dwell.calibration.profile_file import merge_profiles, write_profile

    merged = merge_profiles(files)
    write_profile(out, merged)
    _print_measured(out, merged, as_json=as_json)


@profile.command()
def listen(
    port: Annotated[int, option("P", "Port; 0 takes a free one.", min=0, max=65535)] = PORT,
    host: Annotated[
        str, option("ADDRESS", "Address to listen on; the default serves this machine only.")
    ] = "127.0.0.1",
    once: Annotated[bool, flag("--once", "End after the first connection.")] = False,
) -> None:
    """Answer the messages of `dwell profile link`, until Ctrl-C."""
    from dwell.calibration.round_trips import listen as answer

    def announce(address: str, taken: int) -> None:
        typer.echo(f"listening on {address}:{taken}")
        sys.stdout.flush()

    answer(host, port, announce=announce, log=say, once=once)


@profile.command()
def link(
    peer: Annotated[str, argument("HOST:PORT", "Address of `dwell profile listen`.")],
    source: Annotated[str, option("NAME", "This computer's node in the cell.", "--from")],
    target: Annotated[str, option("NAME", "The peer's node in the cell.", "--to")],
    payload_bytes: Annotated[
        int, option("N", "Bytes of payload in the larger message.", "--bytes")
    ] = 307_200,
    samples: Samples = 500,
    warmup: Warmup = 50,
    period_ms: Period = None,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Time round trips to a peer, with and without payload.

    The file is profiles/FROM-TO.parquet if not given.
    """
    from dwell.calibration.measure import Settings
    from dwell.calibration.profile_file import link_name, require_free, write_profile
    from dwell.calibration.round_trips import measure_link, parse_address

    host, port = parse_address(peer)
    path = out or FOLDER / f"{file_name(source)}-{file_name(target)}.parquet"
    name = link_name(source, target)
    require_free(path, [name])
    _say(f"measuring {name}")
    measured = measure_link(
        source,
        target,
        host,
        port,
        payload_bytes=payload_bytes,
        settings=Settings(samples, warmup, period_ms),
    )
    write_profile(path, [measured])
    _print_measured(path, [measured], as_json=as_json)


def _refuse_options(context: typer.Context, command: str) -> None:
    """Raise a ProfileError for options before a subcommand, which would have no effect."""
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if source is not None and source.name == "COMMANDLINE":
            name = parameter.opts[0]
            raise ProfileError(f"{name} stands before {command!r}; give it after that, if at all")


def _measured(
    node: str, sources: Mapping[str, str], factories: Mapping[str, str], settings: Settings
) -> list[Measurement]:
    from dwell.calibration.measure import measure_task, undisturbed_collector
    from dwell.calibration.target import find_callable
    from dwell.model.user_classes import importable_from

    measured = []
    with importable_from(str(Path.cwd())), undisturbed_collector():
        calls = {task: find_callable(name, f"--task {task}") for task, name in sources.items()}
        inputs: dict[str, Callable[[int], object]] = {
            task: find_callable(name, "--inputs") for task, name in factories.items()
        }
        for task, call in calls.items():
            _say(f"measuring {task}")
            measurement = measure_task(
                task,
                node,
                call,
                settings=settings,
                inputs=inputs.get(task),
                source=sources[task],
                inputs_source=factories.get(task),
            )
            measured.append(measurement)
    return measured


def _factories(declared: Sequence[str], tasks: Collection[str]) -> dict[str, str]:
    """Return the names of the functions that make inputs, by task."""
    named: dict[str, str] = {}
    for text in declared:
        task, equals, name = text.rpartition("=")
        if equals and task not in tasks:
            raise ProfileError(f"--inputs: {task!r} is not measured here; give it a --task")
        for one in [task] if equals else tasks:
            if one in named:
                raise ProfileError(f"--inputs: given twice for {one!r}; keep one of them")
            named[one] = name
    return named


def _sources(declared: Sequence[str]) -> dict[str, str]:
    """Return the names of the tasks' functions, by task."""
    sources: dict[str, str] = {}
    for text in declared:
        task, equals, name = text.partition("=")
        if not equals:
            raise ProfileError(f"--task: {text!r} is not of the form TASK=MODULE:FUNCTION")
        if task in sources:
            raise ProfileError(f"--task: {task!r} is given twice; measure one at a time")
        sources[task] = name
    return sources


def _say(what: str) -> None:
    # Print a line: the thread of a spinner would disturb the measurement.
    if sys.stderr.isatty():
        typer.echo(what, err=True)


# ------------------------------------------------------------------------------- what is printed


def _print_measured(path: Path, measured: Sequence[Measurement], *, as_json: bool) -> None:
    from dwell.calibration.cell_yaml import cell_yaml
    from dwell.calibration.sample_statistics import describe, find_doubts

    yaml = cell_yaml(path, measured)
    doubts = {one.name: list(find_doubts(one)) for one in measured}
    if as_json:
        rows: dict[str, Any] = {
            one.name: {
                "columns": {name: asdict(describe(one.columns[name])) for name in one.columns},
                "about": one.about,
                "warnings": doubts[one.name],
            }
            for one in measured
        }
        print_json({"profile": path, "measurements": rows, "yaml": yaml})
        return
    typer.echo(_table(measured))
    typer.echo("")
    for one in measured:
        typer.echo("\n  ".join([one.name, *_remarks(one)]))
    typer.echo(f"\nsaved to {path}; in a cell (file names start at the cell's own folder):\n")
    typer.echo(yaml, nl=False)
    for name, lines in doubts.items():
        for line in lines:
            typer.echo(f"warning: {name}: {line}", err=True)


def _table(measured: Sequence[Measurement]) -> str:
    from dwell.calibration.sample_statistics import describe

    head = ("ms", "n", "mean", "median", "p95", "p99", "max", "cv", "lag 1", "cores used")
    rows = []
    for one in measured:
        column = describe(one.samples)
        times = (column.mean, column.median, column.p95, column.p99, column.max)
        cores = one.about.get("cores_used")
        rows.append(
            (
                one.name,
                str(column.n),
                *(f"{value:.3f}" for value in times),
                f"{column.cv:.3f}",
                "-" if column.lag1 is None else f"{column.lag1:.2f}",
                "-" if cores is None else f"{cores:.2f}",
            )
        )
    return aligned(head, rows)


def _remarks(one: Measurement) -> list[str]:
    about = one.about
    remarks = _of_task(about) if about["kind"] == "task" else _of_link(one)
    pace = "one after another"
    if about["period_ms"] is not None:
        pace = f"one every {about['period_ms']:g} ms"
    return [*remarks, f"{pace}, after {about['warmup']} (warm-up) left out", _machine(about)]


def _of_task(about: Mapping[str, Any]) -> list[str]:
    cores = ", ".join(map(str, about["cores"]))
    collections = "/".join(map(str, about["gc_collections"]))
    collector = "on" if about["gc_enabled"] else "off"
    return [
        f"{about['callable']} on core {cores} of {about['processor']}",
        f"first call {about['first_ms']:.3f} ms; garbage collector {collector}, collections "
        f"by generation {collections}",
        f"timing an empty function takes {about['empty_wall_ms'] * 1e3:.2f} µs "
        f"(CPU {about['empty_cpu_ms'] * 1e3:.2f} µs), not subtracted",
    ]


def _of_link(one: Measurement) -> list[str]:
    from dwell.model.order_statistic import percentile

    minimal = one.columns[f"{one.name}/round_trip_ms"]
    payload = one.columns[f"{one.name}/payload_round_trip_ms"]
    rate = one.about["rate_mbps"]
    more = "no longer than without: no rate to tell" if rate is None else f"{rate:.4g} Mbit/s"
    return [
        f"half of the round trip to {one.about['peer']}, as if both ways took equally long",
        f"round trip {percentile(minimal, 50):.3f} ms in the median, "
        f"{percentile(payload, 50):.3f} ms with {one.about['bytes']} bytes: {more}",
    ]


def _machine(about: Mapping[str, Any]) -> str:
    conditions = about["conditions"]
    first, last = conditions["frequency_mhz"]
    frequency = "frequency not readable" if first is None else f"{first:.0f} MHz before"
    if last is not None:
        frequency += f", {last:.0f} MHz after"
    steal = "unknown" if conditions["steal"] is None else f"{conditions['steal']:.1%}"
    return (
        f"governor {conditions['governor'] or 'not readable'}, {frequency}, load "
        f"{conditions['load']:.2f}, steal {steal}, involuntary context switches "
        f"{conditions['preemptions']}"
    )
