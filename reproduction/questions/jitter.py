"""Jitter of the links as an axis: how much of it offloading bears.

A message's delay is 0.7 ms and an extra that is even on [0, w]: w is the envelope. Beside every
point stands one whose extra is constant at w/2: what the two differ in is due to variation alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import polars as pl

from dwell.model import Constant, FrozenDict, LogNormal, Problem, Process, Uniform
from dwell.study import Contender, Point, Study, median_interval
from reproduction.cell import believing, rules, statics
from reproduction.questions import Run
from reproduction.scale import Scale
from reproduction.verdicts import Answer, Pairs, between, compare, judge, values

TITLE = "Does the jitter of the links decide where the stages should run?"

#: Propagation of every message, one way.
BASE_MS = 0.7
#: w, ms: from TSN to a bad radio.
ENVELOPES_MS = (0.001, 0.01, 0.1, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
FEW_MS = (0.001, 1.0, 4.0, 32.0)
PERIODS_MS = (20.0, 33.333333, 50.0)
SCENARIOS = ("baseline", "robot-cpu-stress")
#: The placement that offloads, and the one that does not.
OFFLOADED, LOCAL = "SO", "LOC"
WIDTH, NETWORK, PERIOD = "envelope_ms", "network", "period_ms"
AT = f"parameter.{WIDTH}"
METRICS = ("violation_rate", "l95_ms", "cost", "migrations", "aoi_mean_ms", "tracking_rms_mm")

#: What links of a class of networks delay a message by; None: as the cell's, with their bursts.
CLASSES: Mapping[str, Process | None] = {
    "TSN, scheduled": Uniform(BASE_MS, BASE_MS + 0.001),
    "LAN, quiet": Uniform(BASE_MS, BASE_MS + 0.12),
    "LAN, as in the cell": None,
    "Wi-Fi": LogNormal(4.3, 0.67),
    "5G": LogNormal(6.5, 0.23),
}


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Vary the jitter of all links, by its envelope and by class; and the period."""
    fixed, adaptive = statics(cell), rules()
    widths = FEW_MS if scale.coarse else ENVELOPES_MS

    def study(name: str, points: Sequence[Point], who: Sequence[Contender]) -> Study:
        return Study(name, tuple(points), SCENARIOS, tuple(who), scale.some_seeds, scale.windows)

    spread = study("jitter", enveloped(cell, widths), (*fixed, *adaptive))
    mean = study("jitter-mean", enveloped(cell, widths, spread=False), fixed)
    classes = study("jitter-classes", classed(cell), (*fixed, *adaptive))
    periods = study("jitter-periods", timed(cell), (*fixed, believing("dtp", "profile"), *adaptive))
    results = {one.name: run(one) for one in (spread, mean, classes, periods)}
    runs = results["jitter"].runs
    both = pl.concat(
        results[name]
        .runs.select(AT, "scenario", "policy", "seed", "violation_rate")
        .with_columns(spread=pl.lit(name))
        for name in ("jitter", "jitter-mean")
    )
    rate, beyond = ("violation_rate",), "Variation raises V_D beyond its mean"
    verdicts = [
        compare(runs, "Offloading pays", ("cost", *rate), offloading(widths), spread),
        compare(runs, "A wider envelope raises V_D", rate, wider(spread, widths), spread),
        compare(both, beyond, rate, varying(mean, widths), mean),
        *(turning(runs, scenario, widths, spread) for scenario in SCENARIOS),
    ]
    return Answer(
        pl.concat(verdicts),
        {
            "Envelopes of jitter": results["jitter"].table(METRICS),
            "Classes of networks": results["jitter-classes"].table(METRICS),
            "Periods, with D = P": results["jitter-periods"].table(METRICS),
        },
    )


# ---------------------------------------------------------------------------------- points


def enveloped(cell: Problem, widths: Sequence[float], *, spread: bool = True) -> list[Point]:
    """Return a point for every envelope, or one with the mean of its delays alone."""
    return [
        Point(
            {WIDTH: width},
            with_delay(
                cell,
                Uniform(BASE_MS, BASE_MS + width) if spread else Constant(BASE_MS + width / 2),
            ),
        )
        for width in widths
    ]


