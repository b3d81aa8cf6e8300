"""Figures and tables of comparisons, studies and campaigns, by scenario and policy."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.display import Measure
from dwell.model.bounds import counted
from dwell.model.objective import AIM
from dwell.model.table_columns import SHARE_OF, USE_OF
from dwell.policies.registry import estimator_of
from dwell.report.charts import (
    NO_LIMIT,
    PART_COLOURS,
    PARTS_SHOWN,
    Limit,
    distributions,
    intervals,
    latency_limit,
    stacked,
)
from dwell.report.figure import Figure
from dwell.report.formatting import OURS, shown_contender, shown_policy, shown_scenario
from dwell.report.method import method_blocks, placements_table
from dwell.report.page import Block, Definitions
from dwell.report.palette import Palette
from dwell.report.table import WITHOUT_WARMUP, Columns, Table, Text
from dwell.report.topology import topology
from dwell.study import over_seeds, under, windows_behind
from dwell.study.metric import METRICS, further_columns, metric_of

if TYPE_CHECKING:
    import polars as pl

    from dwell.study import StudyRuns

#: Metrics of the table of results, and of the table of further numbers, by column.
RESULTS = ("violation_rate", "l95_ms", "cost", "u_robot", "u_edge", "migrations")
MORE = (
    *("p95_ms", "lost", "compute_ms", "queue_ms", "network_ms", "longest_misses"),
    *("misses_in_20", "over_5_in_100", "aoi_mean_ms", "aoi_p95_ms", "aoi_peak_ms"),
    "tracking_rms_mm",
)
#: Most columns of a table on a page, next to the names of policies.
MOST_COLUMNS = 5
#: In percent.
THE_AIM = Limit(100 * AIM, "the aim, 5 %")
#: Pattern of the only sentence that code makes of numbers (docs/background/decisions.md).
HEADLINE = "V_D under 5 %: {most} in {count} of {of} scenarios; in all: {all}; not shown: {open}."
KEYS = ("scenario", "policy")
#: Approximate largest number of points of a line: bins of the logarithmic axis.
POINTS = 60
LEAST_SHARE = 1e-4


class PolicyBlocks:
    """Figures and tables of the runs of a comparison, a study or a campaign.

    The names of figures and tables begin with `prefix`, which keeps them unique in a page.
    """

    def __init__(self, found: StudyRuns, prefix: str = "") -> None:
        self.found = found
        self.problem, self.runs, self.latencies = found.problem, found.runs, found.latencies
        self.prefix = prefix
        self.deadline = Limit(found.problem.pipeline.deadline_ms, "deadline")
        self.latency_limit = latency_limit(found.problem)
        # From the runs: references have runs, too, although they do not compete.
        self.scenarios, self.policies = (
            [str(name) for name in self.runs[column].unique(maintain_order=True)]
            for column in ("scenario", "policy")
        )
        self.palette = Palette.of(
            self.problem.candidates, self.policies, estimator_of(self.problem)
        )
        #: Styles by the names of policies in figures.
        self.styles = {shown_contender(name): self.palette.policies[name] for name in self.policies}

    @property
    def colours(self) -> dict[str, str]:
        """Colours by the names of policies in figures."""
        return {name: style.colour for name, style in self.styles.items()}

    def answer(self) -> list[Block]:
        """Return the first blocks of a page: V_D of all policies, and counts under the aim."""
        return [self.rate(), self.counts()]

    def cell(self) -> list[Block]:
        """Return the drawing of the cell, and its placements with the nodes of movable tasks."""
        slug = f"{self.prefix}topology"
        return [topology(self.problem, slug), placements_table(self.problem, self.prefix)]

    def method(self, **about: str) -> list[Block]:
        """Return descriptions of cell, scenarios, policies and versions, and the terms `about`."""
        found = self.found
        versions = ", ".join(f"{name} {text}" for name, text in found.versions.items())
        return [
            *method_blocks(self.problem, found.scenarios, found.policies, self.prefix),
            Definitions({**about, "versions": versions}),
        ]

    # ------------------------------------------------------------------------------- figures

    def measure(
        self, measure: Measure, *, limit: Limit = NO_LIMIT, title: str = "", caption: str = ""
    ) -> Figure:
        """Draw a measure: means with intervals, and every seed; the limit in the shown unit."""
        import polars as pl

        seeds = self.runs.select(
            *KEYS, "seed", value=pl.col(measure.column).cast(pl.Float64) * measure.factor
        )
        means = scaled(over_seeds(self.runs, KEYS, [measure.column]), measure)
        rows = [means.select(*KEYS, "mean", "low", "high"), seeds]
        frame = named(pl.concat(rows, how="diagonal_relaxed"))
        draw = intervals(frame, measure, self.styles, limit)
        return Figure(f"{self.prefix}{measure.column}", title, {"rows": frame}, draw, caption)

    def rate(self) -> Figure:
        """Draw V_D with the aim of 5 %."""
        return self.measure(
            METRICS["violation_rate"],
            limit=THE_AIM,
            title="V_D, the share of missed deadlines",
            caption=(
                "Marks: means over seeds; bars: their 95 % intervals; ticks: single seeds. "
                "Dashed: the aim of 5 %."
            ),
        )

    def tail(self) -> Figure:
        """Draw L95 with its limit."""
        return self.measure(
            METRICS["l95_ms"],
            limit=self.latency_limit,
            title=f"L95, the 95th percentile of {self._latencies()}, mean over windows",
            caption=(
                "As the controller sees it: a cycle that has not finished counts with its age. "
                f"Dashed: {self.latency_limit.name}."
            ),
        )

    def _latencies(self) -> str:
        """Return what L95 is of."""
        chain = self.problem.objective.latency
        return "a window’s latencies" if chain is None else f"a window’s data ages of {chain}"

    def distribution(self) -> Figure:
        """Draw the distributions of latency."""
        import polars as pl

        parts = []
        for _, mine in self.latencies.group_by(KEYS, maintain_order=True):
            longer = 1 - mine["share"].to_numpy()
            bins = np.round(np.log10(np.maximum(longer, LEAST_SHARE)) * POINTS / 4)
            keep = np.flatnonzero(np.diff(bins, prepend=math.inf))
            line = mine[keep].select(*KEYS, "latency_ms", longer=1 - pl.col("share"))
            # From latency 0, so that the line of equal latencies has its step, too.
            parts += [line.head(1).with_columns(latency_ms=0.0, longer=1.0), line]
        frame = named(pl.concat(parts))
        return Figure(
            f"{self.prefix}latencies",
            "Cycles that took longer than a latency",
            {"rows": frame},
            distributions(frame, self.styles, self.problem.pipeline.deadline_ms),
            "All cycles after the warm-up, all seeds together, on a logarithmic scale. Dashed: "
            "deadline, where one reads V_D; dotted: 5 %. A line that ends on a plateau lost "
            "that share of its cycles.",
        )

    def placed(self) -> list[Figure]:
        """Draw the shares of windows by placement, if at least one policy can move."""
        candidates = self.problem.candidates
        moving = [name for name in self.policies if name not in candidates]
        columns = {f"share_{name}": name for name in candidates}
        if not moving or not set(columns) <= set(self.runs.columns):
            return []
        frame = self._parts({name: (shown, 100.0) for name, shown in columns.items()}, moving)
        shown = [shown_contender(name) for name in moving]
        draw = stacked(frame, shown, self.palette.placements, "share of the windows (%)")
        title = "Where the policies that move spent their windows"
        return [Figure(f"{self.prefix}shares", title, {"rows": frame}, draw)]

    def split(self) -> Figure:
        """Draw the parts of the mean latency of finished cycles."""
        columns = {f"{part}_ms": (shown, 1.0) for part, shown in PARTS_SHOWN.items()}
        frame = self._parts(columns, self.policies)
        heading = "mean latency of finished cycles (ms)"
        return Figure(
            f"{self.prefix}split",
            "Where the time goes along the critical path",
            {"rows": frame},
            stacked(frame, list(self.styles), PART_COLOURS, heading, self.deadline),
            "Lost cycles are not in it. Dashed: deadline.",
        )

    def _parts(
        self, columns: Mapping[str, tuple[str, float]], policies: Sequence[str]
    ) -> pl.DataFrame:
        """Return means over seeds as ``scenario``, ``policy``, ``part`` and ``value``."""
        import polars as pl

        means = (
            self.runs.filter(pl.col("policy").is_in(list(policies)))
            .group_by(KEYS, maintain_order=True)
            .agg(
                pl.col(name).cast(pl.Float64).mean() * factor
                for name, (_, factor) in columns.items()
            )
        )
        parts = means.unpivot(list(columns), index=KEYS, variable_name="part", value_name="value")
        names = {name: shown for name, (shown, _) in columns.items()}
        return named(parts.with_columns(part=pl.col("part").replace_strict(names)))

    # -------------------------------------------------------------------------------- tables

    def standing(self, scenario: str, policy: str) -> str:
        """Return the verdict on V_D under 5 % (docs/background/statistics.md); "" without runs."""
        mine = self.runs.filter(scenario=scenario, policy=policy)
        if mine.is_empty():
            return ""
        return under(mine["violation_rate"].to_list(), AIM, windows=windows_behind(mine))

    def standings(self) -> dict[str, Counter[str]]:
        """Return the number of scenarios per verdict on V_D, by policy."""
        return {
            policy: Counter(self.standing(scenario, policy) for scenario in self.scenarios)
            for policy in self.policies
        }

    def headline(self) -> str:
        """Return a sentence on the policies under the aim in most and in all scenarios.

        It also lists the policies without a verdict. An empty list is `none`.
        """
        counts, of = self.standings(), len(self.scenarios)
        best = max(words["under"] for words in counts.values())

        def listed(names: Iterable[str]) -> str:
            return ", ".join(names) or "none"

        def under_in(count: int) -> str:
            return listed(shown_policy(name) for name in counts if counts[name]["under"] == count)

        return HEADLINE.format(
            most=under_in(best) if best else "none",
            count=best or "any",
            of=of,
            all=under_in(of),
            open=listed(
                f"{shown_policy(name)} in {words['not shown']}"
                for name, words in counts.items()
                if words["not shown"]
            ),
        )

    def counts(self) -> Table:
        """Return a table of the numbers of scenarios per verdict on V_D, by policy."""
        rows = [
            {"policy": policy, **{word: words[word] for word in ("under", "over", "not shown")}}
            for policy, words in self.standings().items()
        ]
        columns: Columns = [
            Text("policy", "policy", "policy"),
            *(Measure(word, word) for word in ("under", "over", "not shown")),
        ]
        return Table(
            f"{self.prefix}counts",
            "V_D and the aim of 5 %, number of scenarios",
            columns,
            rows,
            caption=f"By one-sided 95 % limits over seeds. {WITHOUT_WARMUP}",
            palette=self.palette,
        )

    def results(self, *, compact: bool = False) -> Table:
        """Return a table of the metrics of every policy in every scenario.

        For a terminal, `compact` leaves out the intervals of utilisations and shows the larger
        half of the others.
        """
        shares = [
            metric_of(column)
            for name in self.problem.candidates
            if (column := SHARE_OF.format(candidate=name)) in self.runs.columns
        ]
        metrics = [METRICS[column] for column in RESULTS]
        table = self._table([*metrics, *shares])
        rows = [
            {**row, "is": self.standing(row["scenario"], row["policy"])} for row in table.to_dicts()
        ]
        # The table has no room for the intervals of shares.
        bare = [*shares, *(metrics[3:5] if compact else ())]
        for row in rows:
            for measure in bare:
                row.pop(f"{measure.column}_low")
        first, *others = metrics
        columns: Columns = [
            Text("policy", "policy", "policy"),
            first,
            Text("is", "5 %", "word"),
            *others,
            *shares,
        ]
        return Table(
            f"{self.prefix}results",
            "Every policy in every scenario",
            columns,
            rows,
            Text("scenario", "", "scenario"),
            f"Means over {counted(len(set(self.runs['seed'])), 'seed')} with their 95 % intervals"
            f"{' (±: their larger half)' if compact else ''}. L95: 95th "
            f"percentile of {self._latencies()}, mean over windows. U_r, U_e: busiest robot and "
            "edge node. Last columns: share of the windows under each placement. "
            f"{WITHOUT_WARMUP} {OURS}",
            self.palette,
            compact,
        )

    def more(self) -> Table:
        """Return further numbers of every policy in every scenario."""
        used = [USE_OF.format(resource=name) for name in self.problem.fabric.resources]
        further = further_columns(self.problem.pipeline.chains)
        known = (*MORE, *further, *used, *self.found.metrics)
        metrics = [metric_of(column) for column in known if column in self.runs.columns]
        return Table(
            f"{self.prefix}more",
            "More numbers",
            [Text("policy", "policy", "policy"), *metrics],
            self._table(metrics).to_dicts(),
            Text("scenario", "", "scenario"),
            "P95 counts lost cycles as infinite: median over seeds. Computing, waiting, network: "
            "means over finished cycles. Misses in any 20 and any 100 cycles that follow each "
            "other. Age: of the newest command in effect, from its cycle’s release. "
            f"{WITHOUT_WARMUP}",
            self.palette,
        )

    def _table(self, measures: Sequence[Measure]) -> pl.DataFrame:
        return over_seeds(self.runs, KEYS, [one.column for one in measures])


def named(frame: pl.DataFrame, columns: Sequence[str] = KEYS) -> pl.DataFrame:
    """Return rows with the names of scenarios and policies in figures."""
    import polars as pl

    shown = {"scenario": shown_scenario, "policy": shown_contender}
    return frame.with_columns(
        pl.col(name).cast(pl.String).map_elements(shown[name], return_dtype=pl.String)
        for name in columns
    )


def scaled(frame: pl.DataFrame, measure: Measure) -> pl.DataFrame:
    """Return a frame of `dwell.study.over_seeds` with columns ``mean``, ``low`` and ``high``.

    The columns have a measure in its shown unit.
    """
    import polars as pl

    names = {"mean": "", "low": "_low", "high": "_high"}
    return frame.with_columns(
        (pl.col(f"{measure.column}{end}").cast(pl.Float64) * measure.factor).alias(name)
        for name, end in names.items()
    )
