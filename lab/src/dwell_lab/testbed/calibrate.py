"""Calibrate: write a cell file with the execution times, delays and backgrounds of measured runs.

The samples go to ``CELL.samples.parquet``. ``CELL.calibration.json`` records the estimates and
compares the cell's predictions with the runs that it was fitted to. This comparison is no
validation, and `dwell validate` refuses these runs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dwell.calibration.cell_yaml import replay
from dwell.calibration.profile_file import Measurement, link_name, stamp, task_name, write_profile
from dwell.cellfile.yaml_text import yaml_of
from dwell.errors import DwellError, RunError
from dwell.estimators.registry import name_in_run
from dwell.files import write_whole
from dwell.live.local.trace_names import move_traces
from dwell.model import Problem, Trace
from dwell.model.number_arrays import Floats
from dwell.model.order_statistic import percentile
from dwell_lab.testbed.measured import Measured, SiteName, cycles_in, look_at, usable
from dwell_lab.testbed.message_costs import OnTheWay, floors, hops, own_delays
from dwell_lab.testbed.node_loads import (
    backgrounds,
    beside_jobs,
    interferences,
    wakes,
)
from dwell_lab.testbed.paired import paired
from dwell_lab.testbed.sensitivity import usual_of
from dwell_lab.testbed.speeds import Usual, at_speed_of
from dwell_lab.testbed.task_costs import TaskCost, messaging, task_costs

#: Seed of the sampled link delays and of the simulations that check the cell.
SEED = 20_260_101
#: Number of delays to sample per link.
ASKED = 20_000
#: Shortest execution time to write, ms: a cell file requires positive times.
LEAST_MS = 1e-3
#: Findings that a cell file accepts only for nodes with a quota.
ONLY_WITH_QUOTA = ("background_beside",)
#: Largest number of windows to simulate per run in the check.
CHECK_WINDOWS = 300


#: Line of the report for each key that has no other line.
NODE_LINES = {
    "background_hz": "{node}: background threads wake {value:.4g} times a second",
    "interference": "{node}: stages take {value:.3g} times as long under foreign threads",
}


def calibrate(
    cell: Path,
    runs: Sequence[Path],
    out: Path,
    *,
    emulated: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Write a cell with the execution times, delays and backgrounds of measured runs.

    `runs` are folders of runs with recorded jobs; together they must cover every task on every
    node without disturbance. They may belong to another cell with the same tasks and nodes. With
    `emulated`, links keep the delays of the cell plus the measured extra delay; otherwise they get
    the measured delays. `say` receives the lines of the report.

    Raises `DwellError` if the cell or a run cannot be used (with all faults), or `out` is the cell;
    `OSError` if a file cannot be written.
    """
    from dwell.cellfile import load

    _require_new(out, cell)
    problem = load(cell)
    measured = _measured(runs, problem)
    messaging_ms = messaging(measured, problem)
    usual = usual_of(measured)
    known = hops(measured, messaging_ms, problem, _asked(problem) if emulated else {})
    costs = task_costs(measured, messaging_ms, known, problem, usual)
    if not costs:
        raise RunError("no task has enough jobs in usable windows")
    cpus = _cpus(measured)
    columns = paired({site: of.samples for site, of in costs.items()}, cpus)
    rows = len(next(iter(columns.values())))
    added_ms, delays_ms = _links(measured, known, problem, rows, emulated=emulated)
    behind = backgrounds(measured, costs, problem)
    nodes = _short(
        {
            "background": behind,
            "background_beside": beside_jobs(measured, behind),
            "interference": interferences(measured, costs, usual),
            "background_hz": wakes(measured, problem),
        }
    )
    document = _document(cell, out)
    samples = out.with_name(f"{out.stem}.samples.parquet")
    _write_samples(samples, costs, columns, delays_ms, measured, added_ms)
    _put_in(document, Path(samples.name), costs, delays_ms, nodes)
    head = f"# {cell.name} with measured values, by `dwell testbed calibrate`.\n"
    head += f"# Runs: {', '.join(path.resolve().name for path in runs)}\n"
    write_whole(out, head + yaml_of(document))
    written = load(out)
    report = {
        "runs": [one.name for one in measured],
        "ids": [one.run.run_id for one in measured if one.run.run_id is not None],
        "cell": problem.name,
        **stamp(),
        "emulated_links": emulated,
        "tasks": {task_name(*site): _about(of) for site, of in costs.items()},
        "links": _link_delays(added_ms, delays_ms),
        **nodes,
        "work_ms": _short(usual.work_ms),
        "sensitivity": _short(
            {task_name(*site): value for site, value in usual.sensitivity.items()}
        ),
        "check": [row for one in measured if (row := _check(one, written, usual)) is not None],
        "missing": _missing(problem, costs, delays_ms),
    }
    write_whole(out.with_name(f"{out.stem}.calibration.json"), json.dumps(report, indent=2) + "\n")
    for line in _lines(report):
        say(line)