def classed(cell: Problem) -> list[Point]:
    """Return a point for every class of networks."""
    return [
        Point({NETWORK: name}, cell if delay_ms is None else with_delay(cell, delay_ms))
        for name, delay_ms in CLASSES.items()
    ]


def timed(cell: Problem) -> list[Point]:
    """Return a point for every period, the deadline and the target of L95 with it."""
    points = []
    for period_ms in PERIODS_MS:
        targets = replace(cell.objective.targets, latency_ms=period_ms)
        other = replace(
            cell,
            pipeline=replace(cell.pipeline, period_ms=period_ms, deadline_ms=period_ms),
            objective=replace(cell.objective, targets=targets),
        )
        points.append(Point({PERIOD: period_ms}, other))
    return points


def with_delay(cell: Problem, delay_ms: Process) -> Problem:
    """Return the cell with the same delay on every link, and nobody else's traffic."""
    links = {
        name: replace(link, delay_ms=delay_ms, bursts=None)
        for name, link in cell.fabric.links.items()
    }
    return replace(cell, fabric=replace(cell.fabric, links=FrozenDict(links)))


# --------------------------------------------------------------------------------- reading


def offloading(widths: Sequence[float]) -> Pairs:
    """Return offloading both stages beside none, at every envelope."""
    return {
        (at(scenario, width), OFFLOADED, LOCAL): between(scenario, OFFLOADED, LOCAL, **{AT: width})
        for scenario, width in product(SCENARIOS, widths)
    }


def wider(study: Study, widths: Sequence[float]) -> Pairs:
    """Return every envelope beside the narrowest."""
    first = widths[0]
    return {
        (at(scenario, width), policy, f"{policy}, w = {first:g} ms"): (
            {"scenario": scenario, "policy": policy, AT: width},
            {"scenario": scenario, "policy": policy, AT: first},
        )
        for scenario, policy, width in product(SCENARIOS, study.policies, widths[1:])
    }


def varying(study: Study, widths: Sequence[float]) -> Pairs:
    """Return delays as they are beside all of them at their mean."""
    found: dict[tuple[str, str, str], tuple[dict[str, object], dict[str, object]]] = {}
    for scenario, policy, width in product(SCENARIOS, study.policies, widths):
        labels: dict[str, object] = {"scenario": scenario, "policy": policy, AT: width}
        names = (at(scenario, width), policy, f"{policy}, delays at their mean")
        found[names] = ({**labels, "spread": "jitter"}, {**labels, "spread": "jitter-mean"})
    return found


def at(scenario: str, width: float) -> str:
    """Name of a scenario at an envelope."""
    return f"{scenario}, w = {width:g} ms"


def turning(
    runs: pl.DataFrame, scenario: str, widths: Sequence[float], study: Study
) -> pl.DataFrame:
    """Judge up to which envelope offloading costs less by J: the median over seeds."""
    here = runs.filter(scenario=scenario)
    excess = np.stack(
        [
            np.subtract(
                *(values(here, "cost", policy=who, **{AT: w}) for who in (OFFLOADED, LOCAL))
            )
            for w in widths
        ]
    )
    known = median_interval([turning_point(widths, one) for one in excess.T])
    word = "cannot tell"
    if known.known:
        within = known.low > 0 and np.isfinite(known.high)
        never, always = known.high == 0, np.isinf(known.low)
        word = "turns" if within else "never" if never else "always" if always else "not shown"
    claim = "Offloading ceases to pay at an envelope (ms)"
    return judge(claim, scenario, OFFLOADED, WIDTH, known, word, study)


def turning_point(widths: Sequence[float], excess: np.ndarray) -> float:
    """Width at which an excess over zero begins and stays; widths ascend, above 0.

    By linear interpolation over the logarithm between the last width with an excess below 0 and
    the next; 0 where there is none below, infinite where the last is below.
    """
    last = max((index for index, value in enumerate(excess) if value < 0), default=None)
    if last is None:
        return 0.0
    if last == len(widths) - 1:
        return float("inf")
    (low, high), (below, above) = list(pairwise(np.log(widths)))[last], excess[last : last + 2]
    return float(np.exp(low - below / (above - below) * (high - low)))
