"""The page of a validation: what the simulator predicted, beside what runs measured."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING

from dwell.report import validation_figures as figures
from dwell.report.formatting import (
    OURS,
    Measure,
    percent,
    shown_contender,
    shown_scenario,
    write_interval,
    write_number,
)
from dwell.report.method import describe_cell
from dwell.report.page import (
    Cell,
    definitions,
    document,
    figure,
    items,
    marked,
    named,
    paragraph,
    section,
    table,
)
from dwell.report.palette import Palette
from dwell.report.validation_findings import GOAL_NAMES, remarks, totals, worst_use
from dwell.study.intervals import Interval
from dwell.study.judged_prediction import Outcome
from dwell.study.resampling import DRAWS
from dwell.study.validation import (
    L95_ALLOWED,
    LEAST_MINUTES,
    POINTS_ALLOWED,
    USE_ALLOWED,
    Group,
    Validation,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["validation_html"]

TAGS: Mapping[Outcome, str] = {
    "met": "good",
    "explained": "good",
    "open": "open",
    "missed": "bad",
    "": "open",
}
L95 = Measure("l95_ms", "L95", "ms")
RATE = Measure("violation_rate", "V_D", "%", 100.0)
USE = Measure("utilisation", "U", "%", 100.0)


def validation_html(validation: Validation) -> str:
    """Return a self-contained page about a validation.

    Parameters
    ----------
    validation : Validation

    Returns
    -------
    str
        HTML without scripts, and without anything that is loaded from elsewhere.
    """
    title = f"Predicted beside measured: {validation.problem.name}"
    return document(title, _body(validation, title))


def _body(validation: Validation, title: str) -> Iterator[str]:
    palette = _palette(validation)
    runs = sum(len(group.runs) for group in validation.groups)
    minutes = sum(group.minutes for group in validation.groups)
    yield f"<h1>{escape(title)}</h1>"
    yield paragraph(
        f"Groups of a scenario and a policy: {len(validation.groups)}; runs: {runs}, "
        f"{write_number(minutes)} minutes that count, each run simulated {validation.seeds} times",
        "subtitle",
    )
    yield paragraph(
        "Does the simulator predict what this cell shows when it really runs?", "question"
    )
    yield _totals(validation)
    told = list(remarks(validation))
    if told:
        yield items(told, "evidence")
    yield section("Verdicts", _verdicts(validation, palette))
    yield section("Predicted over measured", _over(validation, palette))
    yield section("Latencies", *_latencies(validation, palette))
    yield section("Where the time goes", *_parts(validation, palette))
    if not validation.jobs.is_empty():
        yield section("Jobs", _jobs(validation, palette))
    yield section("More figures", *_more(validation, palette))
    yield section("How it was judged", items(_method(validation)))
    yield section("What it does not say", items(_limits()))
    yield section("What this is", definitions(_about(validation)))


def _palette(validation: Validation) -> Palette:
    """Return the colours of placements and policies; runs may have had candidates of their own."""
    groups = validation.groups
    theirs = [
        name.removeprefix("share_")
        for group in groups
        for name in group.figures
        if name.startswith("share_")
    ]
    names = dict.fromkeys([*validation.problem.candidates, *theirs])
    return Palette.of(names, [group.policy for group in groups])


def _tag(verdict: Outcome) -> str:
    return f'<span class="{TAGS[verdict]} nowrap">{verdict or "–"}</span>'


def _totals(validation: Validation) -> str:
    rows: list[tuple[str, Sequence[Cell]]] = [
        (
            "",
            [Cell(marked(GOAL_NAMES[goal])), Cell(_tag(verdict)), Cell(escape(counts))],
        )
        for goal, verdict, counts in totals(validation)
    ]
    head = [Cell("goal"), Cell("in the worst group"), Cell("groups")]
    return table(head, rows, kind="prose")


def _named(palette: Palette, policy: str) -> str:
    colour = palette.policies[policy].colour
    return named(shown_contender(policy), colour, ring=policy not in palette.placements)


def _pair(interval: Interval, measure: Measure, kind: str = "num") -> list[Cell]:
    written = write_interval(interval, measure)
    return [Cell(written.value, kind), Cell(written.error, "err")]


def _value(interval: Interval, measure: Measure) -> Cell:
    return Cell(write_interval(interval, measure).value, "num")


def _by_scenario(
    validation: Validation, columns: int
) -> Iterator[tuple[str, Sequence[Cell]] | Group]:
    """Yield a row with each scenario's name, and then its groups."""
    shown = None
    for group in validation.groups:
        if group.scenario != shown:
            shown = group.scenario
            yield "group", [Cell(escape(shown_scenario(shown)), columns=columns)]
        yield group


