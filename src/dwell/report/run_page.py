"""Report of a single run: its metrics over time, its worst windows, and its decisions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.display import Measure, decimals_for, write_number
from dwell.model.bounds import counted
from dwell.model.placement import written_nodes
from dwell.record import OUTCOME_SENTENCES, REASON_SENTENCES, shown_reason
from dwell.record.moves import Move, moves_in
from dwell.report.charts import (
    OUTLINE,
    PART_COLOURS,
    PARTS_SHOWN,
    Limit,
    coloured,
    distributions,
    in_order,
    latency_limit,
    layer,
    limit_rule,
    names,
    quantity,
    stacked,
    thinned,
)
from dwell.report.figure import Figure
from dwell.report.formatting import (
    FINAL_L95,
    percent,
    shown_policy,
    shown_scenario,
    write_ms,
)
from dwell.report.move_blocks import move_blocks
from dwell.report.page import Definitions, Fact, Page, Section, page_html
from dwell.report.palette import BAD, Palette
from dwell.report.phases import phase_rows, phase_table
from dwell.report.run_header import RunHeader
from dwell.report.table import MOST_ROWS, WITHOUT_WARMUP, Columns, Table, Text
from dwell.report.timeline import begins_by_number, resources_in, run_timeline
from dwell.report.topology import topology
from dwell.study.metric import METRICS, further_columns, metric_of
from dwell.study.other_placements import PLACEMENTS
from dwell.study.predicted_moves import predicted_moves
from dwell.study.summary import (
    Counted,
    count_in,
    due_cycles,
    latency_ms,
    summarise,
)
from dwell.study.verdict import verdict_of

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

WORST = 10
#: Largest number of labels of cycles in a figure.
LABELS = 25
#: Largest error of the clocks in a proven window, as a share of the deadline.
PROVEN_SHARE = 0.2


def run_html(run: Run, *, static: bool = False) -> str:
    """Return a page about a run, simulated or live; see `dwell.report.page.page_html`.

    Raises
    ------
    RunError
        If the run's record is incomplete.
    SimulationError
        If the run has no window after its warm-up.
    """
    return page_html(run_page(run), static=static)


def run_page(run: Run, *, sections: int | None = None) -> Page:
    """Return the page of a run, the answer first; `sections` limits its sections."""
    header = RunHeader.of(run)
    counted = count_in(run, header.problem.window_cycles)
    return _RunPage(run, header, counted, sections).page()


class _RunPage:
    """The parts of the page of a run."""

    def __init__(self, run: Run, header: RunHeader, counted: Counted, sections: int | None) -> None:
        self.run = run
        self.most = sections
        self.header = header
        self.counted, self.row = counted, summarise(run, header.problem, {}).row
        self.palette = Palette.of(header.problem.candidates)
        self.begin_s = _begins(run, header)
        numbers = run.windows["window"].to_list()
        self.begin_of = dict(zip(numbers, self.begin_s.tolist(), strict=True))
        self.worst = counted.windows.sort(
            "violation_rate", "seen_l95_ms", descending=True, nulls_last=True, maintain_order=True
        ).head(WORST)

    def page(self) -> Page:
        header, windows = self.header, self.counted.windows.height
        width = counted(header.problem.window_cycles, "cycle")
        minutes = self.counted.cycles.height * header.problem.pipeline.period_ms / 60e3
        return Page(
            title=f"{self._policy()} on {header.problem.name}",
            subtitle=" · ".join(
                (
                    header.kind if header.live else f"{header.kind}, seed {header.seed}",
                    f"scenario {shown_scenario(header.scenario)}",
                    f"{counted(windows, 'window')} of {width} after the warm-up",
                    f"{write_number(minutes, decimals_for(minutes, 1))} minutes",
                )
            ),
            facts=list(self._facts()),
            sections=list(islice(self._sections(), self.most)),
        )

    def _policy(self) -> str:
        """Return the name of the policy, or of the placement if the policy is static."""
        if self.header.policy_name == "Static":
            return str(self.counted.windows["placement"][0])
        return shown_policy(self.header.policy_name)

    def _facts(self) -> Iterator[Fact]:
        row = {name: value for name, value in self.row.items() if not isinstance(value, str)}
        verdict = verdict_of(self.run, self.header.problem, row["violation_rate"])
        remarks = {
            "violation_rate": f"aim: under {percent(verdict.aim)}",
            "p95_ms": f"deadline {write_ms(self.header.deadline_ms)}",
            "longest_misses": "",
            "cost": "",
            "migrations": f"{row['returns']} undone",
            **({"guard_moves": ""} if row["guard_moves"] else {}),
        }
        for column, remark in remarks.items():
            word = verdict.word if column == "violation_rate" else ""
            metric = METRICS[column]
            yield Fact(metric.title, metric.text(row[column]), remark, word)
        chains = self.header.problem.pipeline.chains
        for metric in map(metric_of, further_columns(chains)):
            if metric.column in row:
                yield Fact(metric.title, metric.text(row[metric.column]), "")
        yield Fact("cycles", write_number(row["cycles"], 0))

    def _sections(self) -> Iterator[Section]:
        yield Section("", [self._timeline(), *self._phases()])
        if placements := self.run.meta.get(PLACEMENTS):
            yield Section("If it never moved", [self._never_moving(placements)])
        yield Section("The cell", [topology(self.header.problem)])
        yield Section("Worst windows", [self._worst_table()])
        for window in self.worst.iter_rows(named=True):
            number = window["window"]
            yield Section(
                f"Cycles of window {number}",
                [self._cycles(window)],
                anchor=f"window-{number}",
                folded=True,
            )
        yield Section("Latency", self._latencies())
        yield Section("Cycles and placements", [self._outcomes(), self._shares()])
        yield Section("Decisions", list(self._decisions()))
        moves = predicted_moves(self.run)
        if blocks := move_blocks(moves, self.palette, latency_limit(self.header.problem)):
            yield Section("Predicted, then seen", blocks)
        if self.header.live:
            yield Section("How well this is known", [self._known()])
        yield Section("What this is", [self._about()])

    # ------------------------------------------------------------------------------ in time

    def _timeline(self) -> Figure:
        # The targets of links are in later sections.
        worst = [] if self.most == 1 else self.worst["window"].to_list()
        links = {number: f"#window-{number}" for number in worst}
        return run_timeline(
            self.run.windows,
            self.run.decisions,
            self.begin_s,
            self.header.problem,
            slug="time",
            disturbed=self.header.disturbed,
            tracking=self.header.tracking,
            links=links,
            caption=(
                f"{self._seen_l95()}; a triangle at the top is a lost L95. Thin lines: J of the "
                f"other placements as the policy estimated it. Dashed: {self._limits()}. Upright "
                "lines: migrations; in colour, the guard's. Shaded: warm-up and disturbances. U: "
                "all of a node's load, foreign work included."
                f"{' Marks of the worst windows lead to their cycles.' if links else ''}"
            ),
        )

    def _seen_l95(self) -> str:
        """Return the meaning of L95 in the figure: of latencies, or of a chain's ages."""
        if (chain := self.header.problem.objective.latency) is not None:
            return f"L95 seen: of the data ages of {chain} at the window's close"
        return (
            "L95 seen: of the latencies at the window's close, where a cycle that has not finished "
            "counts with its age"
        )

    def _limits(self) -> str:
        """Return the names of the limits that the figure has."""
        limit = latency_limit(self.header.problem)
        return (
            f"the aim of 5 %, and the {limit.name}"
            if math.isfinite(limit.value)
            else "the aim of 5 %"
        )

    def _phases(self) -> Iterator[Table]:
        rows = phase_rows(self.run, self.header)
        if len(rows) > 1:
            yield phase_table(rows, self.palette)

    def _never_moving(self, placements: Mapping[str, Mapping[str, float]]) -> Table:
        """Return a table of the metrics of each placement without moves, and of this run."""
        rows: list[Mapping[str, object]] = [
            {"placement": name, **numbers} for name, numbers in placements.items()
        ]
        if self.header.policy_name != "Static":
            rows.append({**self.row, "placement": f"{self._policy()}, this run"})
        columns: Columns = [
            Text("placement", "placement", "placement"),
            *(METRICS[column] for column in ("violation_rate", "l95_ms", "cost")),
        ]
        caption = (
            "Each placement by itself, without moves, on the same random draws. At most 8 "
            f"placements are simulated. {WITHOUT_WARMUP}"
        )
        return Table("never-moving", "", columns, rows, caption=caption, palette=self.palette)

    # -------------------------------------------------------------------------- worst windows

    def _worst_table(self) -> Table:
        rows = [
            {**window, "begin_s": self.begin_of[window["window"]]}
            for window in self.worst.iter_rows(named=True)
        ]
        resources = resources_in(self.run.windows, self.header.problem)
        columns: Columns = [
            Text("window", "window", link="#window-{window}"),
            Measure("begin_s", "at", "s"),
            Text("placement", "placement", "placement"),
            METRICS["violation_rate"],
            FINAL_L95,
            METRICS["cost"],
            *(Measure(f"u_{name}", name, "%", 100.0, 0) for name in resources),
        ]
        caption = (
            "The windows with the most misses. L95 final: of the latencies that cycles had in the "
            "end, ∞ where more than 5 % never finished; the figure has what was seen at the close. "
            f"{WITHOUT_WARMUP}"
        )
        return Table("worst", "", columns, rows, caption=caption, palette=self.palette)

    def _cycles(self, window: Mapping[str, object]) -> Figure:
        """Draw the parts of the latency of every cycle of a window in which a sink is due."""
        import polars as pl

        first = int(str(window["first_cycle"]))
        last = first + self.header.problem.window_cycles - 1
        cycles = due_cycles(self.run.cycles.filter(pl.col("cycle").is_between(first, last)))
        frame = cycles.select(
            "cycle",
            pl.col("outcome").cast(pl.String),
            *((pl.col(f"{part}_ns") / 1e6).alias(name) for part, name in PARTS_SHOWN.items()),
            latency_ms=pl.col("latency_ns") / 1e6,
        )
        parts = frame.unpivot(
            list(PARTS_SHOWN.values()),
            index=["cycle", "outcome", "latency_ms"],
            variable_name="part",
            value_name="time_ms",
        )
        lost = frame.filter(pl.col("latency_ms").is_null()).select("cycle", "outcome")
        # Few labels save time: Vega measures every label before it drops overlapping labels.
        shown = cycles["cycle"].to_list()[:: -(-len(cycles) // LABELS)]
        axis = {"values": shown, "labelOverlap": True, "labelAngle": 0}
        across = {"field": "cycle", "type": "ordinal", "title": "cycle", "axis": axis}
        cycle, outcome = quantity("cycle", "cycle"), *names("outcome")
        time = {
            "x": across,
            "y": quantity("time_ms", "latency (ms)", axis={"tickCount": 4}),
            "color": coloured("part", PART_COLOURS),
            "tooltip": [
                cycle,
                *names("part"),
                quantity("time_ms", "ms"),
                quantity("latency_ms", "in all (ms)"),
                outcome,
            ],
        }
        top = {"x": across, "y": {"value": 6}, "tooltip": [cycle, outcome]}
        layers = [
            in_order(layer("bar", time, rows="parts", **OUTLINE), PART_COLOURS),
            *limit_rule("y", self.header.deadline_ms, "deadline"),
        ]
        if len(lost):
            layers.append(
                layer("point", top, rows="lost", shape="triangle-down", filled=True, color=BAD)
            )
        return Figure(
            f"cycles-{window['window']}",
            "",
            {"parts": parts, "lost": lost},
            lambda width: {"width": width - 90, "height": 110, "layer": layers},
            "Time along the critical path of every cycle that finished; dashed: deadline. A mark "
            "at the top: a cycle that was lost.",
        )

    # ------------------------------------------------------------------------------- latency

    def _latencies(self) -> list[Figure]:
        import polars as pl

        cycles = due_cycles(self.counted.cycles)
        cycles = cycles.with_columns(policy=pl.col("placement").cast(pl.String))
        used = [name for name in self.palette.placements if (cycles["policy"] == name).any()]
        lines, parts = [], []
        for name in used:
            mine = cycles.filter(pl.col("policy") == name)
            final_ms = np.sort(latency_ms(mine))
            finite = final_ms[np.isfinite(final_ms)]
            keep = thinned(len(finite))
            longer = 1 - (keep + 1) / len(final_ms)
            lines.append(pl.DataFrame({"latency_ms": finite[keep], "longer": longer}))
            lines[-1] = lines[-1].with_columns(policy=pl.lit(name))
            for part, shown in PARTS_SHOWN.items():
                mean = mine[f"{part}_ns"].cast(float).mean()
                parts.append((name, shown, _number(mean) / 1e6))
        tail = pl.concat(lines).filter(pl.col("longer") > 0).with_columns(scenario=pl.lit(""))
        split = pl.DataFrame(parts, schema=["policy", "part", "value"], orient="row")
        split = split.with_columns(scenario=pl.lit(""))
        styles = Palette.of(self.palette.placements, used).policies
        deadline = Limit(self.header.deadline_ms, "deadline")
        heading = "mean latency of finished cycles (ms)"
        return [
            Figure(
                "latencies",
                "Cycles that took longer than a latency, by placement",
                {"rows": tail},
                distributions(tail, styles, self.header.deadline_ms),
                "Of the cycles that were released under each placement, on a logarithmic "
                "scale. Dashed: deadline; dotted: 5 %. A line that ends on a plateau lost that "
                "share of its cycles.",
            ),
            Figure(
                "split",
                "Where the time goes along the critical path",
                {"rows": split},
                stacked(split, used, PART_COLOURS, heading, deadline),
                "Dashed: deadline.",
            ),
        ]

    # ------------------------------------------------------------------ outcomes and placements

    def _outcomes(self) -> Table:
        columns = (Text("outcome", "outcome"), Text("why", "meaning"))
        found = self.counted.cycles["outcome"]
        title = "What became of the cycles"
        return _counts("outcomes", title, columns, OUTCOME_SENTENCES, found, "cycles", 2)

    def _shares(self) -> Table:
        columns = (
            Text("placement", "placement", "placement"),
            Text("where", "tasks that not all have on one node"),
        )
        places = {name: _moving(self.header, name) for name in self.palette.placements}
        found = self.counted.windows["placement"]
        table = _counts("placements", "Where it was", columns, places, found, "windows", 0)
        return replace(table, palette=self.palette)

    # ----------------------------------------------------------------------------- decisions

    def _decisions(self) -> Iterator[Table]:
        decisions = self.counted.decisions
        counts = Counter(decisions["reason"].cast(str))
        rows = [
            {"reason": name, "meaning": text, "times": counts[name]}
            for name, text in REASON_SENTENCES.items()
            if counts[name]
        ]
        columns: Columns = [
            Text("reason", "reason"),
            Text("meaning", "meaning"),
            Measure("times", "times"),
        ]
        yield Table("reasons", "Why it was decided so", columns, rows, caption=WITHOUT_WARMUP)
        if "shadow_cycles" in self.counted.windows.columns:
            yield self._shadows()
        if found := moves_in(decisions):
            yield self._migrations(decisions, found)

    def _shadows(self) -> Table:
        windows = self.counted.windows
        cycles = windows.height * self.header.problem.window_cycles
        seconds = cycles * self.header.problem.pipeline.period_ms / 1e3
        sent = float(windows["shadow_bytes"].sum())
        resources = resources_in(windows, self.header.problem)
        used = {f"shadow_{name}": windows[f"shadow_{name}"].mean() for name in resources}
        row = {
            "cycles": float(windows["shadow_cycles"].sum()) / cycles,
            "rate_mbps": sent * 8e-6 / seconds,
            **used,
        }
        columns: Columns = [
            Measure("cycles", "cycles shadowed", "%", 100.0),
            Measure("rate_mbps", "sent more", "Mbit/s", decimals=2),
            *(Measure(name, f"of {name.removeprefix('shadow_')}", "%", 100.0, 2) for name in used),
        ]
        caption = (
            "Cycles that went through another placement as well, for the estimator. "
            f"{WITHOUT_WARMUP}"
        )
        return Table("shadows", "What shadow jobs cost", columns, [row], caption=caption)

    def _migrations(self, decisions: pl.DataFrame, found: Sequence[Move]) -> Table:
        cost = dict(self.run.windows.select("window", "cost").rows())
        length_s = self.header.problem.window_ms / 1e3
        rows = []
        for move in found[:MOST_ROWS]:
            decided = move.is_decided
            known, later_s = (move.window, length_s) if decided else (move.window + 1, 0.0)
            rows.append(
                {
                    "window": move.window,
                    "at_s": self.begin_of.get(known, math.nan) + later_s,
                    "from": move.source,
                    "to": move.target,
                    "reason": shown_reason(move.reason),
                    "before": cost.get(move.window),
                    "estimated": decisions[f"j_{move.target}"][move.row],
                    "after": cost.get(move.window + 1),
                }
            )
        columns: Columns = [
            Text("window", "after window"),
            Measure("at_s", "at", "s"),
            Text("from", "from", "placement"),
            Text("to", "to", "placement"),
            Text("reason", "reason"),
            *(METRICS["cost"].called(f"J {one}", one) for one in ("before", "estimated", "after")),
        ]
        return Table(
            "migrations",
            f"Migrations ({len(rows)} of {len(found)})",
            columns,
            rows,
            caption=(
                "J as measured in the window before the move, as estimated for the target, and as "
                f"measured in the first window on it. {WITHOUT_WARMUP}"
            ),
            palette=self.palette,
        )

    # ------------------------------------------------------------------------------- record

    def _known(self) -> Table:
        """Return a table of the gaps of a live run: clock errors, lost cycles, journal damage."""
        windows, cycles = self.run.windows, self.run.cycles
        recovered = self.header.recovered
        bound_ms = _number(windows["bound_ms"].max())
        done = int((cycles["outcome"].cast(str) == "done").sum())
        rows: list[tuple[str, object]] = [
            (
                "largest error of the clocks (ms)",
                write_number(bound_ms, 2),
            ),
            (
                "allowed in a proven window (ms)",
                write_number(PROVEN_SHARE * self.header.deadline_ms),
            ),
            ("windows unproven", int(windows["unproven"].sum())),
            ("cycles of which nothing was heard (counted as lost)", int((~cycles["heard"]).sum())),
            (
                "commands that arrived and were not applied: too old, or behind a later one",
                max(done - int(cycles["actuated"].sum()), 0),
            ),
            ("cycles in no window, before the first of a placement", int(cycles["lead"].sum())),
            ("starts of the controller", recovered.get("opened", 1)),
            ("bytes torn off the journal’s end by a kill", recovered.get("torn_bytes", 0)),
            ("bytes damaged within the journal", recovered.get("damaged_bytes", 0)),
            ("windows missing from the run", recovered.get("missing_windows", 0)),
            ("closed", "yes" if recovered.get("sealed", True) else "no"),
        ]
        shown = [{"what": what, "value": str(value)} for what, value in rows]
        columns: Columns = [Text("what", ""), Measure("value", "")]
        return Table("known", "", columns, shown)

    def _about(self) -> Definitions:
        header = self.header
        period = write_ms(header.problem.pipeline.period_ms)
        return Definitions(
            {
                "cell": header.problem.name,
                "scenario": header.scenario,
                "record": f"{header.kind}, seed {header.seed}",
                "policy": header.policy,
                "estimator": header.estimator,
                "shadows": header.shadows,
                "window": f"{counted(header.problem.window_cycles, 'cycle')} of {period}, deadline "
                f"{write_ms(header.deadline_ms)}",
                "versions": ", ".join(f"{name} {text}" for name, text in header.versions.items()),
            }
        )


def _begins(run: Run, header: RunHeader) -> NDArray[np.float64]:
    """Return the beginning of every window in seconds; live runs use the recorded releases."""
    if not header.live:
        return begins_by_number(run.windows, header.problem.pipeline.period_ms)
    released = dict(zip(run.cycles["cycle"], run.cycles["release_ns"], strict=True))
    return np.array([released[cycle] / 1e9 for cycle in run.windows["first_cycle"]], np.float64)


def _counts(
    slug: str,
    title: str,
    columns: tuple[Text, Text],
    meanings: Mapping[str, str],
    found: pl.Series,
    what: str,
    decimals: int,
) -> Table:
    """Return a table of names, their meanings, and their counts and shares in a column."""
    counts, (name, meaning) = Counter(found.cast(str)), columns
    rows = [
        {
            name.column: one,
            meaning.column: text,
            what: counts[one],
            "share": counts[one] / len(found),
        }
        for one, text in meanings.items()
    ]
    measures = Measure(what, what), Measure("share", "share", "%", 100.0, decimals)
    return Table(slug, title, [*columns, *measures], rows, caption=WITHOUT_WARMUP)


def _moving(header: RunHeader, name: str) -> str:
    """Return the nodes of a candidate's tasks, for the tasks on which candidates differ."""
    first = next(iter(header.problem.candidates.values()))
    return ", ".join(
        f"{task} on {written_nodes(nodes)}"
        for task, nodes in header.problem.candidates[name].items()
        if any(other.get(task) != first.get(task) for other in header.problem.candidates.values())
    )


def _number(value: object) -> float:
    return math.nan if value is None else float(str(value))
