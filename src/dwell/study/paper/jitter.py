"""Jitter of the links as an axis: how much of it offloading bears.

A message's delay is 0.7 ms (a round trip of 1.4 ms, within the paper's 1 to 2 ms) and an extra that
is even on [0, w]: w is the *envelope*, the bound within which a network keeps its delays, which is
what TSN is about. Jitter cannot make a delay shorter, so that a wider envelope is a longer mean as
well; beside every point stands one whose extra is constant at w/2. What the two differ in is due
to variation alone.

Classes of networks are points with names, each with the distribution and the source that
`CLASSES` states. None loses messages here: loss is the impairments' part.

References
----------
* TSN scheduled: below 1 µs is what industrial networks for motion aim for; with IEEE 802.1Qbv a
  mean jitter of 63 ns was measured, best effort on the same switches 16 µs, at most 120 µs
  (vernetzte-adaptive-produktion.de/en/Results/tsn.html).
* LAN as in the cell, and the frames of other cameras that it queues behind: docs/canonical-cell.md.
* Wi-Fi: EdgeDroid, uplink 6.1 ms (standard deviation 2.9), downlink 2.6 ms (docs/real-traces.md).
* 5G: private standalone network, 95 % of the downlink delays within 4 to 10 ms (core.ac.uk,
  work 150354694).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model import Constant, FrozenDict, Link, LogNormal, Problem, Process, Uniform
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.comparison import AIM
from dwell.study.engine import PARAMETER, StudyResult
from dwell.study.family import Comparative, Family
from dwell.study.intervals import Interval, median_interval, under
from dwell.study.over_seeds import over_seeds
from dwell.study.paper.cell import present
from dwell.study.paper.contenders import believing, statics
from dwell.study.paper.contrasts import Contrast, family_of, values
from dwell.study.paper.differences import centre, difference_table, families
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import listed, number, percent, with_interval
from dwell.study.study import Contender, Point, Study

__all__ = ["Turn", "chapter", "turning_point", "verdict"]

Floats: TypeAlias = NDArray[np.float64]
#: What was shown, by the envelope in ms.
Said: TypeAlias = Mapping[float, Comparative]

#: Propagation of every message, one way.
BASE_MS = 0.7
#: w, ms: from TSN to a bad radio.
ENVELOPES_MS = (0.001, 0.01, 0.1, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
FEW_MS = (0.001, 1.0, 4.0, 32.0)
#: What a wired network that is not overloaded keeps.
WIRED_MS = 0.1
#: Change of V_D that is worth speaking of: a fifth of the aim.
MATERIAL = 0.01
SCENARIOS = ("baseline", "robot-cpu-stress")
#: The placement that offloads, and the one that does not.
OFFLOADED, LOCAL = "SO", "LOC"

PERIODS_MS = (20.0, 33.333333, 50.0)

WIDTH, SPREAD, NETWORK, PERIOD = "envelope_ms", "spread", "network", "period_ms"
#: Values of `SPREAD`: delays as they are, or all of them at their mean.
SPREADS = ("spread", "its mean")

METRICS: Mapping[str, Unit] = FrozenDict(
    {
        "violation_rate": "percent",
        "l95_ms": "ms",
        "cost": "cost",
        "migrations": "number",
        "aoi_mean_ms": "ms",
        "tracking_rms_mm": "number",
    }
)
HEADINGS = FrozenDict(
    {
        "violation_rate": "V_D",
        "aim": "V_D under 5 %",
        "l95_ms": "L95 (ms)",
        "cost": "J",
        "aoi_mean_ms": "mean age (ms)",
        "tracking_rms_mm": "tracking RMS (mm)",
        WIDTH: "w (ms)",
        SPREAD: "delays",
        PERIOD: "P = D (ms)",
    }
)


@dataclass(frozen=True, slots=True)
class Network:
    """A class of networks: what its links delay a message by.

    Parameters
    ----------
    delay_ms : Process, optional
        As the cell's links, with their bursts, where None.
    words : str
        What it is, for the design.
    """

    delay_ms: Process | None
    words: str


CLASSES: Mapping[str, Network] = FrozenDict(
    {
        "TSN, scheduled": Network(
            Uniform(BASE_MS, BASE_MS + 0.001), "0.7 ms and up to 1 µs (IEEE 802.1Qbv)"
        ),
        "LAN, quiet": Network(
            Uniform(BASE_MS, BASE_MS + 0.12), "0.7 ms and up to 120 µs (best effort, measured)"
        ),
        "LAN, as in the cell": Network(
            None, "lognormal(0.7, cv 0.3) ms, other cameras' frames at E's port 2 % of the time"
        ),
        "Wi-Fi": Network(
            LogNormal(4.3, 0.67), "lognormal, mean 4.3 and deviation 2.9 ms (EdgeDroid)"
        ),
        "5G": Network(
            LogNormal(6.5, 0.23), "lognormal, mean 6.5 ms, 95 % within 4 to 10 ms (private 5G)"
        ),
    }
)


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Vary the jitter of all links, by its envelope and by class; and the period."""
    scenarios = present(problem, SCENARIOS)
    adaptive = (believing("dtp", "corrected"), believing("cusum", "corrected"))
    fixed = statics(problem)
    widths = FEW_MS if scale.coarse else ENVELOPES_MS

    def run(
        name: str,
        points: Sequence[Point],
        contenders: Sequence[Contender],
    ) -> StudyResult:
        return runner.run(
            Study(
                name=name,
                points=tuple(points),
                scenarios=scenarios,
                contenders=tuple(contenders),
                seeds=scale.some_seeds,
                windows=scale.windows,
            )
        )

    return written(
        run("jitter", enveloped(problem, widths), (*fixed, *adaptive)),
        run("jitter-mean", enveloped(problem, widths, spread=False), fixed),
        run("jitter-classes", classed(problem), (*fixed, *adaptive)),
        run("jitter-periods", timed(problem), (*fixed, believing("dtp", "profile"), *adaptive)),
    )


