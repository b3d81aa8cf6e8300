"""RQ1: placing T2 and T3 together against moving one stage: a map of fault × load × robot.

Against ATP, whose stage, thresholds and dwell are tuned on seeds of their own, and against the same
rule on the candidates between which one stage alone moves: what then differs is the other stage.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import polars as pl

from dwell.model import NodeDisturbance, Problem, Scenario
from dwell.policies import ATP
from dwell.study import Contender, Point, Study
from reproduction.cell import (
    RULES,
    believing,
    best,
    of_cell,
    on_and_off,
    rules,
    scores,
    statics,
    with_candidates,
    with_scenarios,
)
from reproduction.maps import map_of
from reproduction.questions import Run
from reproduction.questions.reversion import PLACES, fault
from reproduction.scale import Scale, thinned
from reproduction.verdicts import Answer, by_policy, claims

TITLE = "RQ1: Does placing T2 and T3 together reduce V_D further than moving one stage (ATP)?"

TUNED, BEST_HERE = "atp-tuned", "atp best here"
#: Candidates between which one stage alone moves: on a robot in the first, on E in the second.
STAGES = {"T2": ("LOC", "HYB"), "T3": ("HYB", "SO")}
METRICS = ("violation_rate", "u_robot", "cost")
#: Differences of V_D that are taken for none, written down before any fresh seed was played.
MARGIN = 0.005

#: Robots that are stressed, with how many threads a core; one is the paper's `stress-ng --cpu 0`.
STRESSED = {"R1": ("R1",), "R2": ("R2",), "R1+R2": ("R1", "R2")}
THREADS_A_CORE = (1, 2)
#: Mean time that stress which comes and goes is off, and on: about twelve windows.
OFF_S = ON_S = 40.0
#: The paper's fault, which comes and goes as well.
FAULT = "both links"

#: ATP's settings that are tried: L95 over the deadline, U_r, U_e (infinite: none) and N_min.
GRID = ((0.8, 1.0, 1.2), (0.7, 0.95, np.inf), (0.7, np.inf), (0, 3))


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Compare the rules to tuned ATP, to themselves with one stage, and to standing still."""
    stressed = with_scenarios(cell, stress_scenarios(cell))
    tuning = run(tuning_study(stressed, scale))
    score = scores(tuning.runs, "violation_rate")
    placed = statics(cell)
    grid = tuning.study.contenders[len(placed) :]
    overall, static = best(grid, score), best(placed, score).name
    here = {
        scenario: best(grid, scores(tuning.runs.filter(scenario=scenario), "violation_rate"))
        for scenario in tuning.study.scenarios
    }
    favourites = {one.name: Contender(f"atp {one.name}", one.policy) for one in here.values()}
    main = replace(
        tuning.study,
        name="concurrent",
        contenders=(
            *placed,
            Contender("atp", "atp"),
            Contender(TUNED, overall.policy),
            *favourites.values(),
            believing("dtp", "profile"),
            *rules(),
        ),
        seeds=scale.fresh_seeds,
    )
    runs = [run(main).runs]
    for stage, names in STAGES.items():
        point = Point({}, with_candidates(stressed, names))
        one = replace(main, name=f"concurrent-{stage}", points=(point,), contenders=rules())
        alone = {rule: f"{rule} {stage} only" for rule in RULES}
        runs.append(run(one).runs.with_columns(pl.col("policy").replace_strict(alone)))
    own = [
        runs[0]
        .filter(scenario=scenario, policy=f"atp {one.name}")
        .with_columns(policy=pl.lit(BEST_HERE))
        for scenario, one in here.items()
    ]
    everybody = pl.concat([*runs, *own], how="diagonal").filter(
        ~pl.col("policy").is_in([one.name for one in favourites.values()])
    )
    against = [(rule, other) for rule in RULES for other in (TUNED, BEST_HERE, static)]
    single = [(rule, f"{rule} {stage} only") for rule in RULES for stage in STAGES]
    asked = {
        "T2 and T3 together beat tuned ATP": against,
        "Both stages beat either alone, under the same rule": single,
    }
    tried = sorted(score.items(), key=lambda item: item[1])
    settings = pl.DataFrame(tried, schema=["setting", "violation_rate"], orient="row")
    columns = ("violation_rate", "l95_ms", "u_robot", "u_edge", "cost", "migrations")
    every = by_policy(everybody, columns)
    verdicts = pl.concat(claims(everybody, METRICS, main.scenarios, asked, main, margin=MARGIN))
    answering = {"first": "dtp+corrected", "second": TUNED, "metric": "violation_rate"}
    return Answer(
        verdicts,
        {
            "Every policy under every stress": every,
            "ATP's settings on the held-out seeds: stage, L95 over D, U_r, U_e, N_min": settings,
        },
        map_of(verdicts.filter(**answering), _label, 100.0),
    )


def _label(row: dict[str, str]) -> tuple[str, str, str]:
    stress, _, place = row["scenario"].partition(" + ")
    robot, _, load = stress.partition(" ")
    return f"V_D, points: {robot} stressed, threads", load, place or "no fault"


def stress_scenarios(cell: Problem) -> dict[str, Scenario]:
    """Return CPU stress on either robot and on both, weaker and stronger, steady and on and off.

    Each alone, and with the paper's fault.
    """
    found: dict[str, Scenario] = {}
    for each, (label, nodes) in product(THREADS_A_CORE, STRESSED.items()):
        steady: Scenario = tuple(
            NodeDisturbance(node, stress_threads=each * cell.fabric.nodes[node].cores)
            for node in nodes
        )
        found[f"{label} {each} a core"] = steady
        found[f"{label} {each} a core on-off"] = on_and_off(
            steady, off_s=OFF_S, on_s=ON_S, name="stress"
        )
    faulty = on_and_off(fault(PLACES[FAULT]), off_s=OFF_S, on_s=ON_S, name="fault")
    joined = {f"{name} + {FAULT}": (*items, *faulty) for name, items in found.items()}
    return {**found, **joined}


def tuning_study(cell: Problem, scale: Scale) -> Study:
    """Return ATP's grid on held-out seeds, and the static placements."""
    grids = [thinned(one, max(2, scale.grid // 3)) for one in GRID]
    grid = [
        Contender(f"{stage} {latency:g} {robot:g} {edge:g} {dwell:g}", atp(cell, names, setting))
        for stage, names in STAGES.items()
        for setting in product(*grids)
        for latency, robot, edge, dwell in (setting,)
    ]
    scenarios = [name for name in cell.scenarios if name != "baseline"]
    who = (*statics(cell), *grid)
    return of_cell("concurrent-tuning", cell, scenarios, who, scale.held_out, scale.windows)


def atp(cell: Problem, names: tuple[str, str], setting: tuple[float, ...]) -> ATP:
    """Return ATP on a pair of candidates, starting on the local one where it has to."""
    local, offload = names
    latency, robot, edge, dwell = setting
    return ATP(
        candidates=cell.candidates,
        initial=cell.initial if cell.initial in names else local,
        objective=cell.objective,
        local=local,
        offload=offload,
        latency_ms=latency * cell.pipeline.deadline_ms,
        robot=robot,
        edge=edge,
        min_dwell=int(dwell),
    )
