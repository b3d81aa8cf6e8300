"""RQ2: T3 to R2 during network faults, against going back and forth between R1 and E.

A map of fault × load × nodes: a rule reverts only where a node of LOC is loaded, so that it is on E
when the fault begins. What HYB is worth under the same load without a fault is its control: see
README.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import polars as pl

from dwell.model import LinkDisturbance, NodeDisturbance, Normal, Problem, Scenario
from dwell.study import Contender, Point, Study
from reproduction.cell import (
    RULES,
    of_cell,
    on_and_off,
    rules,
    statics,
    with_candidates,
    with_scenarios,
)
from reproduction.maps import map_of
from reproduction.questions import Run
from reproduction.scale import Scale, thinned
from reproduction.verdicts import Answer, by_policy, claims

TITLE = "RQ2: Does routing T3 to R2 during network faults outperform binary R1/E reversion?"

METRICS = ("violation_rate", "cost")
#: Differences of V_D that are taken for none, written down before any fresh seed was played.
MARGIN = 0.005
#: What having HYB changes about them, seed by seed.
CHANGES = ("change_of_violation_rate", "change_of_cost")
#: The placements that binary reversion knows, and the one it lacks.
BINARY, HYBRID = ("LOC", "SO"), "HYB"

#: The paper's fault, with the share that its standard deviation is of its mean.
MEAN_MS, SPREAD, LOSS = 25.0, 0.2, 0.02
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
NONE = "no fault"
#: A link without delay or loss that is slow: a trajectory takes 16 ms there, poses take 4.
SLOW, SLOW_MBPS = "E to R2 slow", 2.0
#: Faults that are also met with nodes stressed, and those nodes with their threads a core.
JOINED = (NONE, "both links", "R1 to E", "E to R2", "link R1-R2", SLOW)
CONDITIONS: Mapping[str, Mapping[str, float]] = {
    "": {},
    "R1 stressed": {"R1": 1.0},
    "R1 stressed twice": {"R1": 2.0},
    "R1 and E stressed": {"R1": 1.0, "E": 1.5},
    "R1 and E stressed twice": {"R1": 2.0, "E": 3.0},
    "R2 stressed": {"R2": 1.0},
}
#: How a map names them: nodes with their threads a core.
LOADS = ("none", "R1 1", "R1 2", "R1 1, E 1.5", "R1 2, E 3", "R2 1")
#: Mean time that a fault is off, and on.
OFF_S = ON_S = 40.0

#: Means of the delay in the sweep, milliseconds, and probabilities of loss.
MEANS_MS, LOSSES = (0.0, 2.0, 5.0, 10.0, 15.0, 25.0, 40.0), (0.0, LOSS)
#: Places of the sweep: alone, and where R1 is no refuge; the other direction is the same to all.
SWEPT = (("both links", ""), ("both links", "R1 stressed"), ("E to R2", "R1 stressed"))
STEADY, PARAMETERS = "fault", ("fault.place", "fault.mean_ms", "fault.loss")


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Compare the rules with HYB to the same without, and that to the same without a fault."""
    faulty = with_scenarios(cell, fault_scenarios(cell))
    scenarios = tuple(name for name in faulty.scenarios if name != "baseline")
    long, who = (scale.fresh_seeds, scale.windows), (*statics(cell), Contender("atp", "atp"))
    whole = of_cell("reversion", faulty, scenarios, (*who, *rules()), *long)
    two = with_candidates(faulty, BINARY)
    binary = of_cell("reversion-binary", two, scenarios, rules(), *long)
    without = {rule: f"{rule} {' or '.join(BINARY)}" for rule in RULES}
    having, lacking = run(whole).runs, run(binary).runs
    reverting = lacking.with_columns(pl.col("policy").replace_strict(without))
    runs = pl.concat([having, reverting], how="diagonal")
    sweep = run(sweep_study(cell, scale))
    faults = [name for name in scenarios if control(name) != name]
    pairs = [(rule, other) for rule, less in without.items() for other in (less, "atp")]
    asked = {
        "Having HYB helps a rule during network faults": pairs,
        "HYB that never moves beats LOC and SO": [(HYBRID, other) for other in BINARY],
    }
    verdicts = claims(runs, METRICS, scenarios, asked, whole, margin=MARGIN)
    keys = ("scenario", "policy", "seed")
    # Where the latencies are those of the rule without HYB, nothing is changed.
    alike = pl.col("latencies") == pl.col("latencies_right")
    changes = having.join(lacking, on=keys).select(
        *keys,
        *(pl.col(name) - pl.col(f"{name}_right") for name in METRICS),
        latencies=pl.when(alike).then(pl.lit("alike")).otherwise(pl.format("{} {}", *keys[:2])),
    )
    changes = changes.rename(dict(zip(METRICS, CHANGES, strict=True)))
    calm = pl.concat(
        changes.filter(scenario=control(fault)).with_columns(
            scenario=pl.lit(fault), policy=pl.col("policy") + f", {NONE}"
        )
        for fault in faults
    )
    beyond = "Having HYB helps more with the fault than under the same stress without it"
    asked = {beyond: [(rule, f"{rule}, {NONE}") for rule in RULES]}
    both = pl.concat([changes, calm])
    verdicts += claims(both, CHANGES, faults, asked, whole, margin=MARGIN)
    columns = ("violation_rate", "l95_ms", "cost", "migrations")
    told = pl.concat(verdicts)
    rule, less = next(iter(without.items()))
    answering = pl.col("second").is_in([less, f"{rule}, {NONE}"]) & (pl.col("first") == rule)
    of_rates = pl.col("metric").is_in([METRICS[0], CHANGES[0]])
    return Answer(
        told,
        {
            "Every policy under every fault": by_policy(runs, columns),
            "Bytes that cross each link under each placement": crossed(cell),
            "Steady faults of every size": sweep.table(METRICS),
        },
        map_of(told.filter(answering & of_rates), _label, 100.0),
    )


