"""`dwell fleet`: cells that share nodes, played together; how many of them there may be."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import dwell
from dwell.cli.completion import estimators, policies
from dwell.cli.options import Json, Processes, Seed, argument, flag, option
from dwell.cli.output import (
    aligned,
    block,
    file_name,
    interrupted,
    mark_of,
    print_json,
    progress,
    require_own,
    warn,
    working,
    write_report,
)
from dwell.cli.run import default_folder
from dwell.model.bounds import counted

if TYPE_CHECKING:
    from dwell.model.fleet import Fleet
    from dwell.record import FleetRun
    from dwell.study.capacity import Capacity
    from dwell.study.fleet_plan import FleetPlan
    from dwell.study.intervals import Interval
    from dwell.study.metric import Metric
    from dwell.study.what_ifs import WhatIf

#: Cells, and rounds, that the terminal shows, and columns that time has there.
SHOWN, TIMES = 24, 40
THE_LIMIT = "the limit".rjust(TIMES // 2 + 4)
#: Keys of a change that serves the wanted number.
CHANGE = ("change", "times")

fleet = typer.Typer(
    no_args_is_help=True,
    help="Simulate cells that share nodes; find how many fit.",
)

FleetArgument = Annotated[Path, argument("FILE", "Fleet file (YAML).")]
Policy = Annotated[
    str | None,
    option(
        "NAME",
        "Policy of every cell, such as dtp or cusum+corrected, or a candidate, which never moves.",
        default="the file's",
        autocompletion=policies,
    ),
]
Estimator = Annotated[
    str | None,
    option(
        "NAME",
        "Estimator of every cell.",
        default="the file's",
        autocompletion=estimators,
    ),
]
Coordination = Annotated[
    str | None,
    option("NAME", "Coordination of moves: none, random or ledger.", default="the file's"),
]
Phases = Annotated[
    str | None,
    option(
        "HOW",
        "Start of each cell: sync, even, random, or offsets in ms, separated by commas.",
        default="the file's",
    ),
]


@fleet.command()
def run(
    file: FleetArgument,
    seed: Seed = 1,
    windows: Annotated[
        int, option("N", "Length in windows of the cell with the longest windows.", min=1)
    ] = 100,
    seconds: Annotated[float | None, option("S", "Length in seconds instead.")] = None,
    policy: Policy = None,
    estimator: Estimator = None,
    coordination: Coordination = None,
    phases: Phases = None,
    guard: Annotated[bool, flag("--guard", "Let the guards move cells to a fallback.")] = False,
    jobs: Annotated[bool, flag("--jobs", "Keep the times of every job.")] = False,
    out: Annotated[
        Path | None,
        option(
            "FOLDER",
            "Folder for the runs.",
            default="runs/FLEET-POLICY-COORDINATION-PHASES-SEED",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Simulate the cells of a fleet; save one run per cell."""
    from dwell.record.fleet_run import describe_fleet, require_free_or_same
    from dwell.sim.fleet import duration_of, phases_ms
    from dwell.study.fleet_summary import fleet_numbers

    changes = {"policy": policy, "estimator": estimator, "coordination": coordination}
    played = _read(file, phases, **changes)
    parts = (policy, estimator, played.coordination, played.phasing, str(seed))
    folder = out or default_folder(played.name, *filter(None, parts))
    duration_s = duration_of(played, windows, seconds) / 1e9
    settings = {"seed": seed, "guard": guard, "seconds": duration_s, "versions": None}
    offsets = phases_ms(played, seed)
    require_free_or_same(folder, describe_fleet(played, phases=offsets, **settings))
    cells = counted(len(played.cells), "cell")
    try:
        with progress(f"simulating {cells} for {duration_s:g} s") as shown:
            result = dwell.simulate_fleet(
                played, seed=seed, seconds=duration_s, guard=guard, jobs=jobs, progress=shown
            )
        with working(f"writing {cells}"):
            result.save(folder)
    except KeyboardInterrupt:
        whole = sum((folder / cell.name / "run.json").is_file() for cell in played.cells)
        interrupted(
            f"{whole} of {len(played.cells)} runs are whole in {folder}; the same command makes "
            "them all"
        )
    summary = fleet_numbers(result)
    if as_json:
        print_json({**_head(result), "run": folder, **summary})
    else:
        typer.echo(_text(result, summary))
        typer.echo(f"\nsaved to {folder}")


