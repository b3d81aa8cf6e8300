"""RQ2: T3 to R2 during network faults, against going back and forth between R1 and E.

HYB (T2 on E, T3 on R2) crosses the same links as SO in this cell, and in the same direction. So
the paper's fault, which slows all directions of both, cannot tell them apart by the links; it is
therefore also put on one direction and on one link, made smaller and larger, and joined by stress
of the nodes that the other two placements live on. What HYB is worth under that stress without any
fault is measured as well: only what goes beyond it is the fault's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model import LinkDisturbance, NodeDisturbance, Normal, Placement, Problem, Scenario
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.comparison import AIM
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.over_seeds import over_seeds
from dwell.study.paired import paired_difference
from dwell.study.paper.contenders import believing, statics
from dwell.study.paper.contrasts import Contrast, values
from dwell.study.paper.differences import centre, difference_table, families, shown_as
from dwell.study.paper.rates import rates_figure
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, points
from dwell.study.paper.tuning import thinned
from dwell.study.paper.variants import on_and_off, with_candidates, with_scenarios
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

__all__ = ["chapter", "crossed", "fault_scenarios", "sweep_points", "verdict"]

Floats: TypeAlias = NDArray[np.float64]

DTP, CUSUM = "dtp+corrected", "cusum+corrected"
RULES = (DTP, CUSUM)
METRICS = ("violation_rate", "cost")

#: The placements that binary reversion knows, and the one it lacks.
BINARY, HYBRID = ("LOC", "SO"), "HYB"

#: The paper's fault.
MEAN_MS, LOSS = 25.0, 0.02
#: Its standard deviation over its mean.
SPREAD = 0.2

#: Where faults are: directed links by name.
PLACES: Mapping[str, tuple[str, ...]] = {
    "both links": ("R1->E", "E->R1", "E->R2", "R2->E"),
    "link R1-E": ("R1->E", "E->R1"),
    "link E-R2": ("E->R2", "R2->E"),
    "R1 to E": ("R1->E",),
    "E to R1": ("E->R1",),
    "E to R2": ("E->R2",),
    "R2 to E": ("R2->E",),
    "link R1-R2": ("R1->R2", "R2->R1"),
}
PAPERS, NONE = "both links", "no fault"
#: A link without delay or loss that is slow: a trajectory takes 16 ms there, poses take 4.
SLOW, SLOW_LINK, SLOW_MBPS = "E to R2 slow", "E->R2", 2.0
#: Faults that are also met with nodes stressed, and those nodes with their threads a core.
JOINED = (NONE, PAPERS, "R1 to E", "E to R2", "link R1-R2", SLOW)
CONDITIONS: Mapping[str, Mapping[str, float]] = {
    "R1 stressed": {"R1": 1.0},
    "R1 and E stressed": {"R1": 1.0, "E": 1.5},
}
#: Mean time that a fault is off, and on.
OFF_S = ON_S = 40.0

#: Means of the delay in the sweep, milliseconds, and probabilities of loss.
MEANS_MS = (0.0, 2.0, 5.0, 10.0, 15.0, 25.0, 40.0)
LOSSES = (0.0, 0.02)
#: Places of the sweep: alone, and where R1 is no refuge; the other direction is the same to all.
SWEPT = (PAPERS, f"{PAPERS} + R1 stressed", "E to R2 + R1 stressed")
STEADY = "fault"
PARAMETERS = ("fault.place", "fault.mean_ms", "fault.loss")

MAIN: Mapping[str, Unit] = {
    "scenario": "text",
    "policy": "text",
    "violation_rate": "percent",
    "l95_ms": "ms",
    "cost": "cost",
    "migrations": "number",
}
HEADINGS = {"violation_rate": "V_D", "l95_ms": "L95 (ms)", "cost": "J"}


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Answer RQ2."""
    faulty = with_scenarios(problem, fault_scenarios(problem))
    whole = runner.run(faults_study(faulty, scale))
    binary = runner.run(binary_study(with_candidates(faulty, BINARY), scale))
    points_ = sweep_points(problem, scale)
    swept = runner.run(sweep_study(points_, scale))
    return written(whole, named_binary(whole, binary), swept)


# ----------------------------------------------------------------------- scenarios, studies


