"""One run through time, as data for a figure: placements, metrics, and J believed and true."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dwell.cost import hamming, price, tier_nodes
from dwell.model import Disturbance, NodeDisturbance, Problem, QoS
from dwell.study.chapter import Figure, Panel
from dwell.study.comparison import AIM
from dwell.study.hindsight import Hindsight
from dwell.study.reference import play_alone
from dwell.study.study import Contender

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

__all__ = ["ALONE", "timeline_figure"]

#: Behind a candidate's name: what it costs when it runs alone.
ALONE = " alone"


def timeline_figure(
    problem: Problem, contender: Contender, *, scenario: str, seed: int, windows: int, slug: str
) -> Figure:
    """Play one seed and return its windows.

    Parameters
    ----------
    problem : Problem
    contender : Contender
        With an estimator by its name.
    scenario : str
    seed, windows : int
    slug : str
        Of the figure.

    Returns
    -------
    Figure
        Kind ``timeline``, with panels V_D, L95 and J. Series of J are the candidates, as they were
        believed to be, and with `ALONE` behind their names what each costs alone in the very
        cycles of the window. J is without the price of a move.
    """
    import polars as pl

    from dwell.sim import draw, simulate_realisation

    realisation = draw(problem, scenario=scenario, seed=seed, windows=windows)
    run = simulate_realisation(
        contender.problem(problem),
        realisation,
        policy=contender.policy,
        estimator=contender.estimator,
    )
    alone = Hindsight(play_alone(problem, realisation))
    alone.start(problem)
    placements = run.windows["placement"].cast(pl.String)
    lines: list[tuple[str, str, list[float | None]]] = [
        ("V_D", "V_D", run.windows["seen_violation_rate"].to_list()),
        ("L95", "L95", run.windows["seen_l95_ms"].to_list()),
        *(("J", name, values) for name, values in _estimated(run, problem).items()),
        *(("J", f"{name}{ALONE}", values) for name, values in _true(run, problem, alone).items()),
    ]
    frames = [
        pl.DataFrame(
            {
                "window": run.windows["window"],
                "panel": [panel] * len(values),
                "series": [series] * len(values),
                "y": pl.Series(values, dtype=pl.Float64),
                "placement": placements,
            }
        )
        for panel, series, values in lines
    ]
    return Figure(
        slug=slug,
        title=f"{contender.name} in {scenario}, window by window",
        kind="timeline",
        frame=pl.concat(frames),
        x="window",
        y="y",
        series="series",
        facet="panel",
        x_label=f"window of {problem.window_cycles} cycles",
        note=(
            f"Seed {seed}. J of the active placement is the measured one; of the others, full: as "
            "estimated, dotted: as each costs alone in the same cycles. Without the price of "
            "moves. V_D and L95 as the controller saw them."
        ),
        panels={
            "V_D": Panel(y_unit="percent", line_at=AIM, line_label="5 %"),
            "L95": Panel(y_unit="ms", line_at=problem.pipeline.deadline_ms, line_label="D"),
            "J": Panel(y_unit="cost"),
        },
        spans=_spans(run, problem, scenario),
    )


def _estimated(run: Run, problem: Problem) -> dict[str, list[float | None]]:
    """J that every candidate was believed to have, less the price of moving to it."""
    decisions = run.decisions
    incumbents = decisions["incumbent"].to_list()
    weight, candidates = problem.objective.weights.switching, problem.candidates
    found: dict[str, list[float | None]] = {}
    for name, placement in candidates.items():
        moving = [weight * hamming(placement, candidates[before]) for before in incumbents]
        # Windows at whose close nothing was decided have no estimate.
        values: list[float | None] = [None] * run.windows.height
        for window, cost, price_ in zip(
            decisions["window"], decisions[f"j_{name}"], moving, strict=True
        ):
            values[window] = None if cost is None else cost - price_
        found[name] = values
    return found


def _true(run: Run, problem: Problem, alone: Hindsight) -> dict[str, list[float | None]]:
    """J that every candidate alone has in the cycles of each window."""
    found: dict[str, list[float | None]] = {name: [] for name in problem.candidates}
    for first in run.windows["first_cycle"]:
        for name, metrics in alone.metrics(first).items():
            found[name].append(_priced(metrics, problem))
    return found


def _priced(metrics: QoS, problem: Problem) -> float:
    robot, edge, cloud = (
        max((metrics.utilisation[node] for node in nodes), default=0.0)
        for nodes in tier_nodes(problem.objective)
    )
    rate = metrics.violation_rate
    return float(price(metrics.l95_ms, rate, robot, edge, cloud, 0.0, problem.objective))


def _spans(run: Run, problem: Problem, scenario: str) -> pl.DataFrame:
    """Return what a scenario has on, and when in windows; episodes are drawn, and left out."""
    import polars as pl

    period_s = problem.pipeline.period_ms / 1e3
    first = run.windows["first_cycle"].to_numpy()
    edges = np.append(first, first[-1] + problem.window_cycles) * period_s
    windows = np.arange(len(edges)) - 0.5
    rows: dict[tuple[float, float, str], None] = {}
    for item in problem.scenario(scenario):
        if item.episodes is None and item.at_s < edges[-1]:
            begin, end = np.interp((item.at_s, item.end_s), edges, windows)
            rows[float(begin), float(end), _named(item)] = None
    schema = {"begin": pl.Float64, "end": pl.Float64, "label": pl.String}
    return pl.DataFrame(list(rows), schema=schema, orient="row")


def _named(item: Disturbance) -> str:
    if isinstance(item, NodeDisturbance):
        return f"{item.node} down" if item.down else f"{item.node}: {item.stress_threads} threads"
    # Both ways of a link are one line.
    ends = "-".join(sorted((item.source, item.target)))
    return f"{ends} down" if item.down else f"link {ends}"
