"""RQ1: placing T2 and T3 together against moving one stage, under CPU stress of the robots.

Two comparisons, because the first mixes two things. Against ATP, whose thresholds are tuned on
seeds of their own, another rule with another estimator plays on more candidates. So the same rule
with the same estimator also plays on the candidates between which one stage alone moves: what then
differs is the other stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dwell.model import NodeDisturbance, Problem, Scenario
from dwell.policies import ATP
from dwell.policies.atp_thresholds import Pair, find_pairs
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.over_seeds import over_seeds
from dwell.study.paper.contenders import PAPERS_DTP, believing, statics
from dwell.study.paper.contrasts import Contrast
from dwell.study.paper.differences import centre, difference_table, families, shown_as
from dwell.study.paper.rates import rates_figure
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, percent, points
from dwell.study.paper.tuning import TUNING_SEEDS, best, scores, thinned
from dwell.study.paper.variants import on_and_off, with_candidates, with_scenarios
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

__all__ = ["HEADINGS", "MAIN", "Baselines", "chapter", "stress_scenarios", "verdict"]

DTP, CUSUM = "dtp+corrected", "cusum+corrected"
TUNED, BEST_HERE = "atp-tuned", "atp best here"
#: The rules whose candidates are varied.
RULES = (DTP, CUSUM)
METRICS = ("violation_rate", "u_robot", "cost")

#: Robots that are stressed, with how many threads a core.
STRESSED = {"R1": ("R1",), "R2": ("R2",), "R1+R2": ("R1", "R2")}
THREADS_A_CORE = (1, 2)
#: Mean time that stress which comes and goes is off, and on: about twelve windows.
OFF_S = ON_S = 40.0

#: Thresholds of ATP that are tried: L95 over the deadline, utilisation, N_min.
LATENCIES = (0.8, 1.0, 1.2)
ROBOTS = (0.7, 0.95, np.inf)
EDGES = (0.7, np.inf)
DWELLS = (0, 3)

MAIN: Mapping[str, Unit] = {
    "scenario": "text",
    "policy": "text",
    "violation_rate": "percent",
    "l95_ms": "ms",
    "u_robot": "percent",
    "u_edge": "percent",
    "cost": "cost",
    "migrations": "number",
}
HEADINGS = {
    "violation_rate": "V_D",
    "l95_ms": "L95 (ms)",
    "u_robot": "U_r",
    "u_edge": "U_e",
    "cost": "J",
}


class Baselines(NamedTuple):
    """ATP as it was tuned.

    Parameters
    ----------
    tuned : Contender
        With one setting for all scenarios, called `TUNED`.
    by_scenario : mapping of str to Contender
        With the setting that is best in each; several scenarios may share one.
    setting : str
        Of `tuned`, by its name in the grid.
    static : str
        The placement that never moves and misses least over all scenarios.
    """

    tuned: Contender
    by_scenario: Mapping[str, Contender]
    setting: str
    static: str

    @property
    def distinct(self) -> tuple[Contender, ...]:
        """Everybody who plays, each once."""
        return tuple({one.name: one for one in (self.tuned, *self.by_scenario.values())}.values())


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Answer RQ1."""
    stressed = with_scenarios(problem, stress_scenarios(problem))
    tuning = runner.run(tuning_study(stressed, scale))
    baselines = tuned(tuning)
    whole = runner.run(main_study(stressed, scale, baselines))
    apart = {
        label: runner.run(single_study(with_candidates(stressed, names), scale, label))
        for label, names in single_stages(problem).items()
    }
    runs = together(whole, apart)
    return written(whole, tuning, baselines, tuple(apart), runs)


# ----------------------------------------------------------------------- scenarios, studies