def enveloped(problem: Problem, widths_ms: Sequence[float], *, spread: bool = True) -> list[Point]:
    """Return a point for every envelope, or one with the mean of its delays alone."""
    return [
        Point(
            {WIDTH: width_ms},
            with_delay(
                problem,
                Uniform(BASE_MS, BASE_MS + width_ms)
                if spread
                else Constant(BASE_MS + width_ms / 2),
            ),
        )
        for width_ms in widths_ms
    ]


def classed(problem: Problem) -> list[Point]:
    """Return a point for every class of networks."""
    return [
        Point(
            {NETWORK: name},
            problem if one.delay_ms is None else with_delay(problem, one.delay_ms),
        )
        for name, one in CLASSES.items()
    ]


def timed(problem: Problem) -> list[Point]:
    """Return a point for every period, the deadline and the target of L95 with it."""
    points = []
    for period_ms in PERIODS_MS:
        pipeline = replace(problem.pipeline, period_ms=period_ms, deadline_ms=period_ms)
        objective = replace(
            problem.objective, targets=replace(problem.objective.targets, latency_ms=period_ms)
        )
        other = replace(problem, pipeline=pipeline, objective=objective)
        points.append(Point({PERIOD: period_ms}, other))
    return points


def with_delay(problem: Problem, delay_ms: Process) -> Problem:
    """Return the problem with the same delay on every link, and nobody else's traffic."""

    def changed(link: Link) -> Link:
        return replace(link, delay_ms=delay_ms, bursts=None)

    links = {name: changed(link) for name, link in problem.fabric.links.items()}
    return replace(problem, fabric=replace(problem.fabric, links=FrozenDict(links)))


# ------------------------------------------------------------------------------- reading


@dataclass(frozen=True, slots=True)
class Turn:
    """From which envelope on offloading costs more in a scenario.

    Parameters
    ----------
    scenario : str
    at_ms : Interval
        Median over seeds; 0 where it is worse at every envelope, infinite where at none.
    """

    scenario: str
    at_ms: Interval

    @property
    def within(self) -> bool:
        """Whether it turns, with its whole interval, on the axis."""
        return self.at_ms.known and self.at_ms.low > 0 and np.isfinite(self.at_ms.high)

    @property
    def never(self) -> bool:
        """Whether offloading is surely worse from the begin."""
        return self.at_ms.known and self.at_ms.high == 0

    @property
    def always(self) -> bool:
        """Whether offloading surely pays to the end of the axis."""
        return self.at_ms.known and bool(np.isinf(self.at_ms.low))

    def __str__(self) -> str:
        """Return it as a part of a sentence."""
        # With few seeds there is no interval, and the median is all there is.
        median, alone = self.at_ms.value, not self.at_ms.known
        if self.never or (alone and median == 0):
            return "at no envelope"
        if self.always or (alone and np.isinf(median)):
            return f"up to {number(ENVELOPES_MS[-1], 0)} ms and beyond"
        if np.isinf(median):
            return f"up to {number(self.at_ms.low)} ms at least"
        return f"up to {with_interval(self.at_ms)} ms"