def _label(row: dict[str, str]) -> tuple[str, str, str]:
    place, _, condition = row["scenario"].partition(" + ")
    load = LOADS[list(CONDITIONS).index(condition)]
    panel = "V_D with HYB less without, points; threads a core"
    if row["metric"] in CHANGES:
        panel = "The same, less its control without a fault"
    return panel, place, load


def fault(
    links: Sequence[str], *, mean_ms: float = MEAN_MS, loss: float = LOSS
) -> tuple[LinkDisturbance, ...]:
    """Return a Gaussian delay and a loss on links, all the time; nothing where both are 0."""
    if mean_ms == 0 and loss == 0:
        return ()
    delay = Normal(mean_ms, SPREAD * mean_ms) if mean_ms > 0 else None
    ends = (link.split("->") for link in links)
    return tuple(LinkDisturbance(a, b, add_delay_ms=delay, loss=loss) for a, b in ends)


def fault_scenarios(cell: Problem) -> dict[str, Scenario]:
    """Return no fault and every fault, coming and going, alone and with nodes stressed."""
    steady: dict[str, Scenario] = {NONE: ()}
    steady |= {place: fault(links) for place, links in PLACES.items()}
    steady[SLOW] = (LinkDisturbance("E", "R2", rate_mbps=SLOW_MBPS),)
    found = {
        place: on_and_off(items, off_s=OFF_S, on_s=ON_S, name="fault")
        for place, items in steady.items()
    }
    for condition, place in product(filter(None, CONDITIONS), JOINED):
        found[f"{place} + {condition}"] = (*found[place], *stress(cell, condition))
    return found


def stress(cell: Problem, condition: str) -> Scenario:
    """Return the stress of a condition, all the time."""
    return tuple(
        NodeDisturbance(node, stress_threads=round(each * cell.fabric.nodes[node].cores))
        for node, each in CONDITIONS[condition].items()
    )


def control(scenario: str) -> str:
    """Return the scenario with the same stress and no fault."""
    _, plus, condition = scenario.partition(" + ")
    return f"{NONE}{plus}{condition}"


def crossed(cell: Problem) -> pl.DataFrame:
    """Return the bytes that each flow puts on a link, under each placement."""
    rows = [
        (name, f"{at[flow.source]}->{at[flow.target]}", flow.source, flow.payload_bytes)
        for name, at in cell.candidates.items()
        for flow in cell.pipeline.flows
        if at[flow.source] != at[flow.target]
    ]
    return pl.DataFrame(rows, schema=["placement", "link", "after", "bytes"], orient="row")


def sweep_study(cell: Problem, scale: Scale) -> Study:
    """Return steady faults of every size in some of the places, in runs of half the length."""
    points = []
    means_ms = thinned(MEANS_MS, max(2, scale.grid))
    for (place, condition), mean_ms, loss in product(SWEPT, means_ms, LOSSES):
        where = " + ".join(filter(None, (place, condition)))
        items = fault(PLACES[place], mean_ms=mean_ms, loss=loss)
        swept = with_scenarios(cell, {STEADY: (*items, *stress(cell, condition))})
        points.append(Point(dict(zip(PARAMETERS, (where, mean_ms, loss), strict=True)), swept))
    who, windows = (*statics(cell), rules()[0]), max(scale.windows // 2, cell.warmup_windows + 2)
    return Study("reversion-sweep", tuple(points), (STEADY,), who, scale.all_seeds, windows)
