"""The report of a study: a measure over any of its parameters, by scenario and policy."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import TYPE_CHECKING

from dwell.model.bounds import counted
from dwell.report.charts import NO_LIMIT, curves
from dwell.report.figure import Figure
from dwell.report.formatting import Measure
from dwell.report.method import numbered
from dwell.report.page import Block, Definitions, Page, Section, page_html
from dwell.report.policy_blocks import COST, L95, RATE, THE_AIM, PolicyBlocks, named, scaled
from dwell.report.table import Table, Text
from dwell.study import StudyRuns, over_seeds

if TYPE_CHECKING:
    import polars as pl

REGRET = Measure("regret", "regret", "%", 100.0)
MIGRATIONS = Measure("migrations", "migrations")


def study_html(study: StudyRuns, *, static: bool = False) -> str:
    """Return a page about a study; see `dwell.report.page.page_html`."""
    return page_html(study_page(study), static=static)


def study_page(study: StudyRuns, *, sections: int | None = None) -> Page:
    """Return what there is to show of a study; its first `sections` only, the answer first."""
    blocks = PolicyBlocks(study)
    points = study.runs.select(study.parameters).unique().height if study.parameters else 1
    return Page(
        title=f"Study {study.name}",
        subtitle=f"{counted(study.runs.height, 'run')}: "
        f"{counted(len(study.scenarios), 'scenario')}, "
        f"{counted(len(study.policies), 'policy')}, {counted(points, 'point')}, "
        f"{numbered(study.seeds)}, {counted(study.windows, 'window')}",
        sections=list(islice(_sections(study, blocks), sections)),
        policies=blocks.colours,
        seeds=() if study.parameters else study.seeds,
    )


def _sections(study: StudyRuns, blocks: PolicyBlocks) -> Iterator[Section]:
    if study.parameters:
        for place, (parameter, *others) in enumerate(study.axes):
            shown = study.shown_parameter(parameter)
            together = {"together with it": ", ".join(map(study.shown_parameter, others))}
            figures: list[Block] = []
            tables: list[Block] = []
            for measure in _measures(study):
                means = _means(study, parameter, measure)
                figures.append(_curve(means, blocks, parameter, measure, place))
                tables.append(_pivot(means, blocks, parameter, measure, place))
            yield Section(
                f"By {shown}",
                [*([Definitions(together)] if others else []), figures[0], tables[0]],
                note="Means over the other parameters and seeds; intervals are over seeds, of "
                "their means.",
            )
            yield Section(f"More by {shown}", [*figures[1:], *tables[1:]], folded=True)
        yield Section("Every point", [_points(study, blocks)], folded=True)
    else:
        yield Section("", blocks.answer())
        yield Section("Results", [blocks.results()])
        figures = [blocks.tail(), blocks.measure(COST, title="J"), blocks.distribution()]
        if REGRET in _measures(study):
            figures.append(blocks.measure(REGRET, title="Regret"))
        yield Section("Figures", [*figures, *blocks.placed(), blocks.split()])
        yield Section("More numbers", [blocks.more()])
    method = blocks.method(
        runs=f"{counted(study.windows, 'window')}, {numbered(study.seeds)}",
        intervals="95 %, two-sided, over seeds, by the studentised bootstrap, each on its own",
    )
    yield Section("How it was made", method)


def _measures(study: StudyRuns) -> list[Measure]:
    measures = (RATE, L95, COST, MIGRATIONS, REGRET)
    return [one for one in measures if one.column in study.runs.columns]


def _means(study: StudyRuns, parameter: str, measure: Measure) -> pl.DataFrame:
    """Return a measure by a parameter's values: means over the others, a run a seed."""
    import polars as pl

    keys = ("scenario", "policy", parameter)
    runs = study.runs.group_by(*keys, "seed", maintain_order=True).agg(
        pl.col(measure.column).cast(pl.Float64).mean()
    )
    return over_seeds(runs, keys, [measure.column])


def _curve(
    means: pl.DataFrame, blocks: PolicyBlocks, parameter: str, measure: Measure, place: int
) -> Figure:
    import polars as pl

    limits = {RATE.column: THE_AIM, L95.column: blocks.deadline}
    shown = blocks.found.shown_parameter(parameter)
    table = scaled(means, measure)
    at = table[parameter]
    rows = table.with_columns(at=at if at.dtype.is_numeric() else at.cast(pl.String))
    frame = named(rows.select("scenario", "policy", "at", "mean", "low", "high"))
    if at.dtype.is_numeric():
        frame = frame.sort("at", maintain_order=True)
    draw = curves(frame, measure, blocks.styles, shown, limits.get(measure.column, NO_LIMIT))
    return Figure(f"{measure.column}-{place}", f"{measure.name} by {shown}", {"rows": frame}, draw)


def _pivot(
    means: pl.DataFrame, blocks: PolicyBlocks, parameter: str, measure: Measure, place: int
) -> Table:
    """Return a measure, a row a policy and scenario and a column a value of the parameter."""
    values = [str(value) for value in means[parameter].unique(maintain_order=True)]
    rows: dict[tuple[str, str], dict[str, object]] = {}
    for row in means.iter_rows(named=True):
        key = row["scenario"], row["policy"]
        mine = rows.setdefault(key, {"scenario": key[0], "policy": key[1]})
        for end in ("", "_low", "_high"):
            mine[f"{row[parameter]}{end}"] = row[f"{measure.column}{end}"]
    columns = [measure._replace(column=value, name=value, unit="") for value in values]
    return Table(
        f"pivot-{measure.column}-{place}",
        f"{measure.heading} by {blocks.found.shown_parameter(parameter)}",
        [Text("policy", "policy", "policy"), *columns],
        list(rows.values()),
        Text("scenario", "", "scenario"),
        palette=blocks.palette,
    )


def _points(study: StudyRuns, blocks: PolicyBlocks) -> Table:
    """Return every point, scenario and policy."""
    measures = _measures(study)
    keys = (*study.parameters, "scenario", "policy")
    table = over_seeds(study.runs, keys, [one.column for one in measures])
    return Table(
        "points",
        "Every point",
        [
            Text("policy", "policy", "policy"),
            *(Text(name, study.shown_parameter(name)) for name in study.parameters),
            *measures,
        ],
        table.to_dicts(),
        Text("scenario", "", "scenario"),
        palette=blocks.palette,
    )