def _require_new(out: Path, cell: Path) -> None:
    """Raise a RunError if the new cell file is the old one, or no YAML file."""
    if out.suffix not in (".yaml", ".yml"):
        raise RunError(f"{out}: a cell file ends in .yaml")
    if out.exists() and out.samefile(cell):
        raise RunError(f"{out} is the cell itself; name another file")


def _link_delays(
    added_ms: Mapping[str, float], delays_ms: Mapping[str, Floats]
) -> dict[str, dict[str, float]]:
    """Return the added and the mean delay of each link."""
    return {
        link: _short({"added_ms": added_ms.get(link), "mean_ms": values.mean()})
        for link, values in delays_ms.items()
    }


def _missing(
    problem: Problem, costs: Mapping[SiteName, TaskCost], delays_ms: Mapping[str, Floats]
) -> list[str]:
    """Return the tasks and links without enough samples."""
    tasks = [
        task_name(task.name, node)
        for task in problem.pipeline.tasks.values()
        for node in task.on
        if (task.name, node) not in costs
    ]
    return tasks + [link for link in problem.fabric.links if link not in delays_ms]


def _cpus(measured: Sequence[Measured]) -> dict[str, tuple[int, ...]]:
    """Return the CPUs of each node, for runs on a testbed."""
    return {
        node: tuple(about["cpus"])
        for one in measured
        for node, about in (one.run.meta.get("testbed") or {}).get("nodes", {}).items()
        if about.get("cpus")
    }


def make_runs(
    cell: Path,
    folder: Path,
    *,
    seconds: float,
    seed: int,
    name: str,
    tell: Callable[[str], None] = print,
) -> list[Path]:
    """Run the baseline under every candidate on a testbed, recording jobs; return the runs.

    `folder` gets one folder per run. `seconds` includes the warm-up. `seed` is the seed of delays
    and losses, `name` the name of the testbed, and `tell` receives progress lines.

    Raises `DwellError` if the cell cannot run here or the machine was the bottleneck of a run.
    """
    from dwell.cellfile import load
    from dwell.record import open_run
    from dwell_lab.testbed.run import run_once

    problem = load(cell)
    runs = []
    for candidate in problem.candidates:
        run = run_once(
            problem,
            scenario="baseline",
            policy=candidate,
            seconds=seconds,
            seed=seed,
            out=folder / candidate,
            name=name,
            jobs=True,
            tell=tell,
        )
        pressure = open_run(run).meta.get("pressure") or {}
        if pressure.get("failed"):
            raise RunError(
                f"{run}: the machine was the bottleneck ({pressure.get('why')}); measure on an "
                "idle machine"
            )
        runs.append(run)
    return runs


def _measured(runs: Sequence[Path], problem: Problem) -> list[Measured]:
    from dwell.record import open_run

    names = [path.resolve().name for path in runs]
    if not runs:
        raise RunError("no runs; name the folders of runs with recorded jobs")
    faults = [f"{name}: named twice" for name in sorted({n for n in names if names.count(n) > 1})]
    measured = []
    for name, path in zip(names, runs, strict=True):
        try:
            measured.append(look_at(name, open_run(path), problem))
        except DwellError as error:
            faults.append(str(error))
    if faults:
        raise RunError("\n".join(faults))
    return measured