def stress_scenarios(problem: Problem) -> dict[str, Scenario]:
    """Return CPU stress on either robot and on both, weaker and stronger, steady and on and off.

    One thread a core is the paper's scenario (`stress-ng --cpu 0`); both robots at a time come and
    go together.
    """
    found: dict[str, Scenario] = {}
    for each in THREADS_A_CORE:
        for label, nodes in STRESSED.items():
            steady: Scenario = tuple(
                NodeDisturbance(node, stress_threads=each * problem.fabric.nodes[node].cores)
                for node in nodes
            )
            found[f"{label} {each} a core"] = steady
            found[f"{label} {each} a core on-off"] = on_and_off(
                steady, off_s=OFF_S, on_s=ON_S, name="stress"
            )
    return found


def single_stages(problem: Problem) -> dict[str, tuple[str, str]]:
    """Return the pairs of candidates between which one stage alone moves, by its name."""
    found: dict[str, tuple[str, str]] = {}
    for pair in find_pairs(problem.candidates, problem.objective.tiers):
        found.setdefault(stage_of(problem, pair), (pair.local, pair.offload))
    return found


def stage_of(problem: Problem, pair: Pair) -> str:
    """Name of the stage that moves, as the paper counts them: ``T2``."""
    return f"T{list(problem.pipeline.tasks).index(pair.task) + 1}"


def atp(problem: Problem, pair: Pair, thresholds: tuple[float, float, float, int]) -> ATP:
    """Return ATP on a pair of candidates, starting on the local one.

    Parameters
    ----------
    problem : Problem
    pair : Pair
    thresholds : (latency, robot, edge, min_dwell)
        The first as a share of the deadline.
    """
    latency, robot, edge, dwell = thresholds
    local = problem.initial if problem.initial in pair[:2] else pair.local
    return ATP(
        candidates=problem.candidates,
        initial=local,
        objective=problem.objective,
        local=pair.local,
        offload=pair.offload,
        latency_ms=latency * problem.pipeline.deadline_ms,
        robot=robot,
        edge=edge,
        min_dwell=dwell,
    )