# ------------------------------------------------------------------------------------- verdicts


def _verdicts(validation: Validation, palette: Palette) -> str:
    head = [
        Cell("policy"),
        Cell("min", "num"),
        Cell("measured", "pair", 2),
        Cell("predicted", "num"),
        Cell(""),
        Cell("measured", "pair", 2),
        Cell("predicted", "num"),
        Cell(""),
        Cell("points off", "num"),
        Cell(""),
        Cell("placed"),
        Cell("sum of means", "num"),
        Cell("beaten"),
    ]
    above = [
        Cell("", "", 2),
        Cell("L95 (ms)", "over", 4),
        Cell(marked("V_D (%)"), "over", 4),
        Cell("U, worst node", "over", 2),
        Cell("", "", 3),
    ]
    rows: list[tuple[str, Sequence[Cell]]] = []
    for item in _by_scenario(validation, 15):
        if not isinstance(item, Group):
            rows.append(item)
            continue
        l95, rate = item.figures["l95_ms"], item.figures["violation_rate"]
        node, use = worst_use(item)
        error = write_number(100 * use.error.value, signed=True)
        placed = item.verdict("dominant")
        was, said = item.dominant
        where = "" if was == said else f" <small>({escape(said)})</small>"
        minutes = write_number(item.minutes)
        rows.append(
            (
                "",
                [
                    Cell(_named(palette, item.policy)),
                    Cell(f'<span class="bad">{minutes}</span>' if item.short else minutes, "num"),
                    *_pair(l95.measured, L95),
                    _value(l95.predicted, L95),
                    Cell(_tag(l95.verdict)),
                    *_pair(rate.measured, RATE),
                    _value(rate.predicted, RATE),
                    Cell(_tag(rate.verdict)),
                    Cell(f"{escape(node)} {error}", "num"),
                    Cell(_tag(item.verdict("utilisation"))),
                    Cell(f"{escape(was)}{where} {_tag(placed)}", "nowrap"),
                    _value(Interval(l95.baseline, math.nan, math.nan), L95),
                    Cell(_tag(item.verdict("sum_of_means"))),
                ],
            )
        )
    atp = f" {OURS}" if any(one.policy.startswith("atp") for one in validation.groups) else ""
    return table(
        head,
        rows,
        "Measured figures with their 95 % intervals. L95 is that of all cycles together: where "
        "more than 5 % are lost it is ∞. “Placed” is the dominant placement, measured, with the "
        "predicted one in brackets where it is another. “Sum of means” is the "
        f"L95 of that predictor. Minutes in colour: fewer than {LEAST_MINUTES:g}.{atp}",
        above=above,
        kind="wide small of-chapter",
    )


def _over(validation: Validation, palette: Palette) -> str:
    return figure(
        figures.predicted_over_measured(validation, palette),
        f"Each mark is a group, the bar through it the interval of what was measured. Shaded: "
        f"what is allowed, {percent(L95_ALLOWED)} of L95, {100 * POINTS_ALLOWED:g} points of V_D, "
        f"{100 * USE_ALLOWED:g} points of U. A short dash is what the sum of means predicts for "
        "the group of the same L95 or V_D.",
    )


# ------------------------------------------------------------------------------------ latencies


def _latencies(validation: Validation, palette: Palette) -> Iterator[str]:
    yield figure(
        figures.distributions(validation, palette),
        "Empirical distributions of the latencies of all cycles. A curve that stays below 100 % "
        "shows that cycles were lost. 95 % is where L95 is read.",
    )
    head = [
        Cell("policy"),
        Cell("measured", "num begin"),
        Cell("predicted", "num"),
        Cell("measured", "num begin"),
        Cell("predicted", "num"),
        Cell("10 % shorter", "num begin"),
        Cell("10 % longer", "num"),
        Cell("factor", "num begin"),
    ]
    above = [
        Cell(""),
        Cell("within 10 % of D (%)", "over", 2),
        Cell(marked("V_D (%)"), "over", 2),
        Cell(marked("V_D if latencies were"), "over", 2),
        Cell(""),
    ]
    rows: list[tuple[str, Sequence[Cell]]] = []
    for item in _by_scenario(validation, 8):
        if not isinstance(item, Group):
            rows.append(item)
            continue
        rate = item.figures["violation_rate"]
        numbers = [
            item.measured.share_near(L95_ALLOWED),
            item.predicted.share_near(L95_ALLOWED),
            rate.measured.value,
            rate.predicted.value,
            *item.allowed_rates,
        ]
        rows.append(
            (
                "",
                [
                    Cell(_named(palette, item.policy)),
                    *(Cell(write_number(100 * value), "num") for value in numbers),
                    Cell(write_number(item.factor, 2), "num"),
                ],
            )
        )
    yield paragraph(
        "Where the mass of the latency lies at the deadline D, and what V_D would be if every "
        "predicted latency were as much shorter or longer as L95 may be off. The factor is what "
        "the predicted latencies would have to be multiplied by to give the measured V_D; there "
        "is none where no cycle missed.",
        "note",
    )
    yield table(head, rows, above=above)


