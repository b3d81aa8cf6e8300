"""The report of a study: a measure over any of its parameters, by scenario and policy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

from dwell.display import Measure
from dwell.model.bounds import counted
from dwell.report.charts import NO_LIMIT, curves
from dwell.report.figure import Figure
from dwell.report.formatting import few_seeds, independent_runs
from dwell.report.method import numbered
from dwell.report.page import Block, Definitions, Page, Section, page_html
from dwell.report.policy_blocks import MOST_COLUMNS, THE_AIM, PolicyBlocks, named, scaled
from dwell.report.table import WITHOUT_WARMUP, Table, Text
from dwell.study import StudyRuns, over_seeds
from dwell.study.metric import Metric, further_columns, metric_of

if TYPE_CHECKING:
    import polars as pl

#: Metrics by column.
SHOWN = ("violation_rate", "l95_ms", "cost", "migrations", "regret", "oracle_regret")
#: Parameters that change the limit of L95; a chain's limit has the chain's name in its path.
LIMITS = ("parameter.deadline_ms", "parameter.period_ms", "parameter.objective.latency")


def study_html(study: StudyRuns, *, static: bool = False) -> str:
    """Return a page about a study; see `dwell.report.page.page_html`."""
    return page_html(study_page(study), static=static)


def study_page(study: StudyRuns, *, sections: int | None = None) -> Page:
    """Return the page of a study, the answer first; `sections` limits its sections."""
    blocks = PolicyBlocks(study)
    points = study.runs.select(study.parameters).unique().height if study.parameters else 1
    return Page(
        title=f"Study {study.name}",
        subtitle=f"{counted(study.runs.height, 'run')}: "
        f"{counted(len(study.scenarios), 'scenario')}, "
        f"{counted(len(study.policies), 'policy')}, {counted(points, 'point')}, "
        f"{numbered(study.seeds)}, {counted(study.windows, 'window')}{few_seeds(len(study.seeds))}",
        sections=list(islice(_sections(study, blocks), sections)),
        policies=blocks.colours,
        seeds=() if study.parameters else study.seeds,
    )


def _sections(study: StudyRuns, blocks: PolicyBlocks) -> Iterator[Section]:
    if study.parameters:
        for place in range(len(study.axes)):
            yield from _by_axis(study, blocks, place)
        yield Section("The cell and its placements", blocks.cell())
        yield Section("Every point", [_points(study, blocks)], folded=True)
    else:
        yield Section("", blocks.answer())
        yield Section("The cell and its placements", blocks.cell())
        yield Section("Results", blocks.results().parts(MOST_COLUMNS))
        columns = ["cost", "regret", "oracle_regret", *study.metrics]
        drawn = [metric_of(name) for name in columns if name in study.runs.columns]
        figures = [blocks.tail(), blocks.distribution()]
        figures += [blocks.measure(metric, title=metric.title) for metric in drawn]
        yield Section("Figures", [*figures, *blocks.placed(), blocks.split()])
        yield Section("More numbers", blocks.more().parts(MOST_COLUMNS), folded=True)
    method = blocks.method(
        runs=f"{counted(study.windows, 'window')}, {numbered(study.seeds)}",
        intervals="95 %, two-sided, over seeds, by the studentised bootstrap, each on its own."
        f"{independent_runs(study.runs)}",
    )
    yield Section("Method", method, folded=True)


def _metrics(study: StudyRuns) -> list[Metric]:
    columns = (*SHOWN, *further_columns(study.problem.pipeline.chains), *study.metrics)
    return [metric_of(name) for name in columns if name in study.runs.columns]


@dataclass(frozen=True, slots=True)
class _View:
    """The results of a study along one axis of parameters.

    Parameters
    ----------
    place : int
        Index of the axis in the study.
    at : str
        Column of the parameter along the axis.
    panels : tuple of str
        Column of the parameter with one panel and one row per value; empty without a second axis.
    averaged : tuple of str
        Columns of the parameters that means are taken over.
    """

    study: StudyRuns
    place: int
    at: str
    panels: tuple[str, ...]
    averaged: tuple[str, ...]

    @property
    def shown(self) -> str:
        """Name of the parameter along the axis."""
        return self.study.shown_parameter(self.at)

    @property
    def shown_averaged(self) -> str:
        """Names of the parameters that means are taken over."""
        return ", ".join(map(self.study.shown_parameter, self.averaged))

    def means(self, measure: Measure) -> pl.DataFrame:
        """Return the means of a measure over seeds, by scenario, policy, panel and value.

        The runs of each seed are averaged first.
        """
        import polars as pl

        keys = ("scenario", "policy", *self.panels, self.at)
        runs = self.study.runs.group_by(*keys, "seed", maintain_order=True).agg(
            pl.col(measure.column).cast(pl.Float64).mean(), pl.col("windows").sum()
        )
        return over_seeds(runs, keys, [measure.column])


def _by_axis(study: StudyRuns, blocks: PolicyBlocks, place: int) -> Iterator[Section]:
    """Yield the sections of an axis: panels by the first other axis, means over the rest."""
    axes = list(study.axes)
    at, *together = axes.pop(place)
    first = [axis[0] for axis in axes]
    view = _View(study, place, at, tuple(first[:1]), tuple(first[1:]))
    about = {
        "together with it": ", ".join(map(study.shown_parameter, together)),
        "averaged over": view.shown_averaged,
    }
    said = {term: meaning for term, meaning in about.items() if meaning}
    figures: list[Block] = []
    tables: list[Block] = []
    for measure in _metrics(study):
        means = view.means(measure)
        figures.append(_curve(means, blocks, view, measure))
        tables.append(_pivot(means, blocks, view, measure))
    yield Section(
        f"By {view.shown}",
        [*([Definitions(said)] if said else []), figures[0], tables[0]],
        note="Means over seeds with their 95 % intervals.",
    )
    yield Section(f"More by {view.shown}", [*figures[1:], *tables[1:]], folded=True)


def _curve(means: pl.DataFrame, blocks: PolicyBlocks, view: _View, measure: Measure) -> Figure:
    import polars as pl

    at = means[view.at]
    columns = ["scenario", "policy", "at", "mean", "low", "high"]
    rows = scaled(means, measure).with_columns(
        at=at if at.dtype.is_numeric() else at.cast(pl.String),
        averaged_over=pl.lit(view.shown_averaged),
    )
    for name in view.panels:
        shown = pl.lit(view.study.shown_parameter(name))
        rows = rows.with_columns(panel=pl.format("{}: {}", shown, pl.col(name)))
        columns.append("panel")
    if view.averaged:
        columns.append("averaged_over")
    frame = named(rows.select(columns))
    if at.dtype.is_numeric():
        frame = frame.sort("at", maintain_order=True)
    limits = {"violation_rate": THE_AIM}
    if not any(name.startswith((*LIMITS, "parameter.chains")) for name in view.study.parameters):
        limits["l95_ms"] = blocks.latency_limit
    remark = f"averaged over {view.shown_averaged}" if view.averaged else ""
    draw = curves(
        frame, measure, blocks.styles, view.shown, limits.get(measure.column, NO_LIMIT), remark
    )
    title = f"{measure.name} by {view.shown}"
    return Figure(f"{measure.column}-{view.place}", title, {"rows": frame}, draw)


def _pivot(means: pl.DataFrame, blocks: PolicyBlocks, view: _View, measure: Measure) -> Table:
    """Return a table of a measure: rows by scenario, policy and panel, columns by value."""
    values = [str(value) for value in means[view.at].unique(maintain_order=True)]
    texts = {
        **{name: view.study.shown_parameter(name) for name in view.panels},
        **({"averaged_over": "averaged over"} if view.averaged else {}),
    }
    rows: dict[tuple[object, ...], dict[str, object]] = {}
    for row in means.iter_rows(named=True):
        keys = {name: row[name] for name in ("scenario", "policy", *view.panels)}
        mine = rows.setdefault(tuple(keys.values()), {**keys, "averaged_over": view.shown_averaged})
        for end in ("", "_low", "_high"):
            mine[f"{row[view.at]}{end}"] = row[f"{measure.column}{end}"]
    columns = [replace(measure, column=value, name=value, unit="") for value in values]
    return Table(
        f"pivot-{measure.column}-{view.place}",
        f"{measure.heading} by {view.shown}",
        [
            Text("policy", "policy", "policy"),
            *(Text(column, name) for column, name in texts.items()),
            *columns,
        ],
        sorted(rows.values(), key=lambda row: blocks.scenarios.index(str(row["scenario"]))),
        Text("scenario", "", "scenario"),
        WITHOUT_WARMUP,
        blocks.palette,
    )


def _points(study: StudyRuns, blocks: PolicyBlocks) -> Table:
    """Return a table with one row per point, scenario and policy."""
    measures = _metrics(study)
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
        WITHOUT_WARMUP,
        blocks.palette,
    )