def turning_point(widths: Sequence[float], excess: Floats) -> float:
    """Width at which an excess over zero begins and stays.

    Parameters
    ----------
    widths : sequence of float
        Ascending, above 0.
    excess : float64 array
        At each of them; at or above 0 offloading is worse.

    Returns
    -------
    float
        By linear interpolation over the logarithm between the last width with an excess below 0
        and the next; 0 where there is none below, infinite where the last is below.
    """
    below = np.flatnonzero(excess < 0)
    if not below.size:
        return 0.0
    last = int(below[-1])
    if last == len(widths) - 1:
        return float("inf")
    ends = np.log(widths[last : last + 2])
    share = -excess[last] / (excess[last + 1] - excess[last])
    return float(np.exp(ends[0] + share * (ends[1] - ends[0])))


def widths_of(study: Study) -> tuple[float, ...]:
    """Return the envelopes of a study, ms."""
    return tuple(float(point.values[WIDTH]) for point in study.points)


def turns(result: StudyResult) -> list[Turn]:
    """Return where offloading ceases to pay by J, in every scenario."""
    found = []
    widths = widths_of(result.study)
    for scenario in result.study.scenarios:
        excess = np.stack(
            [
                values(result.runs, "cost", _at(width, scenario, OFFLOADED))
                - values(result.runs, "cost", _at(width, scenario, LOCAL))
                for width in widths
            ]
        )
        points = [turning_point(widths, one) for one in excess.T]
        found.append(Turn(scenario, median_interval(points)))
    return found


def offloading(result: StudyResult) -> dict[str, Family]:
    """Compare offloading both stages to none, at every envelope, by J and by V_D."""
    pairs: dict[str, Contrast] = {
        _widened(scenario, width): (
            _at(width, scenario, OFFLOADED),
            _at(width, scenario, LOCAL),
        )
        for scenario in result.study.scenarios
        for width in widths_of(result.study)
    }
    return families(result.runs, "does offloading pay?", ("cost", "violation_rate"), pairs)


def _widened(scenario: str, width: float) -> str:
    return f"{scenario}: w = {width:g} ms"


def said_of(compared: Mapping[str, Family], study: Study) -> dict[str, dict[str, Said]]:
    """Return what was shown of offloading, by metric, scenario and envelope."""
    found: dict[str, dict[str, Said]] = {}
    for metric, family in compared.items():
        verdicts = family.verdicts
        found[metric] = {
            scenario: {width: verdicts[_widened(scenario, width)] for width in widths_of(study)}
            for scenario in study.scenarios
        }
    return found


def _at(width: float, scenario: str, policy: str) -> dict[str, object]:
    return {PARAMETER + WIDTH: width, "scenario": scenario, "policy": policy}


def against_tsn(result: StudyResult) -> Family:
    """Compare V_D at every envelope to that at the narrowest one."""
    study = result.study
    narrowest, *wider = widths_of(study)
    pairs: dict[str, Contrast] = {
        f"{scenario}: {policy}, w = {width:g} ms": (
            _at(width, scenario, policy),
            _at(narrowest, scenario, policy),
        )
        for scenario in study.scenarios
        for policy in study.policies
        for width in wider
    }
    return family_of(
        result.runs, "an envelope against that of scheduled TSN", "violation_rate", pairs
    )