def tuning_study(problem: Problem, scale: Scale) -> Study:
    """Return ATP's grid on held-out seeds: which stage it moves, its thresholds and its dwell.

    The static placements are there too: under stress of the robots alone, not to be on them may be
    all there is to know.
    """
    size = max(2, scale.grid // 3)
    grid = [
        Contender(
            f"{stage_of(problem, pair)} {latency:g} {robot:g} {edge:g} {dwell}",
            atp(problem, pair, (latency, robot, edge, dwell)),
        )
        for pair in find_pairs(problem.candidates, problem.objective.tiers)
        for latency in thinned(LATENCIES, size)
        for robot in thinned(ROBOTS, size)
        for edge in thinned(EDGES, size)
        for dwell in thinned(DWELLS, size)
    ]
    return Study(
        name="concurrent-tuning",
        points=(Point({}, problem),),
        scenarios=tuple(name for name in problem.scenarios if name != "baseline"),
        contenders=(*statics(problem), *grid),
        seeds=scale.held_out[:TUNING_SEEDS],
        windows=scale.windows,
    )


def tuned(tuning: StudyResult) -> Baselines:
    """Choose ATP's settings by V_D: one for all scenarios, and one for each."""
    import polars as pl

    names = tuning.study.points[0].problem.candidates
    everybody = tuning.study.contenders
    grid = [one for one in everybody if one.name not in names]
    score = scores(tuning.runs, "violation_rate")
    overall = best(grid, score)
    by_scenario = {
        scenario: best(
            grid, scores(tuning.runs.filter(pl.col("scenario") == scenario), "violation_rate")
        )
        for scenario in tuning.study.scenarios
    }
    return Baselines(
        Contender(TUNED, overall.policy),
        {
            scenario: Contender(f"atp {one.name}", one.policy)
            for scenario, one in by_scenario.items()
        },
        overall.name,
        best(everybody, score, lambda one: one.name in names).name,
    )


def main_study(problem: Problem, scale: Scale, baselines: Baselines) -> Study:
    """Return everybody on all candidates."""
    return Study(
        name="concurrent",
        points=(Point({}, problem),),
        scenarios=tuple(name for name in problem.scenarios if name != "baseline"),
        contenders=(
            *statics(problem),
            Contender("atp", "atp"),
            *baselines.distinct,
            believing("dtp", "profile", name=PAPERS_DTP),
            *_rules(),
        ),
        seeds=scale.all_seeds,
        windows=scale.windows,
    )


def single_study(problem: Problem, scale: Scale, stage: str) -> Study:
    """Return the rules on a pair of candidates between which one stage moves."""
    return Study(
        name=f"concurrent-{stage}",
        points=(Point({}, problem),),
        scenarios=tuple(name for name in problem.scenarios if name != "baseline"),
        contenders=_rules(),
        seeds=scale.all_seeds,
        windows=scale.windows,
    )


def _rules() -> tuple[Contender, ...]:
    return tuple(believing(name.partition("+")[0], "corrected", name=name) for name in RULES)


def only(rule: str, stage: str) -> str:
    """Name of a rule that moves one stage alone."""
    return f"{rule} {stage} only"


def together(whole: StudyResult, apart: Mapping[str, StudyResult]) -> pl.DataFrame:
    """Put all runs into one frame; those on a pair of candidates under names of their own."""
    import polars as pl

    frames = [whole.runs]
    frames += [
        result.runs.with_columns(
            policy=pl.col("policy").replace_strict({rule: only(rule, stage) for rule in RULES})
        )
        for stage, result in apart.items()
    ]
    return pl.concat(frames, how="diagonal")


# ------------------------------------------------------------------------------- verdict


def against_atp(runs: pl.DataFrame, baselines: Baselines) -> dict[str, Family]:
    """Compare the rules to ATP with one setting, with the best for each scenario, and to nobody.

    The last is the static placement that misses least: who beats ATP need not beat standing still.
    """
    pairs: dict[str, Contrast] = {}
    for scenario, favourite in baselines.by_scenario.items():
        for rule in RULES:
            static = baselines.static
            for name, other in (
                (TUNED, TUNED),
                (BEST_HERE, favourite.name),
                (static, static),
            ):
                pairs[f"{scenario}: {rule}, {name}"] = (
                    {"scenario": scenario, "policy": rule},
                    {"scenario": scenario, "policy": other},
                )
    return families(runs, "are T2 and T3 together better than ATP?", METRICS, pairs)


def against_single(
    runs: pl.DataFrame, scenarios: Sequence[str], stages: Sequence[str]
) -> dict[str, Family]:
    """Compare each rule on all candidates to itself where one stage alone moves."""
    pairs: dict[str, Contrast] = {
        f"{scenario}: {rule}, {only(rule, stage)}": (
            {"scenario": scenario, "policy": rule},
            {"scenario": scenario, "policy": only(rule, stage)},
        )
        for scenario in scenarios
        for rule in RULES
        for stage in stages
    }
    return families(runs, "is the second stage worth moving too?", METRICS, pairs)


def verdict(
    atp_family: Family, single_family: Family, stages: Sequence[str], static: str
) -> Outcome:
    """Say where DTP on all candidates misses less than ATP, and whether that needs both stages.

    Parameters
    ----------
    atp_family, single_family : Family
        Of V_D (see `against_atp` and `against_single`).
    stages : sequence of str
        Those that move alone in the comparisons of DTP with itself.
    static : str
        The placement that misses least if it never moves.
    """
    against = _said(atp_family, f"{DTP}, {TUNED}")
    lower, higher = _where(against, "lower"), _where(against, "higher")
    too = {stage: _said(single_family, f"{DTP}, {only(DTP, stage)}") for stage in stages}
    gained = [name for name in against if all(said[name] == "lower" for said in too.values())]
    lost = [name for name in against if any(said[name] == "higher" for said in too.values())]
    both = [name for name in lower if name in gained]
    answer: Answer
    if both and len(both) == len(against):
        answer = "yes"
    elif both:
        answer = "in part"
    elif lower or higher or lost:
        answer = "no"
    else:
        answer = "not shown"
    text = (
        f"Against ATP with tuned thresholds, {DTP} has a lower V_D in "
        f"{counted(len(lower), len(against), 'stress scenarios')} and a higher one in "
        f"{len(higher)}"
    )
    if lower:
        text += (
            "; having both stages to move is better than either alone in "
            f"{len(both)} of those {len(lower)}"
        )
    text += "."
    still = _said(atp_family, f"{DTP}, {static}")
    evidence = [
        f"V_D of {DTP} less that of {TUNED}: lower in {len(lower)}"
        f"{_sizes(atp_family, f'{DTP}, {TUNED}', lower)}, higher in {len(higher)}"
        f"{_sizes(atp_family, f'{DTP}, {TUNED}', higher)}."
    ]
    for stage, said in too.items():
        pair = f"{DTP}, {only(DTP, stage)}"
        less, more = _where(said, "lower"), _where(said, "higher")
        evidence.append(
            f"V_D of {DTP} less that of the same rule moving {stage} alone: lower in {len(less)}"
            f"{_sizes(single_family, pair, less)}, higher in {len(more)}"
            f"{_sizes(single_family, pair, more)}."
        )
    evidence.append(
        f"{static}, which never moves, misses less than {DTP} in {len(_where(still, 'higher'))}, "
        f"and more in {len(_where(still, 'lower'))}."
    )
    rest = [name for name in lower if name not in gained]
    if rest:
        evidence.append(
            f"Where it misses less than {TUNED} though not less than with either stage alone "
            f"({listed(rest)}), that is owed to the rule and its estimates."
        )
    return Outcome(answer, text, tuple(evidence))


def _said(family: Family, pair: str) -> dict[str, str]:
    """Verdicts on one pair, by scenario."""
    return {
        name.removesuffix(f": {pair}"): said
        for name, said in family.verdicts.items()
        if name.endswith(f": {pair}")
    }


def _where(said: Mapping[str, str], word: str) -> list[str]:
    return [name for name, one in said.items() if one == word]


def _sizes(family: Family, pair: str, scenarios: Sequence[str]) -> str:
    """`` (R1 −4.0 points, R2 −2.0 points)``; their range where they are many."""
    if not scenarios:
        return ""
    found = {name: centre(family, f"{name}: {pair}") for name in scenarios}
    if len(found) > 3:
        least, most = (pick(found, key=lambda name: abs(found[name])) for pick in (min, max))
        return f" (from {points(found[least])} in {least} to {points(found[most])} in {most})"
    return f" ({', '.join(f'{name} {points(value)}' for name, value in found.items())})"


# ------------------------------------------------------------------------------- chapter


def written(
    whole: StudyResult,
    tuning: StudyResult,
    baselines: Baselines,
    stages: Sequence[str],
    runs: pl.DataFrame,
) -> Chapter:
    """Write the chapter of finished runs."""
    scenarios = whole.study.scenarios
    atps = against_atp(runs, baselines)
    singles = against_single(runs, scenarios, stages)
    outcome = verdict(atps["violation_rate"], singles["violation_rate"], stages, baselines.static)
    main = main_table(runs, baselines, stages)
    return Chapter(
        slug="concurrent",
        title=(
            "RQ1: Does concurrent T2+T3 placement reduce V_D further than single-stage ATP under "
            "CPU stress?"
        ),
        design=design(whole, tuning, baselines, stages),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(
            *metric_findings(atps, scenarios, (TUNED, BEST_HERE, baselines.static)),
            *stage_findings(singles, scenarios, stages),
            tuning_finding(tuning, baselines),
        ),
        tables=(
            main,
            difference_table(
                atps,
                slug="concurrent-atp",
                title=f"Against tuned ATP, and against {baselines.static} that never moves",
            ),
            difference_table(
                singles,
                slug="concurrent-stages",
                title="The same rule with both stages to move, and with one",
                note=(
                    "On fewer candidates there are fewer shadow jobs as well: each alternative "
                    "gets its share of the cycles."
                ),
            ),
            tuning_table(tuning, baselines),
        ),
        figures=(
            rates_figure(main, "Missed deadlines under CPU stress"),
            stages_figure(singles["violation_rate"], stages),
        ),
    )


def design(
    whole: StudyResult, tuning: StudyResult, baselines: Baselines, stages: Sequence[str]
) -> str:
    """Say what was compared."""
    study, grid = whole.study, tuning.study
    problem = study.points[0].problem
    pairs, settings = single_stages(problem), len(grid.contenders) - len(problem.candidates)
    apart = "; ".join(f"{stage}: {' or '.join(pairs[stage])}" for stage in stages)
    return (
        f"CPU stress on R1, on R2 and on both, with {listed(map(str, THREADS_A_CORE))} threads a "
        f"core, all the time or coming and going (off {OFF_S:g} s, on {ON_S:g} s in the mean, "
        f"exponential): {len(study.scenarios)} scenarios, {len(study.seeds)} seeds of "
        f"{study.windows} windows. ATP is our reconstruction; the stage it moves, its thresholds "
        f"and its dwell are chosen by V_D among {settings} settings on "
        f"{len(grid.seeds)} other seeds. {TUNED} has the one with the least mean over all "
        "scenarios, as a controller that is deployed once has to; “atp, best here” has the best "
        "for each scenario, the most favourable that can be had. The rules are also held against "
        f"{baselines.static}, the placement that misses least over all scenarios if it never "
        "moves. The second comparison keeps the rule "
        f"and its estimator and takes away the candidates beyond one stage ({apart}; the "
        "other stage stays where both have it). V_D, U_r and J are compared, each a family: "
        "sign-flip tests paired by seed, Holm over all comparisons of a question and metric; "
        "intervals are 95 % over seeds."
    )


def metric_findings(
    compared: Mapping[str, Family], scenarios: Sequence[str], others: Sequence[str]
) -> tuple[str, ...]:
    """Say how both rules compare to both ATPs, and to standing still, in every metric."""
    found = []
    for rule in RULES:
        for name in others:
            said = []
            for metric, family in compared.items():
                verdicts = _said(family, f"{rule}, {name}")
                lower, higher = _where(verdicts, "lower"), _where(verdicts, "higher")
                said.append(f"{shown_as(metric)} lower in {len(lower)}, higher in {len(higher)}")
            found.append(
                f"{rule} against {name}, of {len(scenarios)} scenarios: {'; '.join(said)}."
            )
    return tuple(found)


def stage_findings(
    compared: Mapping[str, Family], scenarios: Sequence[str], stages: Sequence[str]
) -> tuple[str, ...]:
    """Say what each rule gains by moving the second stage too."""
    found = []
    for rule in RULES:
        for stage in stages:
            pair = f"{rule}, {only(rule, stage)}"
            said = []
            for metric, family in compared.items():
                verdicts = _said(family, pair)
                lower, higher = _where(verdicts, "lower"), _where(verdicts, "higher")
                text = f"{shown_as(metric)} lower in {len(lower)}, higher in {len(higher)}"
                if metric == "violation_rate":
                    text += f"{_sizes(family, pair, lower)}"
                said.append(text)
            found.append(
                f"{rule} on all candidates against {stage} alone, of {len(scenarios)} scenarios: "
                f"{'; '.join(said)}."
            )
    return tuple(found)


def tuning_finding(tuning: StudyResult, baselines: Baselines) -> str:
    """Say what was chosen for ATP."""
    score = scores(tuning.runs, "violation_rate")
    settings = dict.fromkeys(
        one.name.removeprefix("atp ") for one in baselines.by_scenario.values()
    )
    return (
        f"ATP's setting for all scenarios is “{baselines.setting}” (stage, L95 over D, U_r, U_e, "
        f"N_min; inf is none), with a mean V_D of {percent(score[baselines.setting])} on the "
        "held-out seeds; "
        f"{baselines.static}, which never moves, has {percent(score[baselines.static])} there. "
        f"Single scenarios would have {len(settings)} different settings."
    )


# ------------------------------------------------------------------------ tables, figures


def main_table(runs: pl.DataFrame, baselines: Baselines, stages: Sequence[str]) -> Table:
    """One row a scenario and policy; of the ATPs tuned for one scenario, that scenario's."""
    import polars as pl

    favourites = {one.name for one in baselines.by_scenario.values()}
    rows = runs.filter(~pl.col("policy").is_in(sorted(favourites)))
    own = [
        runs.filter((pl.col("scenario") == scenario) & (pl.col("policy") == one.name)).with_columns(
            policy=pl.lit(BEST_HERE)
        )
        for scenario, one in baselines.by_scenario.items()
    ]
    order = (
        *(name for name in dict.fromkeys(rows["policy"]) if name not in RULES and " " not in name),
        BEST_HERE,
        *(only(rule, stage) for rule in RULES for stage in stages),
        *RULES,
    )
    everybody = pl.concat([rows, *own]).with_columns(
        place=pl.col("policy").replace_strict(list(order), list(range(len(order))))
    )
    scenarios = list(baselines.by_scenario)
    everybody = everybody.with_columns(
        at=pl.col("scenario").replace_strict(scenarios, list(range(len(scenarios))))
    ).sort("at", "place", "seed")
    columns = [name for name, unit in MAIN.items() if unit != "text"]
    return Table(
        slug="concurrent",
        title="Every policy under every stress",
        frame=over_seeds(everybody, ("scenario", "policy"), columns),
        units=MAIN,
        headings=HEADINGS,
        note="Means over seeds with 95 % intervals.",
    )


def tuning_table(tuning: StudyResult, baselines: Baselines) -> Table:
    """One row a setting of ATP: mean V_D on the held-out seeds."""
    import polars as pl

    score = scores(tuning.runs, "violation_rate")
    chosen = {one.name.removeprefix("atp ") for one in baselines.by_scenario.values()}
    rows = [
        {
            "setting": name,
            "violation_rate": value,
            "chosen": "for all"
            if name == baselines.setting
            else "for a scenario"
            if name in chosen
            else "",
        }
        for name, value in sorted(score.items(), key=lambda item: item[1])
    ]
    return Table(
        slug="concurrent-tuning",
        title="ATP's settings on the held-out seeds, best first",
        frame=pl.DataFrame(rows),
        units={"setting": "text", "violation_rate": "percent", "chosen": "text"},
        headings={"setting": "stage, L95 over D, U_r, U_e, N_min", "violation_rate": "mean V_D"},
        note=f"{len(tuning.study.seeds)} seeds; mean over the scenarios. A threshold inf is none.",
    )


def stages_figure(family: Family, stages: Sequence[str]) -> Figure:
    """What the second stage changes about V_D, by scenario and rule."""
    import polars as pl

    rows = []
    for rule in RULES:
        for stage in stages:
            pair = f"{rule}, {only(rule, stage)}"
            for scenario in _said(family, pair):
                item = family.comparisons[f"{scenario}: {pair}"]
                value = centre(family, f"{scenario}: {pair}")
                rows.append((rule, f"against {stage} only", scenario, value, item.low, item.high))
    columns = ["policy", "against", "scenario", "y", "y_low", "y_high"]
    return Figure(
        slug="concurrent-stages",
        title="V_D with both stages to move, less with one",
        kind="intervals",
        frame=pl.DataFrame(rows, schema=columns, orient="row").fill_nan(None),
        x="scenario",
        y="y",
        series="against",
        facet="policy",
        y_label="difference in V_D",
        y_unit="change",
        line_at=0.0,
        note="Mean difference over seeds with its 95 % interval; below 0 both stages miss less.",
    )
