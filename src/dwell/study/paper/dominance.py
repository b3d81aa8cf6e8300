"""Which placement wins where: a map over the speed of E and the jitter of the links.

Under each of the paper's four scenarios, and with R2 stressed, which the paper leaves out as it
leaves out the placement that this is a case for: T2 on R1 and T3 on E. It is called PLO here,
planning offloaded, and is a fourth candidate in all maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from dwell.model import LinkDisturbance, NodeDisturbance, Problem, Scenario, Uniform
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.over_seeds import difference_of, over_seeds
from dwell.study.paper.cell import dynamic_scenarios, steady_scenarios
from dwell.study.paper.contenders import believing, statics
from dwell.study.paper.contrasts import Contrast
from dwell.study.paper.differences import centre, difference_table, families, shown_as
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, number, points
from dwell.study.paper.tuning import thinned
from dwell.study.paper.variants import with_candidate, with_scenarios, with_speed
from dwell.study.predictions import PAPER
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

__all__ = ["FOURTH", "Cell", "chapter", "map_points", "verdict", "winners"]

#: The placement that the paper leaves out, and where it differs from the first candidate.
FOURTH, FOURTH_MOVES = "PLO", {"perception": "R1", "planning": "E"}
EDGE, ARM = "E", "R2"

#: How much faster than in the cell every task is on E; and the width of a uniform delay on all
#: links, milliseconds.
SPEEDS = (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 4.0)
WIDTHS_MS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
PARAMETERS = ("edge.speed", "links.jitter_ms")

#: Seeds and windows of a point of the map, at most.
MAP_SEEDS, MAP_WINDOWS = 5, 40

METRICS = ("violation_rate", "cost")
RULES = ("dtp+corrected", "cusum+corrected")

UNDISTURBED, STRESSED_ARM = "undisturbed", "R2-cpu-stress"
#: Cases made for the fourth candidate: R2 is no place for T3, the uplink none for frames.
UPLINK, UPLINK_MBPS = "R1->E", 200.0
#: Dynamic scenarios that it is tried in: one in which R2 is never stressed, one in which it is.
CHANGING = ("step", "mixture")
CASES = ("R2 1 a core", "R2 2 a core", "uplink slow", "R2 2 a core + uplink slow")


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a map.

    Parameters
    ----------
    scenario : str
    speed, width_ms : float
    winner, second : str
        The candidates with the least mean of the metric.
    margin, low, high : float
        How much less the winner has than the second, with its 95 % interval.
    """

    scenario: str
    speed: float
    width_ms: float
    winner: str
    second: str
    margin: float
    low: float
    high: float

    @property
    def clear(self) -> bool:
        """Whether the interval says that the winner wins."""
        return self.low > 0


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Draw the maps, and try the fourth candidate."""
    mapped = runner.run(map_study(problem, scale))
    settled = runner.run(dtp_study(problem, scale))
    results = []
    known = dynamic_scenarios(problem)
    for name, scenarios, windows in (
        ("steady", steady_cases(problem), scale.windows),
        ("dynamic", {one: problem.scenarios[one] for one in CHANGING if one in known}, None),
    ):
        if scenarios:
            length = scale.dynamic_windows if windows is None else windows
            three = with_scenarios(problem, scenarios)
            four = with_candidate(three, FOURTH, FOURTH_MOVES)
            shared = Study(
                name=f"dominance-three-{name}",
                points=(Point({}, three),),
                scenarios=tuple(scenarios),
                contenders=_rules(),
                seeds=scale.all_seeds,
                windows=length,
            )
            more = replace(
                shared,
                name=f"dominance-four-{name}",
                points=(Point({}, four),),
                contenders=(*statics(four), *_rules()),
            )
            results.append((runner.run(more), runner.run(shared)))
    return written(mapped, settled, together(results))


# ------------------------------------------------------------------------------- studies


def jittered(problem: Problem, width_ms: float) -> Scenario:
    """Return an even delay from 0 to a width, message by message, on every link."""
    if width_ms == 0:
        return ()
    return tuple(
        LinkDisturbance(link.source, link.target, add_delay_ms=Uniform(0.0, width_ms))
        for link in problem.fabric.links.values()
    )


def _mapped(scenario: str) -> str:
    """Name in the map of one of the paper's scenarios: with jitter, the baseline is none."""
    return UNDISTURBED if scenario == "baseline" else scenario


