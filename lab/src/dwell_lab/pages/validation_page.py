"""The page of a validation: predictions of the simulator next to measurements of runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from dwell.display import Measure, write_number
from dwell.model.bounds import counted
from dwell.report.charts import (
    NO_LIMIT,
    PART_COLOURS,
    PARTS_SHOWN,
    Limit,
    coloured,
    cumulative,
    latency_limit,
    layer,
    name_of,
    names,
    quantity,
    square,
    stacked,
)
from dwell.report.figure import Figure, Spec
from dwell.report.formatting import percent, shown_contender, shown_scenario
from dwell.report.method import cell_definitions
from dwell.report.move_blocks import move_blocks
from dwell.report.page import Definitions, Page, Section, page_html
from dwell.report.palette import DASHES, INK, MUTED, SHADE, Palette, Style
from dwell.report.policy_blocks import named
from dwell.report.table import Columns, Row, Table, Text, interval_row, table_text
from dwell.study.metric import METRICS
from dwell_lab.validation.judged_prediction import (
    L95_ALLOWED,
    ORDER,
    POINTS_ALLOWED,
    USE_ALLOWED,
    Judged,
)
from dwell_lab.validation.resampling import DRAWS
from dwell_lab.validation.validation import GOALS, LEAST_MINUTES, Group, Validation

if TYPE_CHECKING:
    import polars as pl

GOAL_NAMES = {
    "l95_ms": "L95 within 10 %",
    "violation_rate": "V_D within 2 percentage points, or explained",
    "utilisation": "U of every node within 5 percentage points",
    "dominant": "the same dominant placement",
    "sum_of_means": "better than the sum of means",
}
#: Number of points of a distribution, and upper end of its axis in deadlines.
POINTS, DEADLINES = 120, 3.0
MEASURED, PREDICTED = "measured", "predicted"
BOTH = {
    MEASURED: Style(INK, "circle", DASHES[0]),
    PREDICTED: Style(MUTED, "diamond", DASHES[1]),
}
#: Columns of verdicts that fit into a terminal.
SHORT = {
    *("l95", "l95_predicted", "l95_word", "rate", "rate_predicted", "rate_word"),
    *("use_word", "placed_word", "sum_word"),
}
SCENARIO = Text("scenario", "", "scenario")
POLICY = Text("policy", "policy", "policy")


def validation_html(validation: Validation, *, static: bool = False) -> str:
    """Return the page of a validation; see `dwell.report.page.page_html`."""
    return page_html(validation_page(validation), static=static)


def validation_page(validation: Validation, *, sections: int | None = None) -> Page:
    """Return the contents of the page of a validation; with `sections`, only that many sections."""
    runs = sum(len(group.runs) for group in validation.groups)
    minutes = sum(group.minutes for group in validation.groups)
    return Page(
        title=f"Predicted and measured: {validation.problem.name}",
        subtitle=f"{counted(len(validation.groups), 'group')} of a scenario and a policy, "
        f"{counted(runs, 'run')}, {write_number(minutes)} minutes that count, each run simulated "
        f"{counted(validation.seeds, 'time')}",
        sections=list(islice(_sections(validation), sections)),
    )


def validation_text(validation: Validation, *, width: int | None = None) -> str:
    """Return a validation as text (`dwell.report.table.table_text`), verdicts on goals last."""
    page = validation_page(validation)
    tables = [_verdicts(validation, compact=True), _goals(validation)]
    texts = [table_text(one, width=width) for one in tables]
    return "\n".join([page.title, f"{page.subtitle}\n", *texts])


def _sections(validation: Validation) -> Iterator[Section]:
    yield Section("", [_goals(validation), _over(validation)])
    yield Section("Verdicts", [_verdicts(validation)])
    yield Section("Latencies", [_latencies(validation), _rates(validation)])
    yield Section("Where the time goes", [_split(validation), _parts(validation)])
    limit, palette = latency_limit(validation.problem), _palette(validation)
    about = (POLICY, Text("run", "run"))
    if moves := move_blocks(validation.moves, palette, limit, about, SCENARIO):
        yield Section("Moves of the runs: predicted, then seen", moves)
    if not validation.jobs.is_empty():
        yield Section("Jobs", [_jobs(validation)], folded=True)
    used = [f"u_{name}" for name in validation.problem.fabric.resources]
    others = [
        _compared(validation, "windows", ["window_l95_ms", "migrations"], "Windows and migrations"),
        _compared(validation, "use", used, "Utilisation of the nodes"),
        _compared(validation, "shares", _shares(validation), "Windows under each placement"),
    ]
    yield Section("More figures", [one for one in others if one.rows])
    names = [name for group in validation.groups for name in group.runs]
    allowed = f"{percent(L95_ALLOWED)} of L95, {100 * POINTS_ALLOWED:g} points of V_D, "
    terms = {
        "met, missed": "the complete interval of the error is within the allowed error, or "
        "beyond it; otherwise open",
        "allowed": f"{allowed}{100 * USE_ALLOWED:g} points of U",
        "explained": "V_D is not met and L95 is; predicted latencies times 0.9 give a V_D below "
        "the measured one, times 1.1 one above it",
        "intervals": f"95 %, from {DRAWS} resamples: measured intervals resample runs and blocks "
        "of windows within them, predicted intervals simulations, intervals of errors both",
        "enough": f"{LEAST_MINUTES:g} minutes measured",
        "sum of means": "mean time of every task and message along the longest path",
        "runs": ", ".join(names),
        "versions": ", ".join(f"{name} {one}" for name, one in validation.versions.items()),
    }
    yield Section("Terms", [Definitions({**cell_definitions(validation.problem), **terms})])


def _palette(validation: Validation) -> Palette:
    """Return the colours of placements and policies, including candidates that only runs have."""
    shares = (name.removeprefix("share_") for name in _shares(validation))
    names = dict.fromkeys([*validation.problem.candidates, *shares])
    return Palette.of(names, [group.policy for group in validation.groups])


def _shares(validation: Validation) -> list[str]:
    names = (name for group in validation.groups for name in group.figures)
    return list(dict.fromkeys(name for name in names if name.startswith("share_")))


def _table(
    validation: Validation,
    slug: str,
    title: str,
    columns: Sequence[Text | Measure],
    rows: Sequence[Row],
    caption: str = "",
) -> Table:
    palette = _palette(validation)
    return Table(slug, title, [POLICY, *columns], rows, SCENARIO, caption, palette)


def _pair(measured: Measure) -> list[Measure]:
    """Return the two columns of a quantity: measured and predicted."""
    return [measured, measured.called("predicted", f"{measured.column}_predicted")]


def _named(group: Group) -> dict[str, object]:
    return {"scenario": group.scenario, "policy": group.policy}


# -------------------------------------------------------------------------------------- goals


def _goals(validation: Validation) -> Table:
    rows = []
    for goal in GOALS:
        found = [group.verdict(goal) for group in validation.groups]
        counts: dict[str, object] = {word: found.count(word) for word in ORDER if word}
        rows.append({**counts, "goal": GOAL_NAMES[goal], "word": validation.verdict(goal)})
    columns: Columns = [
        Text("goal", "goal"),
        Text("word", "in the worst group", "word"),
        *(Measure(word, word) for word in ORDER if word),
    ]
    return Table("goals", "Does the simulator predict this cell?", columns, rows)


def _verdicts(validation: Validation, *, compact: bool = False) -> Table:
    rows = []
    for group in validation.groups:
        l95, rate = group.figures["l95_ms"], group.figures["violation_rate"]
        node, use = worst_use(group)
        was, said = group.dominant
        rows.append(
            {
                **_named(group),
                "minutes": group.minutes,
                "enough": "no" if group.short else "yes",
                "excluded": group.excluded,
                **interval_row({"l95": l95.measured, "rate": rate.measured}),
                "l95_predicted": l95.predicted.value,
                **interval_row({"l95_off": l95.error}),
                "l95_word": l95.verdict,
                "rate_predicted": rate.predicted.value,
                "rate_word": rate.verdict,
                "node": node,
                "use_off": use.error.value,
                "use_word": group.verdict("utilisation"),
                "was": was,
                "said": said,
                "placed_word": group.verdict("dominant"),
                "sum": l95.baseline,
                "sum_word": group.verdict("sum_of_means"),
            }
        )
    columns: Columns = [
        Measure("minutes", "min"),
        Text("enough", "enough"),
        Measure("excluded", "windows excluded"),
        *_pair(METRICS["l95_ms"].called("L95 measured", "l95")),
        Measure("l95_off", "off", "%", 100.0, signed=True),
        Text("l95_word", "L95", "word"),
        *_pair(METRICS["violation_rate"].called("V_D measured", "rate")),
        Text("rate_word", "V_D", "word"),
        Text("node", "worst node"),
        Measure("use_off", "U off", "points", 100.0, signed=True),
        Text("use_word", "U", "word"),
        Text("was", "placed", "placement"),
        Text("said", "predicted", "placement"),
        Text("placed_word", "placed", "word"),
        Measure("sum", "sum of means", "ms"),
        Text("sum_word", "beaten", "word"),
    ]
    if compact:
        columns = [one for one in columns if one.column in SHORT]
    caption = (
        "L95 of all cycles together, ∞ if more than 5 % are lost. Placed: the dominant "
        "placement. ATP is our reconstruction."
    )
    return _table(validation, "verdicts", "Every group", columns, rows, caption)


def worst_use(group: Group) -> tuple[str, Judged]:
    """Return the node with the worst prediction of utilisation, and the judgement of it."""
    uses = group.uses

    def rank(name: str) -> tuple[int, float]:
        error = abs(uses[name].error.value)
        return ORDER.index(uses[name].verdict), error if math.isfinite(error) else -1.0

    node = max(uses, key=rank)
    return node, uses[node]


# ----------------------------------------------------------------------------------- figures


def _over(validation: Validation) -> Figure:
    """Draw predicted over measured L95, V_D and U, with the allowed error as a band."""
    import polars as pl

    shown = (METRICS["l95_ms"], METRICS["violation_rate"], Measure("use", "U of every node", "%"))
    titles = {measure.column: measure.heading for measure in shown}
    goal = pl.col("metric").str.replace("^u_.*", "use")
    factor = pl.when(goal == "l95_ms").then(1.0).otherwise(100.0)
    numbers = {"low": "measured_low", "high": "measured_high", "predicted": "predicted"}
    frame = named(validation.table.filter(goal.is_in(list(titles)))).select(
        goal.alias("goal"),
        *("scenario", "policy", "metric"),
        *(
            pl.when(pl.col(column).is_finite()).then(factor * pl.col(column)).alias(name)
            for name, column in {"measured": "measured", **numbers}.items()
        ),
    )
    policies = {
        shown_contender(name): style.colour for name, style in _palette(validation).policies.items()
    }
    return Figure(
        "over",
        "Predicted over measured",
        {"rows": frame},
        lambda width: {
            "hconcat": [
                _scatter(frame, goal, title, policies, _deadline(validation), (width - 180) / 3)
                for goal, title in titles.items()
            ],
            "resolve": {"legend": {"color": "shared", "shape": "shared"}},
        },
        "One mark per group; its bar is the measured interval. Shaded: allowed error. Dashed: "
        "deadline.",
    )


def _scatter(
    frame: pl.DataFrame,
    goal: str,
    title: str,
    policies: dict[str, str],
    deadline: Limit,
    size: float,
) -> Spec:
    mine = frame.filter(goal=goal)
    numbers = [*mine["measured"].drop_nulls(), *mine["predicted"].drop_nulls()]
    limit = deadline if goal == "l95_ms" else NO_LIMIT
    numbers += [limit.value] if limit is deadline else []
    high = 1.05 * max(numbers, default=1.0) or 1.0
    share = L95_ALLOWED if goal == "l95_ms" else 0.0
    points = {"l95_ms": 0.0, "violation_rate": 100 * POINTS_ALLOWED, "use": 100 * USE_ALLOWED}[goal]
    band = [
        {"at": at, "low": at * (1 - share) - points, "high": at * (1 + share) + points}
        for at in (0.0, high)
    ]
    domain = {"domain": [0, high], "nice": False}
    across = quantity("measured", f"{title}, measured", scale=domain, axis={"tickCount": 4})
    up = quantity("predicted", "predicted", scale=domain, axis={"tickCount": 4})
    allowed = {"x": {**across, "field": "at"}, "y": {**up, "field": "low"}, "y2": "high"}
    about = names("policy", "scenario", "metric")
    about += [quantity("measured", "measured"), quantity("predicted", "predicted")]
    marks = [
        layer("rule", {"x": "low", "x2": "high"}, opacity=0.6),
        layer("point", {"shape": name_of("scenario"), "tooltip": about}, size=45, strokeWidth=1.6),
    ]
    groups = {
        "transform": [{"filter": f"datum.goal === '{goal}'"}],
        "encoding": {"color": coloured("policy", policies)},
        "layer": marks,
    }
    shade = {"data": {"values": band}, **layer("area", allowed, color=SHADE, clip=True)}
    return square(size, across, up, [limit, limit], shade, groups)


def _panel(group: Group) -> str:
    return f"{shown_contender(group.policy)}, {shown_scenario(group.scenario)}"


def _latencies(validation: Validation) -> Figure:
    import polars as pl

    across = np.linspace(0.0, DEADLINES * _deadline(validation).value, POINTS)
    parts = []
    for group in validation.groups:
        for name, sample in ((MEASURED, group.measured), (PREDICTED, group.predicted)):
            line = pl.DataFrame({"value": across, "share": sample.share_within(across)})
            scenario, policy = pl.lit(_panel(group)), pl.lit(name)
            parts.append(line.with_columns(scenario=scenario, policy=policy))
    frame = pl.concat(parts)
    draw = cumulative(frame, BOTH, ("latency (ms)", "cycles within"), _deadline(validation))
    caption = "A line that stays below 100 % shows that cycles were lost. Dashed: deadline."
    return Figure("latencies", "Latencies of all cycles", {"rows": frame}, draw, caption)


def _split(validation: Validation) -> Figure:
    import polars as pl

    rows = [
        (_panel(group), name, shown, sample.parts_ms[part])
        for group in validation.groups
        for name, sample in ((MEASURED, group.measured), (PREDICTED, group.predicted))
        for part, shown in PARTS_SHOWN.items()
    ]
    frame = pl.DataFrame(rows, schema=["scenario", "policy", "part", "value"], orient="row")
    draw = stacked(frame, list(BOTH), PART_COLOURS, "mean (ms)", _deadline(validation))
    title = "Time along the critical path of the cycles that finished"
    return Figure("split", title, {"rows": frame}, draw, "Dashed: deadline.")


def _deadline(validation: Validation) -> Limit:
    return Limit(validation.problem.pipeline.deadline_ms, "deadline")


# ------------------------------------------------------------------------------------ tables


def _rates(validation: Validation) -> Table:
    rows = []
    for group in validation.groups:
        rate = group.figures["violation_rate"]
        shorter, longer = group.allowed_rates
        rows.append(
            {
                **_named(group),
                "near": group.measured.share_near(L95_ALLOWED),
                "near_predicted": group.predicted.share_near(L95_ALLOWED),
                "rate": rate.measured.value,
                "rate_predicted": rate.predicted.value,
                "shorter": shorter,
                "longer": longer,
                "factor": group.factor,
            }
        )
    columns: Columns = [
        *_pair(Measure("near", "within 10 % of D, measured", "%", 100.0)),
        *_pair(METRICS["violation_rate"].called("V_D measured", "rate")),
        METRICS["violation_rate"].called("if 10 % shorter", "shorter"),
        METRICS["violation_rate"].called("if 10 % longer", "longer"),
        Measure("factor", "factor", decimals=2),
    ]
    caption = (
        "V_D if every predicted latency were shorter or longer by the allowed error of L95; and "
        "the factor on the predicted latencies that gives the measured V_D."
    )
    return _table(validation, "rates", "Latencies near the deadline", columns, rows, caption)


def _parts(validation: Validation) -> Table:
    rows = []
    for group in validation.groups:
        row = _named(group)
        for part in PARTS_SHOWN:
            was, said = group.measured.parts_ms[part], group.predicted.parts_ms[part]
            row |= {part: was, f"{part}_predicted": said, f"{part}_off": said - was}
        rows.append(row)
    columns: Columns = [
        column
        for part, shown in PARTS_SHOWN.items()
        for column in (
            *_pair(Measure(part, f"{shown}, measured", "ms", decimals=2)),
            Measure(f"{part}_off", "off", "ms", decimals=2, signed=True),
        )
    ]
    return _table(validation, "parts", "", columns, rows)


def _jobs(validation: Validation) -> Table:
    columns: Columns = [
        Text("task", "task"),
        Text("node", "node"),
        Measure("jobs", "jobs"),
        Measure("measured_ms", "measured", "ms", decimals=2),
        Measure("measured_p95_ms", "P95", "ms", decimals=2),
        Measure("predicted_ms", "predicted", "ms", decimals=2),
        Measure("predicted_p95_ms", "P95", "ms", decimals=2),
    ]
    if validation.jobs["core_ms"].is_not_null().any():
        columns += [
            Measure("core_ms", "core time", "ms", decimals=2),
            Measure("core_p95_ms", "P95", "ms", decimals=2),
            Measure("cell_ms", "in the cell file", "ms", decimals=2),
            Measure("cell_p95_ms", "P95", "ms", decimals=2),
        ]
    return _table(
        validation,
        "jobs",
        "By task and node",
        columns,
        validation.jobs.to_dicts(),
        "Runs that kept their jobs: from a job’s start to its end, shadows included. Core time: "
        "CPU time of the job’s own thread.",
    )


def _compared(validation: Validation, slug: str, names: Sequence[str], title: str) -> Table:
    """Return the columns, measured and predicted, of the figures that at least one group has."""
    names = [name for name in names if any(name in one.figures for one in validation.groups)]
    rows = []
    for group in validation.groups:
        row = _named(group)
        for name in names:
            if name in group.figures:
                row |= interval_row({name: group.figures[name].measured})
                row[f"{name}_predicted"] = group.figures[name].predicted.value
        rows.append(row)
    l95 = METRICS["l95_ms"].called("L95 of windows", "window_l95_ms")
    known = {l95.column: l95, **METRICS}
    columns: list[Measure] = []
    for name in names:
        used = Measure(name, name.partition("_")[2], "%", 100.0)
        columns += _pair(known.get(name, used))
    return _table(validation, slug, title, columns, rows)