def _parts(validation: Validation, palette: Palette) -> Iterator[str]:
    yield figure(
        figures.time_split(validation),
        "Time along the critical path of the cycles that finished: in each pair the thick bar was "
        "measured, the thin one is predicted. What differs here is where to look for a cause.",
    )
    names = {"compute": "computing", "queue": "waiting", "network": "network"}
    head = [Cell("policy")]
    above = [Cell("")]
    for name in names.values():
        above.append(Cell(f"{name} (ms)", "over", 3))
        head += [Cell("measured", "num begin"), Cell("predicted", "num"), Cell("off", "num")]
    rows: list[tuple[str, Sequence[Cell]]] = []
    for item in _by_scenario(validation, 10):
        if not isinstance(item, Group):
            rows.append(item)
            continue
        cells = [Cell(_named(palette, item.policy))]
        for part in names:
            was, said = item.measured.parts_ms[part], item.predicted.parts_ms[part]
            cells += [
                Cell(write_number(was, 2), "num begin"),
                Cell(write_number(said, 2), "num"),
                Cell(write_number(said - was, 2, signed=True), "num"),
            ]
        rows.append(("", cells))
    yield table(head, rows, above=above)


def _jobs(validation: Validation, palette: Palette) -> str:
    with_core = validation.jobs["core_ms"].is_not_null().any()
    head = [
        Cell("policy"),
        Cell("task"),
        Cell("node"),
        Cell("jobs", "num"),
        *(Cell(name, "num") for name in ("measured", "P95", "predicted", "P95")),
    ]
    above = [Cell("", "", 4), Cell("start to end (ms)", "over", 4)]
    if with_core:
        head += [Cell(name, "num") for name in ("measured", "P95", "cell", "P95")]
        above.append(Cell("core time (ms)", "over", 4))
    columns = ["measured", "predicted", *(["core", "cell"] if with_core else [])]
    rows: list[tuple[str, Sequence[Cell]]] = []
    shown: tuple[str, str] | None = None
    for row in validation.jobs.iter_rows(named=True):
        mine = row["scenario"], row["policy"]
        if shown is None or shown[0] != mine[0]:
            title = escape(shown_scenario(mine[0]))
            rows.append(("group", [Cell(title, columns=len(head))]))
        first = _named(palette, mine[1]) if mine != shown else ""
        shown = mine
        numbers = [row[f"{name}{tail}"] for name in columns for tail in ("_ms", "_p95_ms")]
        rows.append(
            (
                "",
                [
                    Cell(first),
                    Cell(escape(row["task"])),
                    Cell(escape(row["node"])),
                    Cell(write_number(row["jobs"], 0), "num"),
                    *(
                        Cell(write_number(math.nan if one is None else one, 2), "num")
                        for one in numbers
                    ),
                ],
            )
        )
    core = (
        " Core time is what the job's own thread used, beside the execution time that the cell "
        "file has for it."
        if with_core
        else " These runs do not know the core time of their jobs."
    )
    return (
        "<details><summary>By task and node</summary>"
        + table(
            head,
            rows,
            "Of the runs that kept their jobs: time from a job's start to its end, with whatever "
            f"else ran on the node and what its quota withheld.{core} Jobs of shadows are among "
            "them.",
            above=above,
            kind="small",
        )
        + "</details>"
    )


# ----------------------------------------------------------------------------------------- more


