"""The report of a campaign: its measurements, answers, and the limits of few repetitions."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

import numpy as np

from dwell.display import Measure, write_number
from dwell.model.bounds import counted
from dwell.report.charts import NO_LIMIT, cumulative
from dwell.report.figure import Figure
from dwell.report.formatting import percent, shown_contender
from dwell.report.page import Block, Fact, Page, Section
from dwell.report.palette import ramp_styles
from dwell.report.policy_blocks import PolicyBlocks, named
from dwell.report.table import Columns, Table, Text, table_text
from dwell.study.family import UNTOLD, untold
from dwell.study.metric import METRICS
from dwell_lab.validation.campaign_questions import CampaignQuestion, questions
from dwell_lab.validation.measured_campaign import MeasuredCampaign

#: Number of points of a distribution over windows.
POINTS = 80
#: Upper end of an axis of latencies, in deadlines.
DEADLINES = 4
#: Metrics of windows.
SHOWN = ("violation_rate", "l95_ms", "u_robot", "u_edge")
WHERE = {"testbed": "the testbed"}


def campaign_page(measured: MeasuredCampaign) -> Page:
    """Return the contents of the page of a campaign."""
    comparison = measured.comparison
    blocks = PolicyBlocks(comparison)
    return Page(
        title=f"Campaign on {comparison.problem.name}",
        subtitle=f"{counted(len(comparison.scenarios), 'scenario')}, "
        f"{counted(len(comparison.policies), 'policy')}, "
        f"runs of {write_number(measured.seconds, 0)} s on "
        f"{WHERE.get(measured.where, 'real hosts')}; a repetition takes the place of a seed",
        facts=list(_facts(measured)),
        sections=list(_sections(measured, blocks)),
        policies=blocks.colours,
        seeds=comparison.seeds,
    )


def _facts(measured: MeasuredCampaign) -> Iterator[Fact]:
    log = measured.log
    yield Fact("runs", write_number(log.height, 0), f"of {measured.planned}")
    yield Fact("complete repetitions", write_number(measured.repetitions, 0))
    windows, excluded = (int(log[name].sum()) for name in ("windows", "excluded"))
    share = percent(excluded / windows, 1) if windows else "–"
    yield Fact("windows excluded", write_number(excluded, 0), f"of {windows}, {share}")
    yield Fact("attempts that failed", write_number(measured.failed.height, 0))
    simulated = measured.kinds != {"live"}
    yield Fact("made of", "simulated runs" if simulated else "measured runs")


def _sections(measured: MeasuredCampaign, blocks: PolicyBlocks) -> Iterator[Section]:
    yield Section("", blocks.answer())
    for place, asked in enumerate(questions(measured)):
        yield Section(asked.title, [_question_table(asked, blocks, place)])
    yield Section("Results", [blocks.results()])
    figures: list[Block] = [blocks.tail()]
    figures += [
        blocks.measure(METRICS[name], title=METRICS[name].title) for name in ("u_robot", "u_edge")
    ]
    yield Section("Figures", [*figures, blocks.distribution(), *blocks.placed(), blocks.split()])
    yield Section(
        "Windows",
        [_windows(measured, blocks, name) for name in SHOWN],
        note="Share of the windows at or below a value, all repetitions together; windows of a "
        "run are not independent.",
        folded=True,
    )
    yield Section("More numbers", [blocks.more()], folded=True)
    if not measured.profiles.is_empty():
        yield Section("Times of jobs", [_profiles(measured)])
    if not measured.links.is_empty():
        yield Section("Delays of messages", [_delays(measured), _links(measured)])
    yield Section("Log of runs", [_log(measured), *_failed(measured)])
    method = blocks.method(
        estimators=", ".join(
            f"{shown_contender(name)}: {estimator}"
            for name, estimator in measured.estimators.items()
            if name not in blocks.problem.candidates
        ),
        order="each repetition is a complete random order of all policies in all scenarios; "
        "the runs of a scenario and repetition follow each other",
        intervals="95 %, two-sided, over repetitions, by the studentised bootstrap from 4 on, "
        "by Student’s t below",
    )
    yield Section("How it was measured", method)


def _question_table(asked: CampaignQuestion, blocks: PolicyBlocks, place: int) -> Table:
    rows = []
    once = untold(asked.table["word"])
    for row in asked.table.iter_rows(named=True):
        measure = METRICS[row["metric"]]
        effect = {"effect": row["effect"], "effect_low": row["low"], "effect_high": row["high"]}
        scaled = {key: one if one is None else measure.factor * one for key, one in effect.items()}
        word = UNTOLD if row["word"] in once else row["word"]
        rows.append({**row, **scaled, "metric": measure.heading, "word": word})
    said = "".join(f" {UNTOLD}: {word}." for word in once)
    return Table(
        f"question-{place}",
        f"Answer: {asked.answer}",
        [
            Text("metric", "metric"),
            Text("first", "policy", "policy"),
            Text("second", "less", "policy"),
            Measure("effect", "difference", decimals=2, signed=True),
            Measure("n", "repetitions"),
            Measure("p", "p (Holm)", decimals=3),
            Measure("p_least", "least p", decimals=3),
            Text("word", "is", "word"),
        ],
        rows,
        Text("scenario", "", "scenario"),
        "Paired by repetition; sign-flip tests, Holm over all comparisons of a metric. Least p: "
        f"the smallest p that this number of repetitions and comparisons allows.{said}",
        blocks.palette,
    )


def _windows(measured: MeasuredCampaign, blocks: PolicyBlocks, name: str) -> Figure:
    """Draw the distributions of a measure over windows."""
    import polars as pl

    measure, deadline_ms = METRICS[name], measured.comparison.problem.pipeline.deadline_ms
    latency = name == "l95_ms"
    every = measured.windows[name].to_numpy() * measure.factor
    high = float(every.max())
    high = min(high, DEADLINES * deadline_ms) if latency else high
    across = np.linspace(0.0, high or 1.0, POINTS)
    parts = []
    for labels, mine in measured.windows.group_by("scenario", "policy", maintain_order=True):
        values = np.sort(mine[name].to_numpy() * measure.factor)
        share = np.searchsorted(values, across + 1e-9, side="right") / len(values)
        scenario, policy = (pl.lit(str(label)) for label in labels)
        line = pl.DataFrame({"value": across, "share": share})
        parts.append(line.with_columns(scenario=scenario, policy=policy))
    frame = named(pl.concat(parts))
    headings = (f"{measure.name} of a window ({measure.unit})", "windows at or below")
    draw = cumulative(frame, blocks.styles, headings, blocks.deadline if latency else NO_LIMIT)
    return Figure(f"windows-{name}", f"Windows by their {measure.name}", {"rows": frame}, draw)


def _profiles(measured: MeasuredCampaign) -> Table:
    times = ("cpu", "wall") if measured.profiles["cpu_ms"].is_not_null().any() else ("wall",)
    called = {"cpu": "core time", "wall": "start to end"}
    columns: Columns = [
        Text("task", "task"),
        Text("node", "node"),
        Measure("jobs", "jobs"),
        Measure("runs", "runs"),
    ]
    for kind in times:
        columns += [
            Measure(f"{kind}_ms", f"{called[kind]}, mean", "ms", decimals=2),
            Measure(f"{kind}_ms_p50", "median", "ms", decimals=2),
            Measure(f"{kind}_ms_p95", "95 %", "ms", decimals=2),
        ]
    columns.append(Measure("told_ms", "in the cell file", "ms", decimals=2))
    return Table(
        "profiles",
        "Compute profiles",
        columns,
        measured.profiles.to_dicts(),
        caption="Jobs of the baseline after the warm-up, without shadows. Means over "
        "runs with 95 % intervals; percentiles of all jobs together.",
    )


def _delays(measured: MeasuredCampaign) -> Figure:
    frame = measured.delays.select("scenario", "share", policy="link", value="delay_ms")
    frame = named(frame, ("scenario",))
    links = ramp_styles(str(name) for name in frame["policy"].unique(maintain_order=True))
    draw = cumulative(frame, links, ("delay of a message (ms)", "messages within"))
    return Figure("delays", "Link delays by scenario", {"rows": frame}, draw)


def _links(measured: MeasuredCampaign) -> Table:
    columns: Columns = [
        Text("link", "link"),
        Text("flow", "flow"),
        Measure("messages", "messages"),
        Measure("mean_ms", "mean", "ms", decimals=2),
        Measure("std_ms", "std", "ms", decimals=2),
        Measure("p50_ms", "median", "ms", decimals=2),
        Measure("p95_ms", "95 %", "ms", decimals=2),
    ]
    return Table(
        "links",
        "Link delays",
        columns,
        measured.links.to_dicts(),
        Text("scenario", "", "scenario"),
        "From the end of the sending job to the arrival, by the clocks of both nodes; without lost "
        "messages.",
    )


def _log(measured: MeasuredCampaign) -> Table:
    rows = [
        {
            **row,
            "begun": datetime.fromtimestamp(row["began_unix_s"], UTC).strftime("%Y-%m-%d %H:%M:%S"),
            "idle": "yes" if row["idle"] else "no",
        }
        for row in measured.log.iter_rows(named=True)
    ]
    columns: Columns = [
        Text("place", "run"),
        Text("begun", "begun (UTC)"),
        Measure("repetition", "repetition"),
        Text("scenario", "scenario", "scenario"),
        Text("policy", "policy", "policy"),
        Measure("attempt", "attempt"),
        Text("idle", "machine idle before"),
        Measure("waited_s", "waited for that", "s"),
        Measure("windows", "windows"),
        Measure("excluded", "excluded"),
    ]
    return Table("log", "Runs", columns, rows)


def _failed(measured: MeasuredCampaign) -> Iterator[Table]:
    if measured.failed.height:
        names = ("scenario", "policy", "repetition", "attempt", "outcome", "reason")
        columns: Columns = [Text(name, name) for name in names]
        yield Table("failed", "Attempts that failed", columns, measured.failed.to_dicts())


def campaign_text(measured: MeasuredCampaign, *, width: int | None = None) -> str:
    """Return the results of a campaign as text (`dwell.report.table.table_text`), answers last."""
    comparison = measured.comparison
    blocks = PolicyBlocks(comparison)
    parts = [blocks.results(compact=True), blocks.counts()]
    parts += [
        _question_table(asked, blocks, place) for place, asked in enumerate(questions(measured))
    ]
    facts = [f"{one.name}: {one.value} {one.error}".strip() for one in _facts(measured)]
    texts = [table_text(one, width=width) for one in parts]
    return "\n".join([*texts, *facts])
