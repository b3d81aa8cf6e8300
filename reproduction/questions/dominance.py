"""Which placement wins where: a map over the speed of E and the jitter of the links.

Under each of the paper's four scenarios, and with R2 stressed, which the paper leaves out as it
leaves out the placement that this is a case for: T2 on R1 and T3 on E. It is called PLO here,
planning offloaded, and is a fourth candidate in all maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import polars as pl

from dwell.model import (
    FrozenDict,
    LinkDisturbance,
    LogNormal,
    NodeDisturbance,
    Problem,
    Scenario,
    Task,
    Uniform,
)
from dwell.study import Interval, Point, Study, paired_difference, windows_behind
from reproduction.cell import RULES, STEADY, of_cell, rules, statics, with_candidate, with_scenarios
from reproduction.questions import Run
from reproduction.scale import Scale, thinned
from reproduction.verdicts import Answer, by_policy, claims, values

TITLE = (
    "Which placement wins where, and does the one that the paper leaves out (T2 on R1, T3 on E) "
    "ever win?"
)

#: The placement that the paper leaves out, and where it differs from the first candidate.
FOURTH, FOURTH_MOVES = "PLO", {"perception": "R1", "planning": "E"}
ARM, EDGE = "R2", "E"
#: How much faster than in the cell every task is on E; and the width of a uniform delay on all
#: links, milliseconds.
SPEEDS = (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 4.0)
WIDTHS_MS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
PARAMETERS = ("edge.speed", "links.jitter_ms")
#: Seeds and windows of a point of the map, at most.
MAP_SEEDS, MAP_WINDOWS = 5, 40

METRICS = ("violation_rate", "cost")
#: What the paper predicts for its scenarios: the placements meant by "dominates under DTP". With
#: jitter on all links its baseline is none, and has another name in the map.
PREDICTED = {
    "undisturbed": ("LOC",),
    "robot-cpu-stress": ("SO",),
    "edge-cpu-stress": ("LOC", "HYB"),
    "network-impairment": ("LOC",),
}
STRESSED_ARM = "R2-cpu-stress"
#: Dynamic scenarios that the fourth is tried in: one in which R2 is never stressed, and one else.
CHANGING = ("step", "mixture")


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Draw the maps, and try the fourth candidate."""
    four = with_candidate(cell, FOURTH, FOURTH_MOVES)
    windows = max(min(MAP_WINDOWS, scale.windows), cell.warmup_windows + 2)
    seeds, half = scale.some_seeds[:MAP_SEEDS], max(2, (scale.grid + 1) // 2)
    maps, led = (
        run(Study(name, map_points(base, size), scenarios, who, seeds, windows)).runs
        for name, base, size, scenarios, who in (
            ("dominance-map", four, scale.grid, (*PREDICTED, STRESSED_ARM), statics(four)),
            ("dominance-dtp", cell, half, tuple(PREDICTED), rules()[:1]),
        )
    )
    without = {rule: f"{rule} without {FOURTH}" for rule in RULES}
    frames, studies = [], []
    for name, scenarios, length in (
        ("steady", steady_cases(cell), scale.windows),
        ("dynamic", {one: cell.scenarios[one] for one in CHANGING}, scale.dynamic_windows),
    ):
        four_there, three_there = (with_scenarios(base, scenarios) for base in (four, cell))
        who = (*statics(four), *rules())
        more = of_cell(
            f"dominance-four-{name}", four_there, scenarios, who, scale.all_seeds, length
        )
        points = (Point({}, three_there),)
        three = replace(more, name=f"dominance-three-{name}", points=points, contenders=rules())
        frames.append(run(more).runs)
        frames.append(run(three).runs.with_columns(pl.col("policy").replace_strict(without)))
        studies.append(more)
    runs = pl.concat(frames, how="diagonal")
    names = list(dict.fromkeys(runs["scenario"]))
    others = [(FOURTH, other) for other in cell.candidates]
    asked = {
        f"{FOURTH} that never moves beats the paper's placements": others,
        f"A rule is better with {FOURTH} as a fourth candidate": list(without.items()),
    }
    verdicts = claims(runs, METRICS, names, asked, *studies)
    won = pl.concat([winners(maps, metric, tuple(four.candidates)) for metric in METRICS])
    papers = pl.concat([winners(maps, metric, tuple(cell.candidates)) for metric in METRICS])
    counts = won.group_by("metric", "scenario", "winner", maintain_order=True).agg(
        pl.len().alias("points"), pl.col("clear").sum()
    )
    return Answer(
        pl.concat(verdicts),
        {
            "Points of the map that each placement wins, and wins clearly": counts,
            "Points at which a placement that the paper predicts is best, or leads under DTP": (
                predicted(papers, led, tuple(cell.candidates))
            ),
            "Every policy in every scenario": by_policy(runs, METRICS),
            "The map": won,
        },
    )


# ------------------------------------------------------------------------------ the map


def map_points(cell: Problem, size: int) -> tuple[Point, ...]:
    """Return a point for every speed of E and width of the delays, some of them along an axis."""
    return tuple(
        Point(
            dict(zip(PARAMETERS, (speed, width_ms), strict=True)),
            with_scenarios(with_speed(cell, speed), map_scenarios(cell, width_ms)),
        )
        for speed, width_ms in product(thinned(SPEEDS, size), thinned(WIDTHS_MS, size))
    )


def map_scenarios(cell: Problem, width_ms: float) -> dict[str, Scenario]:
    """Return the paper's scenarios and R2's stress, with a uniform delay on every link."""
    jitter: Scenario = tuple(
        LinkDisturbance(link.source, link.target, add_delay_ms=Uniform(0.0, width_ms))
        for link in (cell.fabric.links.values() if width_ms > 0 else ())
    )
    threads = 2 * cell.fabric.nodes[ARM].cores
    base: dict[str, Scenario] = {
        name: () if name == "undisturbed" else cell.scenarios[name] for name in PREDICTED
    }
    base[STRESSED_ARM] = (NodeDisturbance(ARM, stress_threads=threads),)
    return {name: (*items, *jitter) for name, items in base.items()}


def with_speed(cell: Problem, factor: float) -> Problem:
    """Return the cell in which every task takes less time on E, by a factor."""

    def changed(task: Task) -> Task:
        on = dict(task.on)
        if EDGE in on:
            exec_ms = on[EDGE].exec_ms
            assert isinstance(exec_ms, LogNormal), "the canonical cell's times are lognormal"
            on[EDGE] = replace(on[EDGE], exec_ms=replace(exec_ms, mean=1 / factor * exec_ms.mean))
        return replace(task, on=FrozenDict(on))

    tasks = {name: changed(task) for name, task in cell.pipeline.tasks.items()}
    return replace(cell, pipeline=replace(cell.pipeline, tasks=FrozenDict(tasks)))


def steady_cases(cell: Problem) -> dict[str, Scenario]:
    """Return the steady scenarios, and those made for PLO: R2 no place for T3, the uplink slow."""
    cores = cell.fabric.nodes[ARM].cores
    slow: Scenario = (LinkDisturbance("R1", EDGE, rate_mbps=200.0),)
    weak: Scenario = (NodeDisturbance(ARM, stress_threads=cores),)
    strong: Scenario = (NodeDisturbance(ARM, stress_threads=2 * cores),)
    return {
        **{name: cell.scenarios[name] for name in STEADY},
        "R2 1 a core": weak,
        "R2 2 a core": strong,
        "uplink slow": slow,
        "R2 2 a core + uplink slow": (*strong, *slow),
    }


# ----------------------------------------------------------------------------- reading


def winners(runs: pl.DataFrame, metric: str, candidates: Sequence[str]) -> pl.DataFrame:
    """Find who wins each point of the map, and by how much over the second.

    One row a scenario and point: the candidate with the least mean and the next; ``margin`` with
    its 95 % interval, each point by itself; ``clear`` where that is above 0.
    """
    keys = [*(f"parameter.{name}" for name in PARAMETERS), "scenario"]
    rows = []
    for labels, here in runs.group_by(keys, maintain_order=True):
        found = {name: values(here, metric, policy=name) for name in candidates}
        first, second, *_ = sorted(candidates, key=lambda name: float(found[name].mean()))
        shares = metric == "violation_rate"
        windows = windows_behind(*(here.filter(policy=name) for name in (first, second)))
        margin = paired_difference(found[second], found[first], shares=shares, windows=windows)
        rows.append(
            {
                "metric": metric,
                **dict(zip((*PARAMETERS, "scenario"), labels, strict=True)),
                "winner": first,
                "second": second,
                **Interval(margin.mean, margin.low, margin.high).columns("margin"),
                "clear": margin.low > 0,
            }
        )
    return pl.DataFrame(rows, infer_schema_length=None).fill_nan(None)


def predicted(papers: pl.DataFrame, led: pl.DataFrame, candidates: Sequence[str]) -> pl.DataFrame:
    """Count the points at which the paper's predictions hold: of its winners, and of DTP's runs."""
    keys = ["scenario", *(f"parameter.{name}" for name in PARAMETERS)]
    means = led.group_by(keys, maintain_order=True).agg(
        pl.col(f"share_{name}").mean().alias(name) for name in candidates
    )
    most = means.select(candidates).to_numpy().argmax(axis=1)
    leaders = means.select("scenario", winner=pl.Series([candidates[place] for place in most]))
    rows = []
    for scenario, dominant in PREDICTED.items():
        row: dict[str, object] = {"scenario": scenario, "predicted": " or ".join(dominant)}
        for name, frame in (
            *((metric, papers.filter(metric=metric)) for metric in METRICS),
            ("dtp", leaders),
        ):
            mine = frame.filter(scenario=scenario)["winner"]
            row |= {name: int(mine.is_in(dominant).sum()), f"{name}_of": len(mine)}
        rows.append(row)
    return pl.DataFrame(rows)