def _more(validation: Validation, palette: Palette) -> Iterator[str]:
    nodes = list(validation.problem.fabric.nodes)
    yield _compared(
        validation,
        palette,
        "Windows and migrations",
        [Measure("window_l95_ms", "L95 of windows", "ms"), Measure("migrations", "migrations")],
        "L95 of windows is the mean over windows of what the controller saw, in which a cycle "
        "that has not finished counts with its age. Migrations are those of one run, without "
        "the guard's.",
    )
    yield _compared(
        validation,
        palette,
        "Utilisation",
        [Measure(f"u_{node}", f"U of {node}", "%", 100.0) for node in nodes],
        "Utilisation of every node, foreign work included.",
        judged=True,
    )
    shares = list(
        dict.fromkeys(
            name
            for group in validation.groups
            for name in group.figures
            if name.startswith("share_")
        )
    )
    yield _compared(
        validation,
        palette,
        "Placements",
        [Measure(name, name.removeprefix("share_"), "%", 100.0, 0) for name in shares],
        "Share of the windows that began under each placement.",
        moving=True,
    )


def _compared(
    validation: Validation,
    palette: Palette,
    title: str,
    measures: Sequence[Measure],
    caption: str,
    *,
    judged: bool = False,
    moving: bool = False,
) -> str:
    """Return a table of figures, measured and predicted; of `moving` policies only."""
    each = 4 if judged else 3
    head, above = [Cell("policy")], [Cell("")]
    for measure in measures:
        above.append(Cell(marked(measure.heading), "over", each))
        head += [Cell("measured", "pair begin", 2), Cell("predicted", "num")]
        head += [Cell("")] if judged else []
    rows: list[tuple[str, Sequence[Cell]]] = []
    pending: tuple[str, Sequence[Cell]] | None = None
    for item in _by_scenario(validation, 1 + each * len(measures)):
        if not isinstance(item, Group):
            pending = item
            continue
        if moving and f"share_{item.policy}" in item.figures:
            continue
        if pending is not None:
            rows.append(pending)
            pending = None
        cells = [Cell(_named(palette, item.policy))]
        for measure in measures:
            found = item.figures.get(measure.column)
            if found is None:
                cells += [Cell("–", "num"), Cell(""), Cell("–", "num")]
                continue
            cells += _pair(found.measured, measure, "num begin")
            cells.append(_value(found.predicted, measure))
            cells += [Cell(_tag(found.verdict))] if judged else []
        rows.append(("", cells))
    if not rows:
        return ""
    return f"<h3>{title}</h3>\n" + paragraph(caption, "note") + table(head, rows, above=above)


def _method(validation: Validation) -> Iterator[str]:
    yield (
        "For every run the same cell, scenario and policy was simulated "
        f"{validation.seeds} times, with as many windows, the same warm-up, the disturbances at "
        "the times at which they were played, and without the windows that the run leaves out."
    )
    yield (
        f"Intervals of what was measured come from {DRAWS} resamples: runs with replacement, and "
        "within each of them blocks of consecutive windows. Those of predictions come from "
        "resampled simulations, and those of errors from both."
    )
    yield (
        "A goal is met where the whole interval of the error lies within what is allowed, missed "
        "where the whole of it lies beyond, and open elsewhere."
    )
    yield (
        "V_D is explained where it is not met, L95 is, and the whole interval of the measured V_D "
        "lies between the V_D of the predicted latencies times 0.9 and times 1.1. That is so "
        "where much of the mass of the latency lies at the deadline."
    )
    yield (
        "Where no measured cycle missed, the upper limit of V_D is the rule of three over the "
        "windows, as if each were independent."
    )
    yield (
        "The sum of means adds up the mean time of every task on its node, slowed down by quota "
        "and foreign threads in the mean, and the mean delay and sending time of every message "
        "along the longest path; L95 is that sum, and V_D 0 or 1. It is told where the cycles "
        "ran. It is beaten where the error of L95 is smaller, and that of V_D not larger or both "
        f"within {100 * POINTS_ALLOWED:g} points."
    )


def _limits() -> Iterator[str]:
    yield (
        "Intervals know what these runs knew: what the machine does in another week is not in "
        "them, and a disturbance that no run met is not either."
    )
    yield (
        "With few runs what differs from run to run is known badly; the blocks within runs make "
        "up for some of it."
    )
    yield "Each verdict stands on its own; intervals are not widened for being many."


def _about(validation: Validation) -> dict[str, str]:
    told = describe_cell(validation.problem)
    names = [name for group in validation.groups for name in group.runs]
    told["runs"] = ", ".join(names[:12]) + (
        f" and {len(names) - 12} more" if len(names) > 12 else ""
    )
    told["software"] = ", ".join(f"{name} {one}" for name, one in validation.versions.items())
    return told