def against_mean(result: StudyResult, mean: StudyResult) -> Family:
    """Compare V_D with delays that vary to V_D with all of them at their mean."""
    import polars as pl

    runs = pl.concat(
        [
            one.runs.select(
                PARAMETER + WIDTH, "scenario", "policy", "seed", "violation_rate"
            ).with_columns(pl.lit(name).alias(SPREAD))
            for one, name in zip((result, mean), SPREADS, strict=True)
        ]
    )
    pairs: dict[str, Contrast] = {
        f"{scenario}: {policy}, w = {width:g} ms": (
            {**_at(width, scenario, policy), SPREAD: SPREADS[0]},
            {**_at(width, scenario, policy), SPREAD: SPREADS[1]},
        )
        for scenario in mean.study.scenarios
        for policy in mean.study.policies
        for width in widths_of(mean.study)
    }
    return family_of(runs, "variation against its mean alone", "violation_rate", pairs)


# ------------------------------------------------------------------------------- verdict


def verdict(found: Sequence[Turn], said: Mapping[str, Mapping[str, Said]]) -> Outcome:
    """Answer whether the jitter of the links decides where the stages should run.

    Parameters
    ----------
    found : sequence of Turn
        In every scenario.
    said : mapping of metric to mapping of scenario to mapping of float to verdict
        Of offloading, against none, at every envelope (see `offloading`).
    """
    decided = [one for one in found if one.within]
    answer: Answer
    if len(decided) == len(found):
        answer = "yes"
    elif decided:
        answer = "in part"
    elif all(one.never or one.always for one in found):
        answer = "no"
    else:
        answer = "not shown"
    costs = "; ".join(
        f"in {scenario} less {_stretches(mine, 'lower')} and more {_stretches(mine, 'higher')}"
        for scenario, mine in said["cost"].items()
    )
    crossed = ", ".join(f"{one} in {one.scenario}" for one in found)
    rates = tuple(
        f"V_D of {OFFLOADED} against that of {LOCAL} in {scenario}: lower "
        f"{_stretches(mine, 'lower')}, higher {_stretches(mine, 'higher')}."
        for scenario, mine in said["violation_rate"].items()
    )
    return Outcome(
        answer,
        f"Offloading both stages ({OFFLOADED}) is shown to cost, by J and against {LOCAL}, "
        f"{costs} (width of the envelope of extra delays).",
        (
            f"The widest envelope at which J of {OFFLOADED} is below that of {LOCAL}, seed by "
            f"seed: {crossed}.",
            *rates,
        ),
    )


def _stretches(said: Said, word: Comparative) -> str:
    """``at 0.001 to 2 ms and at 8 ms``: the envelopes at which it was shown."""
    stretches: list[list[float]] = []
    before = False
    for width, one in said.items():
        if one == word:
            stretches += [] if before else [[]]
            stretches[-1].append(width)
        before = one == word
    texts = (
        f"at {mine[0]:g} ms" if len(mine) == 1 else f"at {mine[0]:g} to {mine[-1]:g} ms"
        for mine in stretches
    )
    return listed(texts) if stretches else "at no envelope"


# ------------------------------------------------------------------------------- chapter


def written(
    result: StudyResult, mean: StudyResult, classes: StudyResult, periods: StudyResult
) -> Chapter:
    """Write the chapter of finished runs."""
    pays = offloading(result)
    outcome = verdict(turns(result), said_of(pays, result.study))
    widths = numbers_table(
        result, "jitter", "Envelopes of jitter", {PARAMETER + WIDTH: (WIDTH, "number")}
    )
    named = numbers_table(
        classes, "jitter-classes", "Classes of networks", {PARAMETER + NETWORK: (NETWORK, "text")}
    )
    spans = numbers_table(
        periods, "jitter-periods", "Periods", {PARAMETER + PERIOD: (PERIOD, "number")}
    )
    tsn, alone = against_tsn(result), against_mean(result, mean)
    return Chapter(
        slug="jitter",
        title="Does the jitter of the links decide where the stages should run?",
        design=design(result.study, periods.study),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(
            *first_shown(tsn, result.study),
            variation(alone),
            *widest_under(widths),
            *under_aim(named, NETWORK, ""),
            *under_aim(spans, PERIOD, " ms"),
        ),
        tables=(
            widths,
            named,
            spans,
            difference_table(
                pays,
                slug="jitter-offloading",
                title=f"{OFFLOADED}, less {LOCAL}, over the envelope of jitter",
            ),
            difference_table(
                {"violation_rate": tsn},
                slug="jitter-tsn",
                title=f"An envelope, less one of {1000 * ENVELOPES_MS[0]:g} µs",
            ),
            difference_table(
                {"violation_rate": alone},
                slug="jitter-variation",
                title="Delays as they are, less all of them at their mean",
            ),
        ),
        figures=(
            width_figure(widths, "violation_rate"),
            width_figure(widths, "l95_ms"),
            width_figure(widths, "cost"),
            classes_figure(named),
        ),
    )