@fleet.command()
def plan(
    file: FleetArgument,
    seed: Seed = 1,
    phases: Phases = None,
    limit: Annotated[
        float | None,
        option(
            "SHARE",
            "Also name the cells whose V_D stays above this share, such as 0.05.",
            default="with `objective: served` the file's limit",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find the placements with the least cost for all cells.

    The placements start from the minimum of the table of loads and improve by simulated moves and
    swaps.
    """
    from dwell.study.fleet_plan import plan_fleet

    if limit is not None:
        _require_limit(limit)
    planned = _read(file, phases)
    if limit is None and planned.objective == "served":
        limit = planned.limit
    with progress(f"playing loads of {counted(len(planned.cells), 'cell')}") as shown:
        found = plan_fleet(planned, seed=seed, progress=shown)
    if as_json:
        head = {"fleet": planned.name, "seed": seed, "phases": planned.phases}
        more = {} if limit is None else {"limit": limit, "above": found.above(limit)}
        print_json(head | found.as_json() | more)
        return
    typer.echo(_plan_text(planned, found, seed))
    if limit is not None:
        above = found.above(limit)
        names = f": {', '.join(above)}" if above else ""
        cells = counted(len(found.cells), "cell")
        typer.echo(f"\n{len(above)} of {cells} stay above {limit * 100:g} %{names}")


@fleet.command()
def capacity(
    file: FleetArgument,
    limit: Annotated[float, option("SHARE", "Largest V_D that the worst cell may have.")] = 0.05,
    policy: Policy = None,
    phases: Annotated[
        str | None,
        option("HOW", "Start of each cell: sync, even or random.", default="the file's"),
    ] = None,
    most: Annotated[int, option("N", "Largest number of robots to try.", min=1, max=1000)] = 128,
    what_if: Annotated[
        bool,
        flag(
            "--what-if",
            "Also try each change that a site can make: phases, deadlines, cores, accelerators, "
            "servers, placements.",
        ),
    ] = False,
    asked: Annotated[
        int | None,
        option("N", "Wanted number of robots; names the first change that serves them.", min=1),
    ] = None,
    processes: Processes = None,
    out: Annotated[
        Path | None,
        option(
            "FILE",
            "Page to write.",
            default="capacity/FLEET-POLICY-PHASES.html; none with --json",
        ),
    ] = None,
    figures: Annotated[
        Path | None, option("FOLDER", "Also write the curve for a paper: PDF, SVG, CSV.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Find how many robots the shared nodes carry.

    The number of cells of the first entry varies, the others stay. Each size is simulated with 100
    draws of phases of 200 cycles if phases are random and no cell moves, else with 10 seeds of
    2,000 cycles.
    """
    from dwell.record.fleet_run import fleet_document
    from dwell.report.capacity_page import capacity_page
    from dwell.study.capacity import capacity_of, long_runs
    from dwell.study.played_sizes import KeptSizes
    from dwell.study.what_ifs import WhatIf, changes_of, served_by

    _require_limit(limit)
    read = _read(file, phases, policy=policy)
    names = ", ".join(dict.fromkeys(read.policy_of(one) for one in read.entries))
    usual = Path("capacity", file_name(f"{read.name}-{names}-{read.phases}.html"))
    page = out or (None if as_json else usual)
    mark = mark_of(fleet_document(read), limit, most, what_if)
    if page is not None:
        require_own(page, mark)
    warn(file, long_runs(read))
    kept = KeptSizes((out or usual).with_suffix(".played"))
    settings: dict[str, Any] = {"limit": limit, "most": most, "processes": processes, "kept": kept}
    changes = []
    served = None
    try:
        with progress(f"playing up to {most} robots") as shown:
            found = capacity_of(read, **settings, progress=shown)
        # Numbers of robots compare where the limit is on the same.
        settings["on_excess"] = found.limit_on == "excess"
        for change in changes_of(read) if what_if else ():
            with progress(f"what if: {change.text}") as shown:
                changes.append(WhatIf(change.text, change.capacity(**settings, progress=shown)))
        if asked is not None and found.robots < asked:
            with progress(f"looking for a change that serves {asked} robots"):
                served = served_by(read, asked, **settings)
    except KeyboardInterrupt:
        runs = counted(kept.count, "run")
        interrupted(f"the results of {runs} are in {kept.file}; the same command continues")
    if page is not None or figures is not None:
        shown_page = capacity_page(read.name, found, changes)
        with working("writing the report"):
            write_report(shown_page, page, figures=figures, static=False, mark=mark)
    kept.remove()
    if as_json:
        more: dict[str, Any] = {"what_if": [one.as_json() for one in changes]} if what_if else {}
        if asked is not None:
            more["asked"] = {
                "robots": asked,
                "too_many": max(asked - found.robots, 0),
                "served_by": None if served is None else dict(zip(CHANGE, served, strict=True)),
            }
        print_json({"fleet": read.name, **found.as_json(), **more, "report": page})
        return
    typer.echo(_capacity_text(read, found, changes))
    if asked is not None:
        typer.echo(f"\n{_asked_text(asked, found, served)}")
    typer.echo(f"\nreport: {page}")
    if figures is not None:
        typer.echo(f"figures: {figures}")


def _asked_text(asked: int, found: Capacity, served: tuple[str, int] | None) -> str:
    if found.robots >= asked:
        return f"{asked} asked: served"
    told = f"{asked} asked: {asked - found.robots} too many; "
    if served is None:
        return told + "no single change serves them"
    change, count = served
    return told + f"served with {change}" + (f", {count} times" if count > 1 else "")


def _plan_text(of: Fleet, found: FleetPlan, seed: int) -> str:
    from dwell.study.metric import METRICS

    rate, l95 = METRICS["violation_rate"], METRICS["l95_ms"]
    counts = Counter(found.placements.values())
    placed = ", ".join(f"{count} on {name}" for name, count in counts.most_common())
    rows = [
        [
            name,
            found.placements[name],
            rate.number(qos.violation_rate),
            l95.number(qos.l95_ms),
        ]
        for name, qos in sorted(
            found.cells.items(), key=lambda one: one[1].violation_rate, reverse=True
        )
    ]
    lines = [
        f"{of.name}: {counted(len(found.placements), 'cell')}; phases: {of.phasing}; seed {seed}",
        f"best: {placed}",
        f"Φ/n   {found.phi:.3f} as played, {found.table_phi:.3f} by the table of loads",
        "",
        aligned(["cell, the worst first", "placement", rate.heading, l95.heading], rows[:SHOWN]),
    ]
    if len(rows) > SHOWN:
        lines.append(f"{len(rows) - SHOWN} more, with fewer misses, are in --json")
    return "\n".join(lines)


def _require_limit(limit: float) -> None:
    if not 0 < limit < 1:
        raise typer.BadParameter(f"--limit: {limit:g} is not allowed; it must be between 0 and 1")


def read_phases(text: str | None) -> str | tuple[float, ...] | None:
    """Return what an option says of phases: a word, or a number a cell."""
    if text is None:
        return None
    try:
        return tuple(float(one) for one in text.split(","))
    except ValueError:
        return text


def _read(file: Path, phases: str | None, **changes: str | None) -> Fleet:
    """Read a fleet, warn of settings without effect, and change it as the options say."""
    fleet = dwell.load_fleet(file)
    warn(file, fleet.without_effect())
    return fleet.changed(phases=read_phases(phases), **changes)


def _head(result: FleetRun) -> dict[str, Any]:
    fleet = result.fleet
    return {
        "fleet": fleet.name,
        "seed": result.seed,
        "seconds": result.seconds,
        "coordination": fleet.coordination,
        "phases": fleet.phases,
        "phases_ms": result.phases_ms,
        "guard": result.guard,
    }


# --------------------------------------------------------------------------- on a terminal


def _text(result: FleetRun, summary: Mapping[str, Any]) -> str:
    from dwell.study.metric import METRICS

    fleet = result.fleet
    shared = ", ".join(fleet.shared) or "nothing"
    lines = [
        f"{fleet.name}: {counted(len(result.cells), 'cell')}; shared: {shared}; phases: "
        f"{fleet.phasing}; coordination: {fleet.coordination}; seed {result.seed}; "
        f"{result.seconds:g} s",
        "",
        *_cells(result, summary["cells"]),
        "",
        *_nodes(result, summary["load"]),
        f"mean J: {METRICS['cost'].text(summary['cost'])}",
        f"moves: {summary['moves']}, of guards {summary['guard_moves']}{_told(summary['refused'])}",
        *_round_lines(summary["rounds"]),
    ]
    return "\n".join(lines)


def _told(refused: Mapping[str, int]) -> str:
    listed = ", ".join(f"{count} by {who}" for who, count in refused.items())
    return f"; refused: {listed}" if listed else ""


def _cells(result: FleetRun, cells: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the table of cells, with where each is over time."""
    from dwell.study.metric import METRICS

    rate, l95, cost = (METRICS[name] for name in ("violation_rate", "l95_ms", "cost"))
    candidates = dict.fromkeys(
        name for entry in result.fleet.entries for name in entry.cell.candidates
    )
    letters = _letters(candidates)
    legend = ", ".join(f"{letter} {name}" for name, letter in letters.items())
    rows = [
        [
            str(row["cell"]),
            rate.number(row["violation_rate"]),
            str(row["verdict"]),
            l95.number(row["l95_ms"]),
            cost.number(row["cost"]),
            str(row["moves"]),
            "".join(letters[name] for name in _placements(result, str(row["cell"]))),
        ]
        for row in cells[:SHOWN]
    ]
    if not rows:
        yield "no window is after the warm-up: nothing to sum up; ask for more"
        return
    head = [
        "cell, the worst first",
        rate.heading,
        "verdict",
        l95.heading,
        cost.heading,
        "moves",
        "where over time",
    ]
    yield aligned(head, rows)
    if len(cells) > SHOWN:
        yield f"{len(cells) - SHOWN} more, with fewer misses, are in the folder"
    aim = f"aim: V_D under {result.fleet.aim * 100:g} %"
    yield f"where: {legend}; V_D, L95 and J leave the warm-up out; {aim}"


def _letters(names: Iterable[str]) -> dict[str, str]:
    """Return a letter for each name: a distinct letter while any is left."""
    letters: dict[str, str] = {}
    for name in names:
        free = (sign for sign in (*name.upper(), *"0123456789", "?") if sign.isalnum())
        letters[name] = next((sign for sign in free if sign not in letters.values()), "?")
    return letters


def _placements(result: FleetRun, cell: str) -> list[str]:
    """Return a cell's placements over time, in at most TIMES columns."""
    placed = result.cells[cell].windows["placement"].to_list()
    count = min(len(placed), TIMES)
    return [str(placed[i * len(placed) // count]) for i in range(count)]


def _nodes(result: FleetRun, load: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """Yield the table of shared nodes, with their load over time."""
    rows = []
    for name, shares in load.items():
        values = result.load[f"u_{name}"].to_list()
        count = min(len(values), TIMES)
        parts = [
            values[i * len(values) // count : (i + 1) * len(values) // count] for i in range(count)
        ]
        line = "".join(block(sum(part) / len(part)) for part in parts)
        rows.append([name, f"{shares['mean'] * 100:.1f}", f"{shares['most'] * 100:.1f}", line])
    if rows:
        yield aligned(["shared", "mean (%)", "most (%)", "busy over time"], rows)


def _round_lines(rounds: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    moving = [one for one in rounds if one["moved"]]
    for one in moving[:SHOWN]:
        moved = ", ".join(one["moved"])
        phi = f"Φ {one['phi_before']:.3f} to {one['phi_after']:.3f}"
        yield f"round {one['round']}: {phi}; {moved}"
    if len(moving) > SHOWN:
        yield f"{len(moving) - SHOWN} more rounds moved cells"


def _capacity_text(of: Fleet, found: Capacity, changes: Sequence[WhatIf]) -> str:
    from dwell.report.capacity_page import answer, busy, errors, written
    from dwell.study.metric import METRICS

    rate = METRICS["violation_rate"]
    limits = found.limits
    excess = " above one cell alone" if found.limit_on == "excess" else ""
    point = found.point(found.robots)
    facts = [
        ("robots", answer(found)),
        ("limit", f"V_D of the worst cell{excess}: {found.limit * 100:g} %"),
        ("played", f"{found.policy}, phases {found.phases}"),
    ]
    if limits is not None:
        share = f"{limits.share:.0%} of the waiting of missed cycles"
        used = point.utilisation.get(limits.name)
        told = "" if used is None else f", busy {used:.0%} at {point.robots}"
        facts.append(("what limits", f"{limits.name}, {share}{told}"))
    if found.phases == "random":
        facts.append(("errors", errors(found)))
    if found.searched == "bisection":
        facts.append(("searched", "by bisection"))
    if found.reason:
        facts.append(("why none", found.reason))
    width = max(len(name) for name, _ in facts)
    scale = 2 * found.bound
    rows = [
        [
            str(point.robots),
            rate.number(point.violation_rate.value),
            _ends(point.violation_rate, rate),
            _bar(point.violation_rate.value / scale),
            busy(point),
        ]
        for point in found.curve
    ]
    lines = [
        f"{of.name}: {', '.join(of.shared)} shared by {of.entries[0].cell.name}",
        *(f"{name.ljust(width)}  {value}" for name, value in facts),
        "",
        aligned(
            ["robots", rate.heading, "95 % interval", THE_LIMIT.ljust(TIMES), "utilisation"],
            rows,
        ),
    ]
    if changes:
        table = [
            [one.change, written(one.capacity), "[{}, {}]".format(*one.capacity.interval)]
            for one in changes
        ]
        lines += ["", aligned(["what if", "robots", "95 % interval"], table)]
    return "\n".join(lines)


def _ends(rate: Interval, metric: Metric) -> str:
    return f"[{metric.number(rate.low)}, {metric.number(rate.high)}]" if rate.known else "-"


def _bar(share: float) -> str:
    """Return a bar that reaches the limit in the middle, where a stroke stands."""
    filled = min(round(share * TIMES), TIMES)
    signs = ["█" if place < filled else " " for place in range(TIMES)]
    middle = TIMES // 2
    return "".join([*signs[:middle], "│", *signs[middle:]])