def _asked(problem: Problem) -> dict[tuple[str, str], Floats]:
    """Sample the configured delays of a cell's links, except replayed delays."""
    rng = np.random.default_rng(SEED)
    return {
        (link.source, link.target): link.delay_ms.marginal(rng, ASKED)
        for link in problem.fabric.links.values()
        if not isinstance(link.delay_ms, Trace)
    }


def _links(
    measured: Sequence[Measured],
    known: OnTheWay,
    problem: Problem,
    rows: int,
    *,
    emulated: bool,
) -> tuple[dict[str, float], dict[str, Floats]]:
    """Return the extra time of each link, and `rows` delays of its messages, ms."""
    if not emulated:
        own = own_delays(measured, known, problem)
        return {}, {link_name(*link): np.resize(values, rows) for link, values in own.items()}
    asked_ms = {link: np.resize(values, rows) for link, values in known.asked_ms.items()}
    added_ms = floors(measured, known, problem)
    # A link without messages gets the mean of the other links.
    usual_ms = float(np.mean(list(added_ms.values()))) if added_ms else 0.0
    added = {link_name(*link): added_ms.get(link, usual_ms) for link in asked_ms}
    return added, {
        link_name(*link): values + added[link_name(*link)] for link, values in asked_ms.items()
    }


# ------------------------------------------------------------------------------- the files


def _write_samples(
    path: Path,
    costs: Mapping[SiteName, TaskCost],
    columns: Mapping[SiteName, Floats],
    delays_ms: Mapping[str, Floats],
    measured: Sequence[Measured],
    added_ms: Mapping[str, float],
) -> None:
    """Write all columns; the columns of one file share their rows in a replay."""
    about: dict[str, Any] = {"runs": [one.name for one in measured], **stamp()}
    measurements = [
        Measurement(
            task_name(*site),
            {task_name(*site): np.maximum(columns[site], LEAST_MS)},
            {"kind": "task", "task": site[0], "node": site[1], **about, **_about(of)},
        )
        for site, of in costs.items()
    ]
    for link, values in delays_ms.items():
        source, _, target = link.partition("->")
        of_link = {"kind": "link", "from": source, "to": target, "rate_mbps": None, **about}
        of_link["added_ms"] = added_ms.get(link)
        measurements.append(Measurement(link, {link: values}, of_link))
    write_profile(path, measurements)


def _document(cell: Path, out: Path) -> dict[str, Any]:
    """Return the cell file as plain values, with trace paths relative to the new file."""
    from dwell.cellfile.document_faults import Faults
    from dwell.cellfile.yaml_text import read_yaml

    document = read_yaml(str(cell), Faults(str(cell)))
    if not isinstance(document, dict):
        raise RunError(f"{cell}: not a cell file")
    document.setdefault("name", cell.stem)
    move_traces(document, Path(os.path.relpath(cell.resolve().parent, out.resolve().parent)))
    return document


def _put_in(
    document: dict[str, Any],
    file: Path,
    costs: Mapping[SiteName, TaskCost],
    delays_ms: Mapping[str, Floats],
    nodes: Mapping[str, Mapping[str, Any]],
) -> None:
    """Write the findings for tasks, nodes and links into a cell's document."""
    for task, node in costs:
        document["tasks"][task]["on"][node]["exec_ms"] = replay(file, task_name(task, node))
        # The samples include the scale shared between tasks.
        document["tasks"][task].pop("scale", None)
    for node in nodes["background"]:
        document["nodes"][node].pop("background_beside", None)
    for key, values in nodes.items():
        for node, value in values.items():
            entry = document["nodes"][node]
            if key not in ONLY_WITH_QUOTA or entry.get("quota"):
                entry[key] = value
    links = []
    for entry in document.get("links") or ():
        ways = [(entry["from"], entry["to"])]
        if entry.get("both_ways"):
            ways.append((entry["to"], entry["from"]))
        for source, target in ways:
            one = {name: value for name, value in entry.items() if name != "both_ways"}
            one |= {"from": source, "to": target}
            if f"{source}->{target}" in delays_ms:
                one["delay_ms"] = replay(file, f"{source}->{target}")
            links.append(one)
    if links:
        document["links"] = links