def design(study: Study, periods: Study) -> str:
    """Say what was varied."""
    classes = "; ".join(f"{name}: {one.words}" for name, one in CLASSES.items())
    return (
        f"Every message on every link takes {number(BASE_MS, 1)} ms (a round trip of "
        f"{number(2 * BASE_MS, 1)} ms) and an extra that is even on [0, w], w from "
        f"{number(1000 * ENVELOPES_MS[0], 0)} µs to {number(ENVELOPES_MS[-1], 0)} ms; the bursts "
        f"at E's port are left out. {listed(study.policies)} in {listed(study.scenarios)}, "
        f"{len(study.seeds)} seeds of {study.windows} windows, the same draws at every w. As a "
        "wider envelope is a longer mean, too, static placements are also run with all delays at "
        "their mean. Where offloading ceases to pay is found seed by seed, between the last "
        f"envelope at which {OFFLOADED} has a lower J than {LOCAL} and the next, with the 95 % "
        "interval of the median over seeds. Differences in J and V_D are paired by seed (sign-flip "
        "test, Holm over each metric of a table). Classes of networks: "
        f"{classes}. Periods of {listed(f'{one:.3g}' for one in PERIODS_MS)} ms with D = P and "
        "the target of L95 at D, the work of a cycle as it is "
        f"({listed(periods.policies)})."
    )


def first_shown(tsn: Family, study: Study) -> tuple[str, ...]:
    """Say how little a wired network's jitter does, and from where on V_D is shown to suffer."""
    widths = widths_of(study)[1:]
    verdicts = tsn.verdicts
    named = {
        (scenario, policy, width): f"{scenario}: {policy}, w = {width:g} ms"
        for scenario in study.scenarios
        for policy in study.policies
        for width in widths
    }
    wired = {name: centre(tsn, name) for (*_, width), name in named.items() if width <= WIRED_MS}
    found = []
    if wired:
        most = max(wired, key=lambda name: abs(wired[name]))
        found.append(
            f"Up to an envelope of {WIRED_MS:g} ms, as wired networks keep it, V_D differs from "
            f"that with {number(1000 * ENVELOPES_MS[0], 0)} µs by at most "
            f"{number(100 * abs(wired[most]), 2)} points ({most})."
        )
    for scenario in study.scenarios:
        texts = []
        for policy in study.policies:
            shown = [
                width
                for width in widths
                if verdicts[named[scenario, policy, width]] == "higher"
                and tsn.comparisons[named[scenario, policy, width]].low > MATERIAL
            ]
            texts.append(f"{policy} {f'{shown[0]:g} ms' if shown else 'none'}")
        found.append(
            f"{scenario}: the narrowest envelope at which V_D is shown to be more than "
            f"{number(100 * MATERIAL, 0)} point above that: {', '.join(texts)}."
        )
    return tuple(found)


def variation(alone: Family) -> str:
    """Say what variation does to V_D beyond its mean."""
    verdicts = alone.verdicts
    higher = [name for name, said in verdicts.items() if said == "higher"]
    lower = [name for name, said in verdicts.items() if said == "lower"]
    text = (
        f"Against the same mean delay without variation, V_D is shown to be higher in "
        f"{len(higher)} and lower in {len(lower)} of {len(verdicts)} comparisons"
    )
    sizes = {name: centre(alone, name) for name in (*higher, *lower)}
    if not sizes:
        return f"{text}."
    most = max(sizes, key=lambda name: abs(sizes[name]))
    return f"{text}; most in {most}, by {number(100 * sizes[most])} points."