def fault(
    links: Sequence[str], *, mean_ms: float = MEAN_MS, loss: float = LOSS
) -> tuple[LinkDisturbance, ...]:
    """Return a Gaussian delay and a loss on links, all the time; nothing where both are 0."""
    if mean_ms == 0 and loss == 0:
        return ()
    delay = Normal(mean_ms, SPREAD * mean_ms) if mean_ms > 0 else None
    return tuple(
        LinkDisturbance(source, target, add_delay_ms=delay, loss=loss)
        for source, target in map(_ends, links)
    )


def _ends(link: str) -> tuple[str, str]:
    source, _, target = link.partition("->")
    return source, target


def fault_scenarios(problem: Problem) -> dict[str, Scenario]:
    """Return the paper's fault in every place, coming and going, alone and with nodes stressed.

    Also no fault at all, alone and with the same nodes stressed.
    """
    steady: dict[str, Scenario] = {NONE: ()}
    steady |= {place: fault(links) for place, links in PLACES.items()}
    steady[SLOW] = (LinkDisturbance(*_ends(SLOW_LINK), rate_mbps=SLOW_MBPS),)
    found = {
        place: on_and_off(items, off_s=OFF_S, on_s=ON_S, name="fault")
        for place, items in steady.items()
    }
    for condition in CONDITIONS:
        for place in JOINED:
            found[f"{place} + {condition}"] = (*found[place], *stress(problem, condition))
    return found


def stress(problem: Problem, condition: str) -> Scenario:
    """Return the stress of a condition, all the time; none where it is empty."""
    return tuple(
        NodeDisturbance(node, stress_threads=round(each * problem.fabric.nodes[node].cores))
        for node, each in CONDITIONS.get(condition, {}).items()
    )


def control(scenario: str) -> str:
    """Return the scenario with the same stress and no fault."""
    _, plus, condition = scenario.partition(" + ")
    return f"{NONE}{plus}{condition}"


def faults_in(scenarios: Sequence[str]) -> tuple[str, ...]:
    """Return the scenarios that have a fault."""
    return tuple(name for name in scenarios if control(name) != name)


def crossed(problem: Problem, placement: Placement) -> tuple[str, ...]:
    """Return the links that messages cross under a placement, in the order of the flows."""
    pairs = ((placement[flow.source], placement[flow.target]) for flow in problem.pipeline.flows)
    return tuple(
        dict.fromkeys(f"{source}->{target}" for source, target in pairs if source != target)
    )


def faults_study(problem: Problem, scale: Scale) -> Study:
    """Return everybody on all candidates."""
    return Study(
        name="reversion",
        points=(Point({}, problem),),
        scenarios=tuple(name for name in problem.scenarios if name != "baseline"),
        contenders=(*statics(problem), Contender("atp", "atp"), *_rules()),
        seeds=scale.all_seeds,
        windows=scale.windows,
    )


def binary_study(problem: Problem, scale: Scale) -> Study:
    """Return the rules on the two candidates of binary reversion."""
    return Study(
        name="reversion-binary",
        points=(Point({}, problem),),
        scenarios=tuple(name for name in problem.scenarios if name != "baseline"),
        contenders=_rules(),
        seeds=scale.all_seeds,
        windows=scale.windows,
    )


def _rules() -> tuple[Contender, ...]:
    return tuple(believing(name.partition("+")[0], "corrected", name=name) for name in RULES)


def named_binary(whole: StudyResult, binary: StudyResult) -> pl.DataFrame:
    """Put all runs into one frame, those of binary reversion under names of their own."""
    import polars as pl

    renamed = binary.runs.with_columns(
        policy=pl.col("policy").replace_strict({rule: reverting(rule) for rule in RULES})
    )
    return pl.concat([whole.runs, renamed], how="diagonal")


def reverting(rule: str) -> str:
    """Name of a rule on the candidates of binary reversion."""
    return f"{rule} {' or '.join(BINARY)}"


def sweep_points(problem: Problem, scale: Scale) -> tuple[Point, ...]:
    """Return steady faults of every size in some of the places."""
    found = []
    for where in SWEPT:
        place, _, condition = where.partition(" + ")
        for mean_ms in thinned(MEANS_MS, max(2, scale.grid)):
            for loss in LOSSES:
                items = fault(PLACES[place], mean_ms=mean_ms, loss=loss)
                scenarios = {STEADY: (*items, *stress(problem, condition))}
                found.append(
                    Point(
                        dict(zip(PARAMETERS, (where, mean_ms, loss), strict=True)),
                        with_scenarios(problem, scenarios),
                    )
                )
    return tuple(found)