def map_scenarios(problem: Problem, width_ms: float) -> dict[str, Scenario]:
    """Return the paper's scenarios and R2's stress, with jitter."""
    jitter = jittered(problem, width_ms)
    threads = 2 * problem.fabric.nodes[ARM].cores
    base: dict[str, Scenario] = {
        _mapped(one.scenario): problem.scenarios[one.scenario]
        for one in PAPER
        if one.scenario in problem.scenarios
    }
    base[STRESSED_ARM] = (NodeDisturbance(ARM, stress_threads=threads),)
    return {name: (*items, *jitter) for name, items in base.items()}


def map_points(
    problem: Problem, speeds: Sequence[float], widths_ms: Sequence[float]
) -> list[Point]:
    """Return the points of a map."""
    return [
        Point(
            dict(zip(PARAMETERS, (speed, width_ms), strict=True)),
            with_scenarios(with_speed(problem, EDGE, speed), map_scenarios(problem, width_ms)),
        )
        for speed in speeds
        for width_ms in widths_ms
    ]


def map_study(problem: Problem, scale: Scale) -> Study:
    """Return the four static placements at every point."""
    four = with_candidate(problem, FOURTH, FOURTH_MOVES)
    mapped = map_points(four, thinned(SPEEDS, scale.grid), thinned(WIDTHS_MS, scale.grid))
    return Study(
        name="dominance-map",
        points=tuple(mapped),
        scenarios=tuple(map_scenarios(problem, 0.0)),
        contenders=statics(four),
        seeds=scale.some_seeds[:MAP_SEEDS],
        windows=_map_windows(problem, scale),
    )