def under_aim(table: Table, column: str, unit: str) -> tuple[str, ...]:
    """Say who keeps V_D under the aim at each value of a parameter.

    Whoever misses nothing at all is named apart: without a miss, only very many runs show it.
    """
    found = []
    for (scenario,), mine in table.frame.group_by(["scenario"], maintain_order=True):
        texts = []
        for (value,), rows in mine.group_by([column], maintain_order=True):
            kept = rows.filter(rows["aim"] == "under")["policy"].to_list()
            spotless = rows.filter((rows["aim"] != "under") & (rows["violation_rate"] == 0))
            shown = f"{value:.3g}" if isinstance(value, float) else str(value)
            text = f"{shown}{unit}: {listed(kept)}"
            if spotless.height:
                text += (
                    f" (too few runs to show it of {listed(spotless['policy'])}, without a miss)"
                )
            texts.append(text)
        found.append(f"{scenario}, V_D shown to be under {percent(AIM, 0)}: {'; '.join(texts)}.")
    return tuple(found)


def widest_under(widths: Table) -> tuple[str, ...]:
    """Say up to which envelope each policy keeps V_D under the aim."""
    found = []
    for (scenario,), mine in widths.frame.group_by(["scenario"], maintain_order=True):
        texts = []
        for (policy,), rows in mine.group_by(["policy"], maintain_order=True):
            kept = rows.filter(rows["aim"] == "under")[WIDTH].to_list()
            texts.append(f"{policy} {f'up to {max(kept):g} ms' if kept else 'at none'}")
        found.append(
            f"{scenario}, envelopes at which V_D is shown to be under {percent(AIM, 0)}: "
            f"{', '.join(texts)}."
        )
    return tuple(found)


def numbers_table(
    result: StudyResult, slug: str, title: str, parameter: Mapping[str, tuple[str, Unit]]
) -> Table:
    """One row a value of the parameter, scenario and policy."""
    import polars as pl

    (column, (name, unit)) = next(iter(parameter.items()))
    columns = [one for one in METRICS if one in result.runs.columns]
    keys = (column, "scenario", "policy")
    frame = over_seeds(result.runs, keys, columns)
    aims = [
        under(values(result.runs, "violation_rate", dict(zip(keys, row, strict=True))), AIM)
        for row in frame.select(keys).rows()
    ]
    study = result.study
    return Table(
        slug=slug,
        title=title,
        frame=frame.with_columns(pl.Series("aim", aims)).rename({column: name}),
        units={
            "scenario": "text",
            name: unit,
            "policy": "text",
            "violation_rate": "percent",
            "aim": "text",
            **{one: METRICS[one] for one in columns},
        },
        headings=HEADINGS,
        note=(
            f"Mean over {len(study.seeds)} seeds of {study.windows} windows with its 95 % interval "
            "(tracking: median)."
        ),
    )


def width_figure(widths: Table, metric: str) -> Figure:
    """Return a metric over the envelope."""
    import polars as pl

    marked = metric == "violation_rate"
    return Figure(
        slug=f"jitter-{metric.replace('_', '-')}",
        title=f"{HEADINGS[metric]} over the envelope of jitter",
        kind="lines",
        frame=widths.frame.select(
            "scenario",
            "policy",
            pl.col(WIDTH).alias("x"),
            *(pl.col(f"{metric}{end}").alias(f"y{end}") for end in ("", "_low", "_high")),
        ),
        x="x",
        y="y",
        series="policy",
        facet="scenario",
        x_label="envelope of the extra delay w (ms)",
        y_label=HEADINGS[metric],
        y_unit=METRICS[metric],
        line_at=AIM if marked else None,
        line_label="5 %" if marked else "",
        log_x=True,
        log_y=marked,
        note=widths.note,
    )


def classes_figure(named: Table) -> Figure:
    """V_D by class of network."""
    return Figure(
        slug="jitter-classes",
        title="Missed deadlines by class of network",
        kind="intervals",
        frame=named.frame.select(
            "scenario",
            "policy",
            named.frame[NETWORK].alias("x"),
            *(
                named.frame[f"violation_rate{end}"].alias(f"y{end}")
                for end in ("", "_low", "_high")
            ),
        ),
        x="x",
        y="y",
        series="policy",
        facet="scenario",
        y_label="V_D",
        y_unit="percent",
        line_at=AIM,
        line_label="5 %",
        log_y=True,
        note=named.note,
    )
