"""Policies with `candidates: all`, against the same with the three best placements at baseline."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from benchmarks.figures import Figure, Goal, Section
from benchmarks.placements import Graph, autoware_graph, graph_cell
from dwell import search
from dwell.estimators import searched
from dwell.model import ControllerSettings, Problem
from dwell.model.every_placement import EveryPlacement
from dwell.study import compare, mean_interval
from tests.cells.dynamic import dynamic_scenarios

POLICIES = "dtp+corrected", "cusum+corrected", "work-function+corrected"
#: A run lasts 1000 s, as long as the scenarios.
SEEDS, WINDOWS = range(1, 4), 100
DEARER = Goal(high=0.5)

#: Inputs and mean execution time on R1, ms: ten stages in a row, from the camera to the arm.
STAGES = 6, 9, 14, 8, 12, 7, 5, 4, 3, 2
CHAIN = Graph(
    "chain",
    {
        name: ((before,), ms)
        for (before, name), ms in zip(
            pairwise(["camera", *(f"stage{k}" for k in range(1, 11))]), STAGES, strict=True
        )
    },
    {"camera": "R1"},
    ("stage10", "R2"),
    {"camera": 300_000, "stage1": 150_000, "stage2": 50_000},
)
#: Two cameras, detection and tracking of parts and people, a map, two planners: 13 tasks.
HALL = Graph(
    "hall",
    {
        "rectify": (("camera",), 6),
        "detect": (("rectify",), 15),
        "track": (("detect",), 5),
        "pose": (("rectify", "detect"), 9),
        "filter": (("lidar",), 8),
        "ground": (("filter",), 7),
        "people": (("ground", "detect"), 12),
        "predict": (("people", "track"), 6),
        "localize": (("filter",), 11),
        "map": (("localize", "ground"), 8),
        "route": (("map", "predict"), 9),
        "grasp": (("pose", "track"), 7),
        "motion": (("route", "grasp"), 6),
    },
    {"camera": "R1", "lidar": "R2"},
    ("motion", "R2"),
    {"camera": 300_000, "rectify": 200_000, "lidar": 200_000, "filter": 100_000},
)


def measure(quick: bool) -> Section:
    """Compare J, which contains moves, seed by seed."""
    seeds = list(SEEDS)[: 2 if quick else None]
    figures = []
    for problem in list(cells())[: 1 if quick else None]:
        many, few = costs(with_all(problem), seeds), costs(with_three(problem), seeds)
        for name in many:
            pairs = zip(many[name], few[name], strict=True)
            more = [100 * (one / other - 1) for one, other in pairs]
            interval = mean_interval(more)
            high = interval.high if interval is not None else max(more)
            figures.append(Figure(f"{problem.name}, {name}: J less J with three", more, "%"))
            figures.append(Figure(f"{problem.name}, {name}: upper end", [high], "%", DEARER))
    length = f"{WINDOWS} windows of 100 cycles, {len(seeds)} seeds"
    return Section(
        "Candidates from a search against the three best at baseline", figures, (length,)
    )


def cells() -> Iterator[Problem]:
    """Yield cells of 10, 13 and 16 movable tasks with the dynamic scenarios."""
    for problem in (graph_cell(CHAIN, 3), graph_cell(HALL, 3), autoware_graph(3)):
        controller = ControllerSettings(on="E")
        yield replace(problem, scenarios=dynamic_scenarios(), controller=controller)


def with_all(problem: Problem) -> Problem:
    """Return the problem with `candidates: all`."""
    return searched(replace(problem, candidates={}, every_placement=EveryPlacement()))


def with_three(problem: Problem) -> Problem:
    """Return the problem with the three best placements at baseline."""
    best = search(problem, top=3)
    return replace(problem, candidates={f"B{k}": one[0] for k, one in enumerate(best, 1)})


def costs(problem: Problem, seeds: Sequence[int]) -> Mapping[str, list[float]]:
    """Return the mean J of each seed, by scenario and policy."""
    scenarios = [name for name in problem.scenarios if name != "baseline"]
    result = compare(
        problem, scenarios=scenarios, policies=POLICIES, seeds=seeds, windows=WINDOWS, processes=1
    )
    return {
        f"{scenario}, {policy.partition('+')[0]}": list(result.values(scenario, policy, "cost"))
        for scenario in scenarios
        for policy in POLICIES
    }