def dtp_study(problem: Problem, scale: Scale) -> Study:
    """Return DTP on the paper's candidates, in the paper's scenarios, on a coarser grid."""
    size = max(2, (scale.grid + 1) // 2)
    mapped = map_points(problem, thinned(SPEEDS, size), thinned(WIDTHS_MS, size))
    return Study(
        name="dominance-dtp",
        points=tuple(mapped),
        scenarios=tuple(name for name in map_scenarios(problem, 0.0) if name != STRESSED_ARM),
        contenders=(believing("dtp", "corrected"),),
        seeds=scale.some_seeds[:MAP_SEEDS],
        windows=_map_windows(problem, scale),
    )


def _map_windows(problem: Problem, scale: Scale) -> int:
    return max(min(MAP_WINDOWS, scale.windows), problem.warmup_windows + 2)


def steady_cases(problem: Problem) -> dict[str, Scenario]:
    """Return the steady scenarios, and those made for the fourth candidate."""
    cores = problem.fabric.nodes[ARM].cores
    source, _, target = UPLINK.partition("->")
    slow: Scenario = (LinkDisturbance(source, target, rate_mbps=UPLINK_MBPS),)
    stress: tuple[Scenario, Scenario] = (
        (NodeDisturbance(ARM, stress_threads=cores),),
        (NodeDisturbance(ARM, stress_threads=2 * cores),),
    )
    cases = (stress[0], stress[1], slow, (*stress[1], *slow))
    return {
        **{name: problem.scenarios[name] for name in steady_scenarios(problem)},
        **dict(zip(CASES, cases, strict=True)),
    }


def _rules() -> tuple[Contender, ...]:
    return tuple(believing(name.partition("+")[0], "corrected", name=name) for name in RULES)


def without(rule: str) -> str:
    """Name of a rule on the paper's three candidates."""
    return f"{rule} without {FOURTH}"


def together(results: Sequence[tuple[StudyResult, StudyResult]]) -> pl.DataFrame:
    """Put all runs into one frame; those on three candidates under names of their own."""
    import polars as pl

    frames = []
    for four, three in results:
        frames += [
            four.runs,
            three.runs.with_columns(
                policy=pl.col("policy").replace_strict({rule: without(rule) for rule in RULES})
            ),
        ]
    return pl.concat(frames, how="diagonal")


# --------------------------------------------------------------------------------- maps


def winners(runs: pl.DataFrame, metric: str, candidates: Sequence[str]) -> list[Cell]:
    """Find who wins each cell of the map.

    Parameters
    ----------
    runs : DataFrame
        One row a point, scenario, policy and seed; columns as in `dwell.study.StudyResult`.
    metric : str
        Less is better.
    candidates : sequence of str
        Who may win, in the order that breaks ties.
    """
    import polars as pl

    speed, width = (f"parameter.{name}" for name in PARAMETERS)
    found = []
    mine = runs.filter(pl.col("policy").is_in(list(candidates)))
    for (at_speed, at_width, scenario), here in mine.group_by(
        speed, width, "scenario", maintain_order=True
    ):
        values = {
            name: here.filter(pl.col("policy") == name).sort("seed")[metric].to_numpy()
            for name in candidates
        }
        order = sorted(candidates, key=lambda name: float(values[name].mean()))
        margin = difference_of(metric)(values[order[1]], values[order[0]])
        found.append(
            Cell(
                str(scenario),
                float(at_speed),
                float(at_width),
                order[0],
                order[1],
                *margin,
            )
        )
    return found


def leaders(runs: pl.DataFrame, candidates: Sequence[str]) -> dict[tuple[str, float, float], str]:
    """Return the placement with most windows, by scenario, speed and width."""
    import polars as pl

    speed, width = (f"parameter.{name}" for name in PARAMETERS)
    means = runs.group_by("scenario", speed, width, maintain_order=True).agg(
        *(pl.col(f"share_{name}").mean() for name in candidates)
    )
    return {
        (row["scenario"], row[speed], row[width]): max(
            candidates,
            key=lambda name: float(row[f"share_{name}"]),
        )
        for row in means.to_dicts()
    }


def held(
    cells: Mapping[str, Sequence[Cell]], led: Mapping[tuple[str, float, float], str]
) -> dict[str, dict[str, tuple[int, int]]]:
    """Count where the paper's predictions hold.

    Parameters
    ----------
    cells : mapping of metric to sequence of Cell
        Among the paper's candidates.
    led : mapping of (scenario, speed, width) to str
        The placement under which DTP spends most windows.

    Returns
    -------
    dict of scenario to dict of str to (int, int)
        By each metric, and by ``dtp``: points at which a predicted placement wins (or leads), and
        all points.
    """
    found: dict[str, dict[str, tuple[int, int]]] = {}
    for one in PAPER:
        row = {}
        for metric, every in cells.items():
            mine = [cell for cell in every if cell.scenario == _mapped(one.scenario)]
            row[metric] = (sum(cell.winner in one.dominant for cell in mine), len(mine))
        mine_led = [
            name for (scenario, _, _), name in led.items() if scenario == _mapped(one.scenario)
        ]
        row["dtp"] = (sum(name in one.dominant for name in mine_led), len(mine_led))
        if row["dtp"][1]:
            found[one.scenario] = row
    return found


# ------------------------------------------------------------------------------- verdict


def fourth_alone(runs: pl.DataFrame, others: Sequence[str]) -> dict[str, Family]:
    """Compare the fourth candidate that never moves to each of the others."""
    pairs: dict[str, Contrast] = {
        f"{scenario}: {FOURTH}, {other}": (
            {"scenario": scenario, "policy": FOURTH},
            {"scenario": scenario, "policy": other},
        )
        for scenario in dict.fromkeys(runs["scenario"])
        for other in others
    }
    return families(runs, "does the fourth placement win?", METRICS, pairs)


def fourth_offered(runs: pl.DataFrame) -> dict[str, Family]:
    """Compare each rule that has the fourth candidate to itself without."""
    pairs: dict[str, Contrast] = {
        f"{scenario}: {rule}, {without(rule)}": (
            {"scenario": scenario, "policy": rule},
            {"scenario": scenario, "policy": without(rule)},
        )
        for scenario in dict.fromkeys(runs["scenario"])
        for rule in RULES
    }
    return families(runs, "is the fourth candidate worth having?", METRICS, pairs)


def wins(family: Family, others: Sequence[str]) -> dict[str, float]:
    """Return where the fourth is lower than all others, and by how much than the next.

    Parameters
    ----------
    family : Family
        See `fourth_alone`.
    others : sequence of str
    """
    said = family.verdicts
    scenarios = dict.fromkeys(name.partition(f": {FOURTH}, ")[0] for name in family.comparisons)
    found = {}
    for scenario in scenarios:
        names = [f"{scenario}: {FOURTH}, {other}" for other in others]
        if all(said[name] == "lower" for name in names):
            found[scenario] = max(centre(family, name) for name in names)
    return found


def verdict(
    won: Mapping[str, Mapping[str, float]],
    scenarios: int,
    maps: Mapping[str, Sequence[Cell]],
) -> Outcome:
    """Say whether the fourth placement ever wins.

    Parameters
    ----------
    won : mapping of metric to mapping of scenario to float
        Where it has less than all others, and by how much than the next; in the cell as it is.
    scenarios : int
        How many there are.
    maps : mapping of metric to sequence of Cell
    """
    clear = {
        metric: sum(cell.winner == FOURTH and cell.clear for cell in cells)
        for metric, cells in maps.items()
    }
    by_both = set(won["violation_rate"]) & set(won["cost"])
    anywhere = any(clear.values()) or any(won.values())
    answer: Answer = "yes" if by_both else "in part" if anywhere else "no"
    rates = [f"{name} {points(value)}" for name, value in won["violation_rate"].items()]
    costs = [f"{name} {number(value, 2)}" for name, value in won["cost"].items()]
    cells = len(next(iter(maps.values())))
    text = (
        f"T2 on R1 and T3 on E ({FOURTH}) misses less than each of the paper's three placements in "
        f"{counted(len(rates), scenarios, 'scenarios')}, and costs less in {len(costs)}. Of "
        f"{cells} cells of the map it wins {clear['violation_rate']} clearly by V_D and "
        f"{clear['cost']} by J."
    )
    evidence = [f"Against the next best, V_D: {', '.join(rates)}."] if rates else []
    evidence += [f"Against the next best, J: {', '.join(costs)}."] if costs else []
    for metric, every in maps.items():
        mine = [cell.scenario for cell in every if cell.winner == FOURTH and cell.clear]
        where = (f"{name} {mine.count(name)}" for name in dict.fromkeys(mine))
        evidence += [f"Cells won clearly by {shown_as(metric)}: {', '.join(where)}."] * bool(mine)
    return Outcome(answer, text, tuple(evidence))


# ------------------------------------------------------------------------------- chapter


def written(mapped: StudyResult, settled: StudyResult, runs: pl.DataFrame) -> Chapter:
    """Write the chapter of finished runs."""
    four = tuple(mapped.study.points[0].problem.candidates)
    three = tuple(name for name in four if name != FOURTH)
    maps = {metric: winners(mapped.runs, metric, four) for metric in METRICS}
    papers = {metric: winners(mapped.runs, metric, three) for metric in METRICS}
    led = leaders(settled.runs, three)
    alone, offered = fourth_alone(runs, three), fourth_offered(runs)
    won = {metric: wins(family, three) for metric, family in alone.items()}
    scenarios = runs["scenario"].n_unique()
    outcome = verdict(won, scenarios, maps)
    return Chapter(
        slug="dominance",
        title=(
            "Which placement wins where, and does the one that the paper leaves out (T2 on R1, T3 "
            "on E) ever win?"
        ),
        design=design(mapped, settled, runs),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(
            *map_findings(maps),
            *prediction_findings(held(papers, led)),
            *offered_findings(offered, scenarios),
        ),
        tables=(
            shares_table(maps, four),
            predictions_table(held(papers, led)),
            statics_table(runs, four),
            difference_table(
                alone,
                slug="dominance-fourth",
                title=f"{FOURTH} that never moves, against the paper's placements",
            ),
            difference_table(
                offered,
                slug="dominance-offered",
                title=f"Rules that may use {FOURTH}, against the same without it",
                note="A fourth candidate means another share of shadow jobs, which they pay for.",
            ),
            map_table(maps),
        ),
        figures=(
            *(map_figure(metric, cells) for metric, cells in maps.items()),
            predictions_figure(papers),
        ),
    )


def design(mapped: StudyResult, settled: StudyResult, runs: pl.DataFrame) -> str:
    """Say what was compared."""
    study, dtp = mapped.study, settled.study
    speeds, widths = (
        list(dict.fromkeys(float(point.values[name]) for point in study.points))
        for name in PARAMETERS
    )
    return (
        f"All execution times on {EDGE} divided by {listed(f'{one:g}' for one in speeds)}, and a "
        "delay that is even between 0 and "
        f"{listed(f'{one:g}' for one in widths)} ms added to every message on every link: "
        f"{len(study.points)} points, under the paper's scenarios and with two threads a core on "
        f"{ARM}. Every static placement, {FOURTH} (T2 on R1, T3 on {EDGE}; planning offloaded) "
        f"among them, in runs of {study.windows} windows with {len(study.seeds)} seeds. A cell is "
        "won by the least mean; it is won clearly where the 95 % interval of the difference to the "
        "second, paired by seed, is above 0 (each cell by itself: of twenty cells with no winner "
        "one may seem to have one). The paper's predictions are held against the best of its three "
        f"placements, and against where dtp+corrected spends most windows, at {len(dtp.points)} "
        f"points. {FOURTH} itself is then compared in the cell as it is, in "
        f"{runs['scenario'].n_unique()} scenarios on {runs['seed'].n_unique()} seeds, some of them "
        f"made for it ({ARM} stressed; an uplink of {UPLINK_MBPS:g} Mbit/s): sign-flip tests "
        "paired by seed, Holm over all comparisons of a question and metric."
    )


def map_findings(maps: Mapping[str, Sequence[Cell]]) -> tuple[str, ...]:
    """Say who wins how many cells, by scenario."""
    found = []
    for metric, cells in maps.items():
        said = []
        for scenario in dict.fromkeys(cell.scenario for cell in cells):
            mine = [cell for cell in cells if cell.scenario == scenario]
            counts: dict[str, tuple[int, int]] = {}
            for cell in mine:
                all_, clear = counts.get(cell.winner, (0, 0))
                counts[cell.winner] = (all_ + 1, clear + cell.clear)
            each = ", ".join(
                f"{name} {all_} ({clear} clearly)"
                for name, (all_, clear) in sorted(counts.items(), key=lambda item: -item[1][0])
            )
            said.append(f"{scenario}: {each}")
        found.append(f"Cells won by {shown_as(metric)}, of {len(mine)}: {'; '.join(said)}.")
    return tuple(found)


def prediction_findings(kept: Mapping[str, Mapping[str, tuple[int, int]]]) -> tuple[str, ...]:
    """Say at how much of the map each of the paper's predictions holds."""
    if not kept:
        return ()
    names = {"violation_rate": "best by V_D", "cost": "best by J", "dtp": "leads under DTP"}
    said = [
        f"{scenario}: "
        + ", ".join(f"{names[by]} at {count} of {total}" for by, (count, total) in row.items())
        for scenario, row in kept.items()
    ]
    return (f"Points at which a placement that the paper predicts is {'; '.join(said)}.",)


def offered_findings(offered: Mapping[str, Family], scenarios: int) -> tuple[str, ...]:
    """Say what the fourth candidate is worth to each rule."""
    found = []
    for rule in RULES:
        said = []
        for metric, family in offered.items():
            pair = f": {rule}, {without(rule)}"
            verdicts = {
                name.removesuffix(pair): one
                for name, one in family.verdicts.items()
                if name.endswith(pair)
            }
            for word in ("lower", "higher"):
                named = [name for name, one in verdicts.items() if one == word]
                names_ = f" ({listed(named)})" if named else ""
                said.append(f"{word} {shown_as(metric)} in {len(named)}{names_}")
        found.append(
            f"{rule} with {FOURTH} as a fourth candidate has, of {scenarios} scenarios, a "
            f"{'; '.join(said)}."
        )
    return tuple(found)


# -------------------------------------------------------------------------------- tables


def shares_table(maps: Mapping[str, Sequence[Cell]], candidates: Sequence[str]) -> Table:
    """One row a metric and scenario: the cells that each candidate wins."""
    import polars as pl

    rows = []
    for metric, cells in maps.items():
        for scenario in dict.fromkeys(cell.scenario for cell in cells):
            mine = [cell for cell in cells if cell.scenario == scenario]
            row: dict[str, object] = {"metric": shown_as(metric), "scenario": scenario}
            for name in candidates:
                row[name] = sum(cell.winner == name for cell in mine)
                row[f"{name} clearly"] = sum(cell.winner == name and cell.clear for cell in mine)
            rows.append(row | {"cells": len(mine)})
    counts = [column for name in candidates for column in (name, f"{name} clearly")]
    return Table(
        slug="dominance-shares",
        title="Cells of the map that each placement wins",
        frame=pl.DataFrame(rows),
        units={"metric": "text", "scenario": "text", **dict.fromkeys((*counts, "cells"), "count")},
        note="Clearly: the 95 % interval of the difference to the second is above 0.",
    )


def predictions_table(kept: Mapping[str, Mapping[str, tuple[int, int]]]) -> Table:
    """One row a scenario: at which share of the points the prediction holds."""
    import polars as pl

    words = {one.scenario: one.dtp for one in PAPER}
    rows = [
        {
            "scenario": scenario,
            "predicted": words[scenario],
            **{by: count / total for by, (count, total) in row.items()},
            "points": row["cost"][1],
            "dtp_points": row["dtp"][1],
        }
        for scenario, row in kept.items()
    ]
    columns: dict[str, Unit] = {
        "scenario": "text",
        "predicted": "text",
        "violation_rate": "percent",
        "cost": "percent",
        "points": "count",
        "dtp": "percent",
        "dtp_points": "count",
    }
    return Table(
        slug="dominance-predictions",
        title="Share of the points at which the paper's predictions hold",
        frame=pl.DataFrame(
            rows,
            schema={
                name: pl.String if unit == "text" else pl.Int64 if unit == "count" else pl.Float64
                for name, unit in columns.items()
            },
        ),
        units=columns,
        headings={
            "predicted": "the paper",
            "violation_rate": "a predicted placement is best by V_D",
            "cost": "best by J",
            "dtp": "leads under dtp+corrected",
            "points": "points",
            "dtp_points": "points (DTP)",
        },
        note="Best among the paper's three placements.",
    )


def statics_table(runs: pl.DataFrame, candidates: Sequence[str]) -> Table:
    """One row a scenario and policy: the fourth candidate beside the others, and the rules."""
    names = (*candidates, *RULES, *(without(rule) for rule in RULES))
    import polars as pl

    kept = runs.filter(pl.col("policy").is_in(names))
    scenarios = list(dict.fromkeys(runs["scenario"]))
    ordered = kept.with_columns(
        at=pl.col("scenario").replace_strict(scenarios, list(range(len(scenarios)))),
        place=pl.col("policy").replace_strict(list(names), list(range(len(names)))),
    ).sort("at", "place", "seed")
    return Table(
        slug="dominance-cell",
        title="The cell as it is, with a fourth candidate",
        frame=over_seeds(
            ordered,
            ("scenario", "policy"),
            ["violation_rate", "l95_ms", "u_robot", "cost", "migrations", f"share_{FOURTH}"],
        ),
        units={
            "scenario": "text",
            "policy": "text",
            "violation_rate": "percent",
            "l95_ms": "ms",
            "u_robot": "percent",
            "cost": "cost",
            "migrations": "number",
            f"share_{FOURTH}": "percent",
        },
        headings={
            "violation_rate": "V_D",
            "l95_ms": "L95 (ms)",
            "u_robot": "U_r",
            "cost": "J",
            f"share_{FOURTH}": f"windows under {FOURTH}",
        },
        note="Means over seeds with 95 % intervals.",
    )


def map_table(maps: Mapping[str, Sequence[Cell]]) -> Table:
    """One row a metric and cell."""
    return Table(
        slug="dominance-map",
        title="Every cell of the maps",
        frame=_frame(maps),
        units={
            "metric": "text",
            "scenario": "text",
            "speed": "number",
            "jitter_ms": "ms",
            "winner": "text",
            "second": "text",
            "margin": "cost",
        },
        headings={
            "speed": "speed of E",
            "jitter_ms": "jitter (ms)",
            "margin": "second less winner",
        },
        note="Margins of V_D are shares: 0.01 is one point.",
    )


def _frame(maps: Mapping[str, Sequence[Cell]]) -> pl.DataFrame:
    import polars as pl

    rows = [
        {
            "metric": shown_as(metric),
            "scenario": cell.scenario,
            "speed": cell.speed,
            "jitter_ms": cell.width_ms,
            "winner": cell.winner,
            "second": cell.second,
            "margin": cell.margin,
            "margin_low": cell.low,
            "margin_high": cell.high,
            "marked": not cell.clear,
        }
        for metric, cells in maps.items()
        for cell in cells
    ]
    return pl.DataFrame(rows).fill_nan(None)


# ------------------------------------------------------------------------------- figures


def map_figure(metric: str, cells: Sequence[Cell]) -> Figure:
    """Who wins each cell, by scenario."""
    called = shown_as(metric)
    return Figure(
        slug=f"dominance-{called.lower().replace('_', '')}",
        title=f"The placement with the least {called}",
        kind="map",
        frame=_frame({metric: cells}).drop("metric"),
        x="speed",
        y="jitter_ms",
        series="winner",
        facet="scenario",
        x_label=f"speed of {EDGE}, 1 as in the cell",
        y_label="jitter on every link (ms)",
        log_x=True,
        y_unit="percent" if metric == "violation_rate" else "cost",
        line_label="not clear",
        note="Not clear: the interval of the difference to the second does not leave out 0.",
    )


def predictions_figure(papers: Mapping[str, Sequence[Cell]]) -> Figure:
    """The best of the paper's three placements at each point, hatched where it is not predicted."""
    import polars as pl

    dominant = {_mapped(one.scenario): one.dominant for one in PAPER}
    known = {
        metric: [cell for cell in cells if cell.scenario in dominant]
        for metric, cells in papers.items()
    }
    frame = _frame(known).drop("margin", "margin_low", "margin_high", "marked")
    predicted = [dominant[scenario] for scenario in frame["scenario"]]
    winners_ = frame["winner"].to_list()
    failed = [name not in names for name, names in zip(winners_, predicted, strict=True)]
    return Figure(
        slug="dominance-predictions",
        title="The best of the paper's three placements, and whether the paper predicts it for DTP",
        kind="map",
        frame=frame.with_columns(marked=pl.Series(failed, dtype=pl.Boolean)),
        x="speed",
        y="jitter_ms",
        series="winner",
        facet="scenario",
        facet_row="metric",
        x_label=f"speed of {EDGE}, 1 as in the cell",
        y_label="jitter on every link (ms)",
        line_label="not predicted",
        log_x=True,
        note=f"Without {FOURTH}. Least mean, whether or not it is clear.",
    )