def sweep_study(swept: tuple[Point, ...], scale: Scale) -> Study:
    """Return the static placements under every point of the sweep, in runs of half the length."""
    problem = swept[0].problem
    return Study(
        name="reversion-sweep",
        points=swept,
        scenarios=(STEADY,),
        contenders=(*statics(problem), *_rules()[:1]),
        seeds=scale.all_seeds,
        windows=max(scale.windows // 2, problem.warmup_windows + 2),
    )


# ------------------------------------------------------------------------------- verdict


def against_binary(runs: pl.DataFrame, scenarios: Sequence[str]) -> dict[str, Family]:
    """Compare each rule with HYB to itself without, and to ATP."""
    pairs: dict[str, Contrast] = {
        f"{scenario}: {rule}, {other}": (
            {"scenario": scenario, "policy": rule},
            {"scenario": scenario, "policy": other},
        )
        for scenario in scenarios
        for rule in RULES
        for other in (reverting(rule), "atp")
    }
    return families(runs, "does having HYB help during network faults?", METRICS, pairs)


def hybrid_alone(runs: pl.DataFrame, scenarios: Sequence[str]) -> dict[str, Family]:
    """Compare HYB that never moves to each placement of binary reversion."""
    pairs: dict[str, Contrast] = {
        f"{scenario}: {HYBRID}, {other}": (
            {"scenario": scenario, "policy": HYBRID},
            {"scenario": scenario, "policy": other},
        )
        for scenario in scenarios
        for other in BINARY
    }
    return families(runs, "is HYB the best placement?", METRICS, pairs)


def beyond_control(runs: pl.DataFrame, scenarios: Sequence[str]) -> dict[str, Family]:
    """Compare what having HYB changes with a fault to what it changes without one.

    Parameters
    ----------
    runs : DataFrame
    scenarios : sequence of str
        With a fault.
    """

    def change(metric: str, scenario: str, rule: str) -> Floats:
        having, lacking = (
            values(runs, metric, {"scenario": scenario, "policy": name})
            for name in (rule, reverting(rule))
        )
        changed: Floats = having - lacking
        return changed

    return {
        metric: Family(
            "does HYB help more with the fault than without?",
            metric,
            {
                f"{scenario}: {rule}": paired_difference(
                    change(metric, scenario, rule), change(metric, control(scenario), rule)
                )
                for scenario in scenarios
                for rule in RULES
            },
        )
        for metric in METRICS
    }


def verdict(family: Family, beyond: Family, *, papers: str = PAPERS) -> Outcome:
    """Say where DTP misses less because it has HYB, and whether that is because of the fault.

    Parameters
    ----------
    family, beyond : Family
        Of V_D (see `against_binary` and `beyond_control`).
    papers : str
        The scenario with the paper's fault.
    """
    pair = f"{DTP}, {reverting(DTP)}"
    said = {name: one for name, one in _said(family, pair).items() if control(name) != name}
    more = _said(beyond, DTP)
    lower = [name for name, one in said.items() if one == "lower"]
    higher = [name for name, one in said.items() if one == "higher"]
    owed = [name for name in lower if more[name] == "lower"]
    answer: Answer
    if len(owed) == len(said):
        answer = "yes"
    elif owed:
        answer = "in part"
    elif lower or higher or all(_tight(family, f"{name}: {pair}") for name in said):
        answer = "no"
    else:
        answer = "not shown"
    item = family.comparisons[f"{papers}: {pair}"]
    size = points(centre(family, f"{papers}: {pair}"), interval=(item.low, item.high))
    word = {"lower": "lowers V_D", "higher": "raises V_D"}.get(
        said[papers], "is not shown to change V_D"
    )
    text = (
        f"With the paper's fault on both links of the edge, having {HYBRID} beside "
        f"{listed(BINARY)} {word} under {DTP}. Of {len(said)} faults it lowers V_D in "
        f"{len(lower)}, by more than under the same stress without the fault in {len(owed)}, and "
        f"raises it in {len(higher)}."
    )
    evidence = [f"With the paper's fault on both links: V_D {size}."]
    evidence += [f"Lower: {_sizes(family, pair, lower)}."] if lower else []
    evidence += [f"Higher: {_sizes(family, pair, higher)}."] if higher else []
    evidence += [f"Lower by more than without the fault: {listed(owed)}."] if owed else []
    return Outcome(answer, text, tuple(evidence))


#: A difference in V_D that would be of no use.
USELESS = 0.01


def _tight(family: Family, name: str) -> bool:
    """Whether a gain worth having is ruled out."""
    return family.comparisons[name].low > -USELESS


def _said(family: Family, pair: str) -> dict[str, str]:
    return {
        name.removesuffix(f": {pair}"): said
        for name, said in family.verdicts.items()
        if name.endswith(f": {pair}")
    }


def _sizes(family: Family, pair: str, scenarios: Sequence[str]) -> str:
    return ", ".join(f"{name} {points(centre(family, f'{name}: {pair}'))}" for name in scenarios)


# ------------------------------------------------------------------------------- chapter


def written(whole: StudyResult, runs: pl.DataFrame, swept: StudyResult) -> Chapter:
    """Write the chapter of finished runs."""
    study = whole.study
    problem = study.points[0].problem
    compared = against_binary(runs, study.scenarios)
    alone = hybrid_alone(runs, study.scenarios)
    beyond = beyond_control(runs, faults_in(study.scenarios))
    outcome = verdict(compared["violation_rate"], beyond["violation_rate"])
    main = main_table(runs, study.scenarios)
    sweep = sweep_table(swept)
    return Chapter(
        slug="reversion",
        title=(
            "RQ2: Does routing T3 to R2 during network faults outperform binary R1/E reversion?"
        ),
        design=design(whole, swept),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(
            links_finding(problem),
            *alone_findings(alone, study.scenarios),
            *rule_findings(compared, study.scenarios),
            *beyond_findings(beyond),
            *sweep_findings(swept),
        ),
        tables=(
            main,
            difference_table(
                compared, slug="reversion-binary", title="With HYB, and without", where="fault"
            ),
            difference_table(
                beyond,
                slug="reversion-beyond",
                title="What HYB changes with a fault, less what it changes without one",
                note="A difference here is one of two differences, both paired by seed.",
                where="fault",
            ),
            difference_table(
                alone,
                slug="reversion-alone",
                title="HYB against the placements of binary reversion, none of them moving",
                where="fault",
            ),
            links_table(problem),
            sweep,
        ),
        figures=(
            rates_figure(main, "Missed deadlines with network faults that come and go"),
            *sweep_figures(sweep),
        ),
    )


def design(whole: StudyResult, swept: StudyResult) -> str:
    """Say what was compared."""
    study, sweep = whole.study, swept.study
    return (
        f"The paper's fault (Gaussian delay of {MEAN_MS:g} ms, σ = {SPREAD * MEAN_MS:g} ms, loss "
        f"{100 * LOSS:g} %) on both links of the edge, on one link, on one direction, and on the "
        f"link between the robots; beside it a link E to R2 of {SLOW_MBPS:g} Mbit/s without delay "
        f"or loss. Faults come and go (off {OFF_S:g} s, on {ON_S:g} s in the mean, exponential), "
        "alone or with R1 stressed by one thread a core, and E by 1.5, all the time. "
        "The same stress without any fault is the control. "
        f"{len(study.scenarios)} scenarios, {len(study.seeds)} seeds of {study.windows} windows. "
        f"Binary reversion is the same rule with the same estimator on {listed(BINARY)} alone; "
        f"ATP (our reconstruction, default thresholds) toggles between LOC and {HYBRID}. The sweep "
        f"holds faults of {listed(f'{one:g}' for one in _means(swept))} ms with and without loss, "
        f"all the time, σ a fifth of the mean, in {len(SWEPT)} cases: {len(sweep.points)} points, "
        f"{len(sweep.seeds)} seeds of {sweep.windows} windows. V_D and J are compared, each a "
        "family: sign-flip tests paired by seed, Holm over all comparisons of a question and "
        "metric; intervals are 95 % over seeds."
    )


def _means(swept: StudyResult) -> list[float]:
    return list(dict.fromkeys(float(point.values[PARAMETERS[1]]) for point in swept.study.points))


# ------------------------------------------------------------------------------ findings


def links_finding(problem: Problem) -> str:
    """Say which links each placement crosses, and who shares all of them."""
    found = {name: crossed(problem, place) for name, place in problem.candidates.items()}
    each = "; ".join(f"{name}: {listed(links)}" for name, links in found.items())
    alike = [
        name
        for name in BINARY
        if HYBRID in found and name in found and set(found[name]) == set(found[HYBRID])
    ]
    text = f"Links crossed: {each}."
    if alike:
        text += (
            f" {HYBRID} and {listed(alike)} cross the same ones: what slows those alike cannot "
            "make the one better than the other."
        )
    return text


def alone_findings(alone: Mapping[str, Family], scenarios: Sequence[str]) -> tuple[str, ...]:
    """Say where HYB that never moves beats both placements of binary reversion."""
    found = []
    for metric, family in alone.items():
        verdicts = family.verdicts
        wins = [
            name
            for name in scenarios
            if all(verdicts[f"{name}: {HYBRID}, {other}"] == "lower" for other in BINARY)
        ]
        counts = {
            other: sum(verdicts[f"{name}: {HYBRID}, {other}"] == "lower" for name in scenarios)
            for other in BINARY
        }
        each = [f"{other} in {count}" for other, count in counts.items()]
        where = "; ".join(wins) or "none"
        found.append(
            f"{HYBRID} that never moves has a lower {shown_as(metric)} than both {listed(BINARY)} "
            f"in {counted(len(wins), len(scenarios), 'scenarios')} ({where}); than "
            f"{listed(each)}."
        )
    return tuple(found)


def rule_findings(compared: Mapping[str, Family], scenarios: Sequence[str]) -> tuple[str, ...]:
    """Say what having HYB is worth to each rule in every metric, and how both stand to ATP."""
    found = []
    for rule in RULES:
        for other, words in ((reverting(rule), "the same without HYB"), ("atp", "ATP")):
            pair = f"{rule}, {other}"
            said = []
            for metric, family in compared.items():
                verdicts = _said(family, pair)
                lower = [name for name, one in verdicts.items() if one == "lower"]
                higher = [name for name, one in verdicts.items() if one == "higher"]
                text = f"{shown_as(metric)} lower in {len(lower)}"
                text += f" ({listed(lower)})" if 0 < len(lower) <= 4 else ""
                said.append(f"{text}, higher in {len(higher)}")
            found.append(
                f"{rule} against {words}, of {len(scenarios)} scenarios: {'; '.join(said)}."
            )
    return tuple(found)


def beyond_findings(beyond: Mapping[str, Family]) -> tuple[str, ...]:
    """Say in which faults each rule gains more by HYB than without the fault."""
    found = []
    for rule in RULES:
        said = []
        for metric, family in beyond.items():
            lower = [name for name, one in _said(family, rule).items() if one == "lower"]
            higher = [name for name, one in _said(family, rule).items() if one == "higher"]
            said.append(
                f"{shown_as(metric)} in {len(lower)} ({listed(lower)}), less in {len(higher)}"
            )
        found.append(
            f"{rule} gains more by {HYBRID} with the fault than without: {'; '.join(said)}."
        )
    return tuple(found)


def sweep_findings(swept: StudyResult) -> tuple[str, ...]:
    """Say at which sizes of a steady fault which placement misses least."""
    import polars as pl

    columns = swept.parameters
    candidates = tuple(swept.study.points[0].problem.candidates)
    means = (
        swept.runs.filter(pl.col("policy").is_in(candidates))
        .group_by(*columns, "policy", maintain_order=True)
        .agg(pl.col("violation_rate").mean())
    )
    found = []
    for place in SWEPT:
        said = []
        for loss in LOSSES:
            least = {}
            for mean_ms in _means(swept):
                here = means.filter(
                    (pl.col(columns[0]) == place)
                    & (pl.col(columns[1]) == mean_ms)
                    & (pl.col(columns[2]) == loss)
                )
                rates = dict(here.select("policy", "violation_rate").rows())
                least[mean_ms] = min(candidates, key=rates.__getitem__)
            said.append(f"with {100 * loss:g} % loss {_stretches(least)}")
        found.append(f"Steady fault, {place}: least mean V_D {'; '.join(said)}.")
    return tuple(found)


def _stretches(least: Mapping[float, str]) -> str:
    """``HYB at 0 and 2 ms, LOC at 5, 10 and 15 ms``."""
    by_name: dict[str, list[str]] = {}
    for mean_ms, name in least.items():
        by_name.setdefault(name, []).append(f"{mean_ms:g}")
    return ", ".join(f"{name} at {listed(sizes)} ms" for name, sizes in by_name.items())


# ------------------------------------------------------------------------ tables, figures


def main_table(runs: pl.DataFrame, scenarios: Sequence[str]) -> Table:
    """One row a fault and policy."""
    import polars as pl

    ordered = runs.with_columns(
        at=pl.col("scenario").replace_strict(list(scenarios), list(range(len(scenarios))))
    ).sort("at", maintain_order=True)
    columns = [name for name, unit in MAIN.items() if unit != "text"]
    return Table(
        slug="reversion",
        title="Every policy under every fault",
        frame=over_seeds(ordered, ("scenario", "policy"), columns),
        units=MAIN,
        headings={**HEADINGS, "scenario": "fault"},
        note="Means over seeds with 95 % intervals.",
    )


def links_table(problem: Problem) -> Table:
    """One row a placement: the links that its messages cross, and their bytes."""
    import polars as pl

    rows = []
    for name, placement in problem.candidates.items():
        for flow in problem.pipeline.flows:
            source, target = placement[flow.source], placement[flow.target]
            if source != target:
                rows.append((name, f"{source}->{target}", flow.source, flow.payload_bytes))
    columns = ["placement", "link", "after", "bytes"]
    return Table(
        slug="reversion-links",
        title="What crosses which link",
        frame=pl.DataFrame(rows, schema=columns, orient="row"),
        units={"placement": "text", "link": "text", "after": "text", "bytes": "count"},
        headings={"after": "output of"},
    )


def sweep_table(swept: StudyResult) -> Table:
    """One row a point of the sweep and policy."""
    columns = swept.parameters
    frame = over_seeds(swept.runs, (*columns, "policy"), ["violation_rate", "cost"])
    names = dict(zip(columns, ("place", "mean_ms", "loss"), strict=True))
    return Table(
        slug="reversion-sweep",
        title="Steady faults of every size",
        frame=frame.rename(names),
        units={
            "place": "text",
            "mean_ms": "number",
            "loss": "percent",
            "policy": "text",
            "violation_rate": "percent",
            "cost": "cost",
        },
        headings={
            "place": "fault on",
            "mean_ms": "mean delay (ms)",
            "violation_rate": HEADINGS["violation_rate"],
            "cost": HEADINGS["cost"],
        },
        note=(f"{len(swept.study.seeds)} seeds of {swept.study.windows} windows; 95 % intervals."),
    )


def sweep_figures(sweep: Table) -> tuple[Figure, ...]:
    """V_D and J over the mean delay of a steady fault, with loss, by its place."""
    import polars as pl

    lossy = sweep.frame.filter(pl.col("loss") == max(LOSSES))
    shared = {
        "kind": "lines",
        "x": "mean_ms",
        "y": "y",
        "series": "policy",
        "facet": "place",
        "x_label": f"mean delay added (ms), loss {100 * max(LOSSES):g} %",
    }
    wanted: tuple[tuple[str, str, Unit], ...] = (
        ("violation_rate", "V_D", "percent"),
        ("cost", "J", "cost"),
    )
    return tuple(
        Figure(
            slug=f"reversion-sweep-{called.lower().replace('_', '')}",
            title=f"{called} over the size of a steady fault",
            frame=lossy.select(
                "place",
                "mean_ms",
                "policy",
                *(pl.col(f"{column}{end}").alias(f"y{end}") for end in ("", "_low", "_high")),
            ),
            y_label=called,
            y_unit=unit,
            line_at=AIM if column == "violation_rate" else None,
            line_label="5 %" if column == "violation_rate" else "",
            log_y=column == "cost",
            note=sweep.note,
            **shared,  # type: ignore[arg-type]
        )
        for column, called, unit in wanted
    )
