"""Report of a comparison: the policies that meet the aim, and the evidence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

from dwell.display import Measure
from dwell.model.bounds import counted
from dwell.model.disturbed import disturbed
from dwell.report.figure import Figure
from dwell.report.formatting import (
    few_seeds,
    independent_runs,
    shown_policy,
    shown_scenario,
)
from dwell.report.method import numbered
from dwell.report.page import Page, Section, page_html
from dwell.report.policy_blocks import MOST_COLUMNS, PolicyBlocks
from dwell.report.table import WITHOUT_WARMUP, Columns, Table, Text, table_text, wrapped
from dwell.report.timeline import begins_by_number, run_timeline
from dwell.study import Comparison, paper_predictions
from dwell.study.drawn_disturbances import drawn_disturbances
from dwell.study.metric import METRICS

DTP = "dtp"


def comparison_html(
    *comparisons: Comparison,
    static: bool = False,
) -> str:
    """Return a page about one or more comparisons in sequence.

    Parameters
    ----------
    *comparisons : Comparison
        At least one comparison; the names of their cells must differ.
    static : bool
        See `dwell.report.page.page_html`.
    """
    return page_html(comparison_page(*comparisons), static=static)


def comparison_page(*comparisons: Comparison, sections: int | None = None) -> Page:
    """Return the page of comparisons; `sections` limits the sections of each comparison."""
    several = len(comparisons) > 1
    parts: list[Section] = []
    policies: dict[str, str] = {}
    for comparison in comparisons:
        prefix = f"{comparison.problem.name}-" if several else ""
        blocks = PolicyBlocks(comparison, prefix)
        policies |= blocks.colours
        for part in islice(_sections(comparison, blocks), sections):
            title = f"{comparison.problem.name}: {part.title}" if several else part.title
            parts.append(replace(part, title=title.removesuffix(": ")))
    first = comparisons[0]
    runs = sum(one.runs.height for one in comparisons)
    cells = ", ".join(one.problem.name for one in comparisons)
    return Page(
        title=f"Placement policies compared on {cells}",
        subtitle=f"{counted(runs, 'simulated run')}: {counted(len(first.scenarios), 'scenario')}, "
        f"{counted(len(first.policies), 'policy')}, {numbered(first.seeds)}, "
        f"{counted(first.windows, 'window')}{few_seeds(len(first.seeds))}",
        sections=parts,
        policies=policies,
        seeds=first.seeds,
    )


def _sections(comparison: Comparison, blocks: PolicyBlocks) -> Iterator[Section]:
    yield Section("", [blocks.rate()], note=blocks.headline())
    yield Section("The cell and its placements", blocks.cell())
    yield Section("Scenarios under and over the aim", [blocks.counts()], folded=True)
    predictions = predictions_table(comparison, blocks)
    if predictions.rows:
        yield Section("Predictions of the paper", [predictions], folded=True)
    yield Section("Results", blocks.results().parts(MOST_COLUMNS), folded=True)
    figures = [
        blocks.tail(),
        blocks.measure(METRICS["cost"], title="J, the cost that DTP seeks to lower"),
    ]
    figures += [blocks.distribution(), *blocks.placed(), blocks.split()]
    yield Section("Figures", figures, folded=True)
    moving = [name for name in comparison.policies if name not in comparison.statics]
    if moving and comparison.examples:
        shown = next(name for name in (DTP, DTP.upper(), *moving) if name in moving)
        timelines = [_timeline(comparison, blocks, one, shown) for one in comparison.scenarios]
        yield Section(
            f"{shown_policy(shown)} through time",
            timelines,
            note=f"Runs of seed {comparison.seeds[0]}. Marks are windows, or as many of them as "
            "the axis says; thin lines J of the other placements as estimated, upright lines "
            "migrations. Shaded: warm-up and disturbances.",
            folded=True,
        )
        beliefs = [_beliefs(comparison, blocks)]
        yield Section("Estimated J and measured J", beliefs, folded=True)
    yield Section("More numbers", blocks.more().parts(MOST_COLUMNS), folded=True)
    method = blocks.method(
        runs=f"{counted(comparison.windows, 'window')}, {numbered(comparison.seeds)}; every policy "
        "plays the same realisation of a scenario and seed",
        intervals="95 %, two-sided, over seeds, by the studentised bootstrap, each on its own; "
        f"of medians, by order statistics.{independent_runs(comparison.runs)}",
    )
    yield Section("Method", method, folded=True)


def predictions_table(comparison: Comparison, blocks: PolicyBlocks) -> Table:
    """Return a table of the paper's predictions and the results; no rows for other cells."""
    policies = [DTP] if DTP in comparison.policies else []
    columns: Columns = [
        Text("policy", "policy", "policy"),
        Text("words", "the paper says"),
        Text("reading", "read as"),
        Text("answer", "the runs", "word"),
        Text("leader", "most windows", "placement"),
        Measure("share", "share of the predicted", "%", 100.0),
    ]
    return Table(
        f"{blocks.prefix}predictions",
        "The paper’s predictions, and where they fail",
        columns,
        paper_predictions(comparison, policies).to_dicts(),
        Text("scenario", "", "scenario"),
        "Its words are read as conditions on numbers. A condition holds, or fails, only where the "
        "whole 95 % interval over seeds says so; else it is open.",
        blocks.palette,
    )


