"""`dwell study`: every scenario, policy, point and seed of a study file, in a folder of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dwell.cli.options import (
    Json,
    Processes,
    Seconds,
    Windows,
    argument,
    flag,
    option,
    require_few,
    windows_of_study,
)
from dwell.cli.output import file_name, interrupted, print_json, progress, warn, working
from dwell.model.bounds import counted

if TYPE_CHECKING:
    from dwell.model.progress import Progress
    from dwell.study import Study, StudyResult
    from dwell.study.metric import Metric

# Groups of a point and a scenario that the terminal shows; the tables have all.
SHOWN = 40


def study(
    file: Annotated[Path, argument("FILE", "Study file (YAML).")],
    out: Annotated[
        Path | None, option("FOLDER", "Folder for parts and tables.", default="studies/NAME")
    ] = None,
    processes: Processes = None,
    dask: Annotated[
        str | None, option("ADDRESS", "Scheduler of a Dask cluster that simulates.")
    ] = None,
    seeds: Annotated[
        int | None,
        option(
            "N", "Seeds 1 to N of every run.", default="the file's", min=1, callback=require_few
        ),
    ] = None,
    windows: Windows = None,
    seconds: Seconds = None,
    shard: Annotated[
        str | None,
        option("I/N", "Simulate one of N shards, in its own folder."),
    ] = None,
    merge: Annotated[
        bool, flag("--merge", "Merge all shards in the folder; simulate nothing.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Simulate all scenarios, policies and seeds of a study.

    Finished runs stay in the folder; the same command continues after an interruption. Runs have
    the file's length without --windows and --seconds. Several computers share a study with
    --shard; copy their shards into one folder and --merge them.
    """
    from dwell.estimators import unplayed
    from dwell.study import Shard, load_study, merge_shards, run_shard, run_study

    if merge and shard is not None:
        raise typer.BadParameter("give --shard or --merge")
    mine = None if shard is None else Shard.read(shard)
    plan = load_study(file)
    if seeds is not None:
        plan = replace(plan, seeds=tuple(range(1, seeds + 1)))
    windows = windows_of_study(windows, seconds, *(point.problem for point in plan.points))
    if windows is not None:
        plan = replace(plan, windows=windows)
    played = product(plan.points, plan.scenarios)
    late = (unplayed(point.problem, one, plan.windows) for point, one in played)
    warn(file, dict.fromkeys(chain.from_iterable(late)))
    folder = out or Path("studies", file_name(plan.name))
    if mine is not None:
        with _interruptible(mine.folder(folder), plan) as shown:
            runs = run_shard(
                plan, mine, folder=folder, processes=processes, dask=dask, progress=shown
            )
        found = {"study": plan.name, "folder": mine.folder(folder), "shard": shard, "runs": runs}
        if as_json:
            print_json(found)
        else:
            typer.echo(f"shard {shard}: {counted(runs, 'run')} in {mine.folder(folder)}")
        return
    if merge:
        with working("merging"):
            result = merge_shards(plan, folder)
    else:
        with _interruptible(folder, plan) as shown:
            result = run_study(plan, folder=folder, processes=processes, dask=dask, progress=shown)
    if as_json:
        with working("intervals"):
            table = result.table([metric.column for metric in _metrics(plan)]).to_dicts()
        head: dict[str, Any] = {"study": plan.name, "folder": folder}
        print_json({**head, "runs": result.runs.height, "table": table})
        return
    with working("intervals"):
        text = _text(result)
    typer.echo(f"{text}\n\ntables: {folder}")


@contextmanager
def _interruptible(folder: Path, study: Study) -> Iterator[Progress]:
    """Show progress; after Ctrl-C, say what is finished and how to go on."""
    done, of = 0, study.runs
    try:
        with progress("simulating", cycles=study.cycles / study.runs) as shown:

            def count(finished: int, total: int) -> None:
                nonlocal done, of
                done, of = finished, total
                if shown is not None:
                    shown(finished, total)

            yield count
    except KeyboardInterrupt:
        interrupted(
            f"{done} of {counted(of, 'run')} are finished and stay in {folder}; the same command "
            "continues"
        )


def _metrics(study: Study) -> list[Metric]:
    """Return the metrics on the terminal."""
    from dwell.study.metric import metric_of

    compared = ["regret", "oracle_regret"] if study.references else []
    columns = ["violation_rate", "cost", "migrations", *compared, *study.metrics]
    return [metric_of(column) for column in columns]


def _text(result: StudyResult) -> str:
    """Return one table per point and scenario."""
    from dwell.report.formatting import (
        few_seeds,
        independent_runs,
        shown_policy,
        shown_scenario,
    )
    from dwell.report.table import WITHOUT_WARMUP, Table, Text, table_text
    from dwell.study import over_seeds

    study = result.study
    metrics = _metrics(study)
    groups = len(study.points) * len(study.scenarios)
    # Intervals take time, so only the shown rows get them.
    some = result.runs.head(SHOWN * len(study.policies) * len(study.seeds))
    keys = (*result.parameters, "scenario", "policy")
    rows = over_seeds(some, keys, [metric.column for metric in metrics]).to_dicts()
    for row in rows:
        point = zip(study.parameters, result.parameters, strict=True)
        at = ", ".join(f"{name} = {row[column]}" for name, column in point)
        title = shown_scenario(row["scenario"])
        row |= {"policy": shown_policy(row["policy"]), "group": f"{title} ({at})" if at else title}
    lines = [table_text(Table("", "", [Text("policy", ""), *metrics], rows, Text("group", "")))]
    seeds = len(study.seeds)
    means = f"Mean over {seeds} seeds, with its 95 % interval" if seeds > 1 else "One seed"
    notes = few_seeds(seeds) or "."
    lines.append(f"{means}{notes} {WITHOUT_WARMUP}{independent_runs(result.runs)}")
    if groups > SHOWN:
        lines.append(f"{SHOWN} of {groups} tables are shown; runs.parquet has all runs.")
    return "\n".join(lines)
