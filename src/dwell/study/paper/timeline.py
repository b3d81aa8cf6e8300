"""One run through time, as data for a figure: placements, metrics, and J believed and true."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dwell.cost import hamming, price, tier_nodes
from dwell.model import Disturbance, NodeDisturbance, Problem, QoS
from dwell.study.hindsight import Hindsight
from dwell.study.paper.chapter import Figure
from dwell.study.reference import play_alone
from dwell.study.study import Contender

if TYPE_CHECKING:

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
        Kind ``timeline``. Its frame has one row a window, panel and series, and beside ``y``

        * ``panel``: ``V_D``, ``L95 (ms)``, ``J estimated`` and ``J alone``;
        * ``series``: the metric's name, or a candidate (with `ALONE` behind it where it is what it
          costs alone in the very cycles of the window);
        * ``dashed``: whether it is the latter;
        * ``level``: what the panel's values are to stay below, null where there is nothing;
        * ``placement`` of the window, and the ``disturbance`` that is on in its middle.

        J is without the price of a move.
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
    on = [
        _on(problem, scenario, (first + problem.window_cycles / 2) * problem.pipeline.period_ms)
        for first in run.windows["first_cycle"]
    ]
    lines: list[tuple[str, str, bool, float | None, list[float | None]]] = [
        ("V_D", "V_D", False, 0.05, run.windows["seen_violation_rate"].to_list()),
        (
            "L95 (ms)",
            "L95",
            False,
            problem.pipeline.deadline_ms,
            run.windows["seen_l95_ms"].to_list(),
        ),
        *(("J", name, False, None, values) for name, values in _estimated(run, problem).items()),
        *(
            ("J", f"{name}{ALONE}", True, None, values)
            for name, values in _true(run, problem, alone).items()
        ),
    ]
    frames = [
        pl.DataFrame(
            {
                "window": run.windows["window"],
                "panel": [panel] * len(values),
                "series": [series] * len(values),
                "y": pl.Series(values, dtype=pl.Float64),
                "dashed": [dashed] * len(values),
                "level": pl.Series([level] * len(values), dtype=pl.Float64),
                "placement": placements,
                "disturbance": on,
            }
        )
        for panel, series, dashed, level, values in lines
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
            "estimated, dashed: as each alone costs in the same cycles. Without the price of "
            "moves. V_D and L95 as the controller saw them."
        ),
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


def _on(problem: Problem, scenario: str, at_ms: float) -> str:
    """Say what a scenario has on at an instant; episodes, which are drawn, are left out."""
    at_s = at_ms / 1e3
    active = [
        item
        for item in problem.scenario(scenario)
        if item.at_s <= at_s < item.at_s + item.for_s and item.episodes is None
    ]
    return ", ".join(dict.fromkeys(_named(item) for item in active))


def _named(item: Disturbance) -> str:
    if isinstance(item, NodeDisturbance):
        return f"{item.node} down" if item.down else f"{item.node}: {item.stress_threads} threads"
    return f"{item.link} down" if item.down else item.link
