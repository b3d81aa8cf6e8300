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
from reproduction.verdicts import Answer, claims, judge, values

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

    delays = {width: Uniform(BASE_MS, BASE_MS + width) for width in widths}
    means = {width: Constant(BASE_MS + width / 2) for width in widths}
    spread = study("jitter", delayed(cell, WIDTH, delays), (*fixed, *adaptive))
    mean = study("jitter-mean", delayed(cell, WIDTH, means), fixed)
    classes = study("jitter-classes", delayed(cell, NETWORK, CLASSES), (*fixed, *adaptive))
    periods = study("jitter-periods", timed(cell), (*fixed, believing("dtp", "profile"), *adaptive))
    results = {one.name: run(one) for one in (spread, mean, classes, periods)}
    runs = by_envelope(results["jitter"].runs)
    narrow, even = f", w = {widths[0]:g} ms", ", delays at their mean"
    wider = pl.concat([runs, narrowest(results["jitter"].runs, widths, narrow)])
    varying = pl.concat([runs, by_envelope(results["jitter-mean"].runs, even)], how="diagonal")
    places = [at(*place) for place in product(SCENARIOS, widths)]
    beyond_first = [at(*place) for place in product(SCENARIOS, widths[1:])]
    pays = {"Offloading pays": [(OFFLOADED, LOCAL)]}
    raises = {"A wider envelope raises V_D": [(one, one + narrow) for one in spread.policies]}
    varies = {"Variation raises V_D beyond its mean": [(one, one + even) for one in mean.policies]}
    verdicts = [
        *claims(runs, ("cost", "violation_rate"), places, pays, spread),
        *claims(wider, ("violation_rate",), beyond_first, raises, spread),
        *claims(varying, ("violation_rate",), places, varies, mean),
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


def delayed(
    cell: Problem, parameter: str, delays_ms: Mapping[float, Process] | Mapping[str, Process | None]
) -> list[Point]:
    """Return a point a delay, which every link has, with nobody else's traffic; None: the cell."""
    points = []
    for value, delay_ms in delays_ms.items():
        links = {
            name: replace(link, delay_ms=delay_ms, bursts=None) if delay_ms else link
            for name, link in cell.fabric.links.items()
        }
        fabric = replace(cell.fabric, links=FrozenDict(links))
        points.append(Point({parameter: value}, replace(cell, fabric=fabric)))
    return points


# --------------------------------------------------------------------------------- reading


def at(scenario: str, width: float) -> str:
    """Name of a scenario at an envelope."""
    return f"{scenario}, w = {width:g} ms"


def by_envelope(runs: pl.DataFrame, suffix: str = "") -> pl.DataFrame:
    """Return runs with the envelope in the scenario's name, and a suffix behind the policy's."""
    suffixes = {width: at("", width) for width in ENVELOPES_MS}
    return runs.with_columns(
        scenario=pl.col("scenario") + pl.col(AT).replace_strict(suffixes),
        policy=pl.col("policy") + suffix,
    )


def narrowest(runs: pl.DataFrame, widths: Sequence[float], suffix: str) -> pl.DataFrame:
    """Return the runs at the narrowest envelope as if they were those of every wider one."""
    first = runs.filter(pl.col(AT) == widths[0])
    moved = (first.with_columns(pl.lit(width).alias(AT)) for width in widths[1:])
    return pl.concat(by_envelope(one, suffix) for one in moved)


def turning(
    runs: pl.DataFrame, scenario: str, widths: Sequence[float], study: Study
) -> pl.DataFrame:
    """Judge up to which envelope offloading costs less by J: the median over seeds."""
    offloaded, local = (
        np.stack([values(runs, "cost", scenario=at(scenario, w), policy=who) for w in widths])
        for who in (OFFLOADED, LOCAL)
    )
    known = median_interval([turning_point(widths, one) for one in (offloaded - local).T])
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