def _timeline(comparison: Comparison, blocks: PolicyBlocks, scenario: str, policy: str) -> Figure:
    problem, example = comparison.problem, comparison.examples[scenario, policy]
    return run_timeline(
        example.windows,
        example.decisions,
        begins_by_number(example.windows, problem.pipeline.period_ms),
        problem,
        slug=f"{blocks.prefix}time-{scenario}",
        disturbed=disturbed(
            drawn_disturbances(problem, scenario, comparison.seeds[0], comparison.windows),
            problem.fabric,
        ),
        title=shown_scenario(scenario),
    )


def _beliefs(comparison: Comparison, blocks: PolicyBlocks) -> Table:
    """Return a table of estimated and measured J for every policy that moves."""
    import polars as pl

    means = comparison.costs.group_by("scenario", "policy", "candidate", maintain_order=True).agg(
        pl.col("estimated", "measured", "shadow_fraction").mean()
    )
    alone = comparison.runs.group_by("scenario", "policy", maintain_order=True).agg(
        pl.col("cost").mean().alias("alone")
    )
    rows = means.filter(~pl.col("policy").is_in(list(comparison.problem.candidates))).join(
        alone.rename({"policy": "candidate"}), on=["scenario", "candidate"], how="left"
    )
    cost = METRICS["cost"]
    columns: Columns = [
        Text("policy", "policy", "policy"),
        Text("candidate", "placement", "placement"),
        cost.called("estimated while idle", "estimated"),
        cost.called("measured while active", "measured"),
        cost.called("measured alone", "alone"),
        Measure("shadow_fraction", "shadows per alternative", "%", 100.0, 1),
    ]
    return Table(
        f"{blocks.prefix}beliefs",
        "J of each placement, mean over seeds",
        columns,
        rows.to_dicts(),
        Text("scenario", "", "scenario"),
        "Estimates include the cost of switching. Alone: of the static placement, on the same "
        f"realisations. {WITHOUT_WARMUP}",
        blocks.palette,
    )


def comparison_text(comparison: Comparison, *, width: int | None = None) -> str:
    """Return a comparison as text: its tables, then the answer.

    See `dwell.report.table.table_text` for `width`.
    """
    blocks = PolicyBlocks(comparison)
    tables = [blocks.results(compact=True), predictions_table(comparison, blocks), blocks.counts()]
    texts = [table_text(one, width=width) for one in tables if one.rows]
    return "\n".join([*texts, *wrapped(blocks.headline(), width), ""])