# ------------------------------------------------------------------------------ the report


def _about(of: TaskCost) -> dict[str, Any]:
    return {
        "mean_ms": _short(of.samples_ms.mean()),
        "std_ms": _short(of.samples_ms.std()),
        **{
            name: _short(getattr(of, name))
            for name in ("stage_ms", "messaging_ms", "before_ms", "after_ms")
        },
        "jobs": len(of.samples_ms),
        "of_runs": list(of.samples),
    }


def _short(value: Any) -> Any:
    """Round a number, or all numbers of a mapping, to five digits."""
    if isinstance(value, Mapping):
        return {key: _short(each) for key, each in value.items()}
    return None if value is None else float(f"{value:.5g}")


def _check(one: Measured, problem: Problem, usual: Usual) -> dict[str, Any] | None:
    """Return the new cell's prediction for a run next to the run's measured values."""
    import polars as pl

    from dwell.sim import draw, simulate_realisation

    scenario = str(one.run.meta.get("scenario") or "baseline")
    scenario = "baseline" if scenario == "live" else scenario
    if one.placement not in problem.candidates or scenario not in problem.scenarios:
        return None
    try:
        estimator = name_in_run(one.run.meta)
    except RunError:
        return None
    problem = at_speed_of(one.run, replace(problem, warmup_windows=2), usual)
    count = min(max(one.windows, 50), CHECK_WINDOWS)
    real = draw(problem, scenario=scenario, seed=SEED, windows=count)
    played = simulate_realisation(problem, real, policy=one.placement, estimator=estimator)
    shares = ["violation_rate", *(f"u_{node}" for node in problem.fabric.nodes)]
    row: dict[str, Any] = {"run": one.name, "scenario": scenario, "placement": one.placement}
    for what, run in (("measured", one.run), ("predicted", played)):
        windows = usable(run)
        cycles = run.cycles.with_columns(pl.col("cycle").cast(pl.Int64))
        cycles = cycles.join(cycles_in(windows, problem), on="cycle", how="semi")
        latency_ms = cycles["latency_ns"].fill_null(np.iinfo(np.int64).max).to_numpy() / 1e6
        l95_ms = percentile(latency_ms, 95)
        means = {name: windows[name].to_numpy().mean() for name in shares}
        row[what] = {
            "l95_ms": _short(l95_ms) if l95_ms < 1e9 else None,
            "mean_ms": _short(latency_ms[latency_ms < 1e9].mean()),
            **_short(means),
        }
    return row


def _lines(report: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, of in report["tasks"].items():
        lines.append(
            f"{name}: {of['mean_ms']:.3g} ms ({of['before_ms']:.3g} before, {of['stage_ms']:.3g} "
            f"stage, {of['after_ms']:.3g} after; {of['messaging_ms']:.3g} of it messaging), "
            f"{of['jobs']} jobs"
        )
    lines += [f"{name}: {of['mean_ms']:.3g} ms" for name, of in report["links"].items()]
    for node, value in report["background"].items():
        beside = report["background_beside"].get(node)
        more = "" if beside is None else f", {beside:.3g} while jobs run"
        lines.append(f"{node}: background {value:.3g} cores{more}")
    for key, line in NODE_LINES.items():
        lines += [line.format(node=node, value=value) for node, value in report[key].items()]
    for name, value in report["sensitivity"].items():
        lines.append(f"{name}: takes x^{value:.3g} times as long on a CPU that is x times as slow")
    for row in report["check"]:
        pairs = (
            f"{name} {_shown(row['measured'][name])} measured, {_shown(row['predicted'][name])} "
            "predicted"
            for name in ("l95_ms", "mean_ms", "violation_rate")
        )
        lines.append(f"{row['run']} ({row['scenario']}, {row['placement']}): {'; '.join(pairs)}")
    lines += [f"{name}: not measured, unchanged" for name in report["missing"]]
    return lines


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"
