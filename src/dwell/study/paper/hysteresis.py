"""Dwell and threshold: what they buy in calm, and what they cost in reaction.

N_min windows without a decision after each move bound the migrations of K windows by
⌊K / (N_min + 1)⌋, whatever the metrics do: a property of the rule, and no finding. What it buys is
one: a policy that may not move cannot chatter, and cannot react either.

Two settings beside them are tried: ``escape`` (an incumbent over a cap may leave early) and cold
migrations (a moved task waits for its state and its start), which make every move dearer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from dwell.model import FrozenDict, Problem
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.engine import StudyResult
from dwell.study.family import Comparative, Family
from dwell.study.over_seeds import over_seeds
from dwell.study.paper.cell import by_length
from dwell.study.paper.contenders import PAPERS_DTP, believing
from dwell.study.paper.contrasts import Contrast, values
from dwell.study.paper.differences import difference_table, families
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, number, percent
from dwell.study.study import Contender, Point, Study

__all__ = ["chapter", "verdict"]

DWELLS = (0, 1, 3, 6, 12)
THRESHOLDS = (0.0, 0.05, 0.2, 0.8)
FEW_DWELLS, FEW_THRESHOLDS = (0, 3, 12), (0.0, 0.05, 0.8)
SCENARIOS = ("baseline", "flapping", "bursts", "mixture", "step")

#: What is compared to no hysteresis at all; the first is the cell's.
NONE = (0, 0.0)
SETTINGS = {
    (3, 0.05): "both, as in the cell",
    (3, 0.0): "dwell alone",
    (0, 0.05): "threshold alone",
    (12, 0.8): "both, strong",
}
CELLS = next(iter(SETTINGS))

ESCAPE_SCENARIOS = ("edge-cpu-stress", "network-impairment", "bursts", "mixture", "step")
COLD_SCENARIOS = ("flapping", "mixture", "step")
#: A process that loads a model, and what it hands over: 0.17 s on a gigabit link.
START_MS, STATE_BYTES = 500.0, 20_000_000
COLD_DWELLS = (0, 3, 12)

METRICS: Mapping[str, str] = {
    "migrations": "migrations",
    "cost": "J",
    "violation_rate": "V_D",
}
#: Of the figures.
SHOWN: Mapping[str, str] = {
    "migrations": "migrations",
    "regret": "regret against the reference in hindsight",
    "violation_rate": "share of missed cycles",
}
UNITS: Mapping[str, Unit] = {
    "migrations": "number",
    "returns": "number",
    "cost": "cost",
    "regret": "percent",
    "violation_rate": "percent",
    "l95_ms": "ms",
}
HEADINGS = FrozenDict(
    {
        "min_dwell": "N_min",
        "min_improvement": "Δ_min",
        "cost": "J",
        "violation_rate": "V_D",
        "l95_ms": "L95 (ms)",
    }
)


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Vary N_min and Δ_min; try escape and cold migrations."""
    dwells = FEW_DWELLS if scale.coarse else DWELLS
    thresholds = FEW_THRESHOLDS if scale.coarse else THRESHOLDS
    grid = [
        runner.run(study)
        for study in studies(
            "hysteresis", problem, scale, SCENARIOS, gridded(dwells, thresholds), scale.some_seeds
        )
    ]
    escape = [
        runner.run(study)
        for study in studies(
            "hysteresis-escape", problem, scale, ESCAPE_SCENARIOS, escaping(), scale.all_seeds
        )
    ]
    cold = [
        runner.run(study)
        for study in studies(
            "hysteresis-cold", heavy(problem), scale, COLD_SCENARIOS, moving(), scale.all_seeds
        )
    ]
    return written(grid, escape, cold)


def studies(
    name: str,
    problem: Problem,
    scale: Scale,
    scenarios: Sequence[str],
    contenders: Sequence[Contender],
    seeds: Sequence[int],
) -> list[Study]:
    """Return one study for each length that runs have."""
    return [
        Study(
            name=name + suffix,
            points=(Point({}, problem),),
            scenarios=mine,
            contenders=tuple(contenders),
            seeds=tuple(seeds),
            windows=windows,
            references=True,
        )
        for suffix, mine, windows in by_length(
            problem, scenarios, scale.windows, scale.dynamic_windows
        )
    ]


def gridded(
    dwells: Sequence[int] = DWELLS, thresholds: Sequence[float] = THRESHOLDS
) -> list[Contender]:
    """Return a DTP for every dwell and threshold."""
    return [
        believing(
            "dtp",
            "corrected",
            {"controller.min_dwell": dwell, "controller.min_improvement": threshold},
            name=grid_name(dwell, threshold),
        )
        for dwell, threshold in itertools.product(dwells, thresholds)
    ]


def settings_of(study: Study) -> list[tuple[int, float]]:
    """Return N_min and Δ_min of every contender of the grid."""
    return [
        (
            int(str(one.settings["controller.min_dwell"])),
            float(str(one.settings["controller.min_improvement"])),
        )
        for one in study.contenders
    ]


def grid_name(dwell: int, threshold: float) -> str:
    """Name of a contender of the grid."""
    return f"N_min = {dwell}, Δ_min = {threshold:g}"


def escaping() -> list[Contender]:
    """Return DTP with and without escape."""
    return [
        believing("dtp", estimator, {"controller.escape": on}, name=escape_name(estimator, on))
        for estimator in ("profile", "corrected")
        for on in (False, True)
    ]


def escape_name(estimator: str, on: bool) -> str:
    """Name of a contender with or without escape."""
    return f"dtp+{estimator}, escape {'on' if on else 'off'}"


#: Policies whose migrations are tried cold, and their settings.
MOVERS: Mapping[str, tuple[str, str, Mapping[str, object]]] = FrozenDict(
    {
        PAPERS_DTP: ("dtp", "profile", {}),
        "cusum+corrected": ("cusum", "corrected", {}),
        **{
            f"dtp+corrected, N_min = {dwell}": (
                "dtp",
                "corrected",
                {"controller.min_dwell": dwell},
            )
            for dwell in COLD_DWELLS
        },
    }
)


def moving() -> list[Contender]:
    """Return every mover with warm and with cold migrations."""
    return [
        believing(
            policy,
            estimator,
            {**settings, "controller.migration": migration},
            name=f"{name}, {migration}",
        )
        for name, (policy, estimator, settings) in MOVERS.items()
        for migration in ("warm", "cold")
    ]


def heavy(problem: Problem) -> Problem:
    """Return the problem with relocatable tasks that take time to start and have state to move."""
    tasks = {
        name: task if task.anchored else replace(task, start_ms=START_MS, state_bytes=STATE_BYTES)
        for name, task in problem.pipeline.tasks.items()
    }
    return replace(problem, pipeline=replace(problem.pipeline, tasks=FrozenDict(tasks)))


# ------------------------------------------------------------------------------- reading


def _compared(
    results: Sequence[StudyResult], question: str, pairs: Callable[[str], Mapping[str, Contrast]]
) -> dict[str, Family]:
    """Compare pairs in every scenario, by every metric."""
    import polars as pl

    named = {
        f"{scenario}: {name}": pair
        for result in results
        for scenario in result.study.scenarios
        for name, pair in pairs(scenario).items()
    }
    runs = pl.concat([result.runs for result in results])
    return families(runs, question, tuple(METRICS), named)


def _policies(scenario: str, first: str, second: str) -> Contrast:
    return ({"scenario": scenario, "policy": first}, {"scenario": scenario, "policy": second})


def against_none(results: Sequence[StudyResult]) -> dict[str, Family]:
    """Compare some settings to no hysteresis at all, in every scenario."""
    return _compared(
        results,
        "hysteresis against none (N_min = 0, Δ_min = 0)",
        lambda scenario: {
            words: _policies(scenario, grid_name(*setting), grid_name(*NONE))
            for setting, words in SETTINGS.items()
        },
    )


def of_escape(results: Sequence[StudyResult]) -> dict[str, Family]:
    """Compare DTP with escape to DTP without, in every scenario."""
    return _compared(
        results,
        "escape on against off",
        lambda scenario: {
            f"dtp+{estimator}": _policies(
                scenario, escape_name(estimator, True), escape_name(estimator, False)
            )
            for estimator in ("profile", "corrected")
        },
    )


def of_cold(results: Sequence[StudyResult]) -> dict[str, Family]:
    """Compare cold migrations to warm ones, in every scenario."""
    return _compared(
        results,
        "cold migrations against warm ones",
        lambda scenario: {
            name: _policies(scenario, f"{name}, cold", f"{name}, warm") for name in MOVERS
        },
    )


# ------------------------------------------------------------------------------- verdict


def verdict(shown: Mapping[str, Mapping[str, Comparative]]) -> Outcome:
    """Answer whether hysteresis calms DTP at no price.

    Parameters
    ----------
    shown : mapping of metric to mapping of scenario to verdict
        Of the cell's setting, against no hysteresis at all, for every one of `METRICS`.
    """
    calmer = [name for name, said in shown["migrations"].items() if said == "lower"]
    scenarios = len(shown["migrations"])
    worse = [
        name
        for metric in ("violation_rate", "cost")
        for name, said in shown[metric].items()
        if said == "higher"
    ]
    answer: Answer
    if len(calmer) == scenarios and not worse:
        answer = "yes"
    elif calmer:
        answer = "in part"
    else:
        answer = "no" if worse else "not shown"
    prices = [
        f"{METRICS[metric]} is higher in {_where(shown[metric], 'higher')} and lower in "
        f"{_where(shown[metric], 'lower')}"
        if {"lower", "higher"} & set(shown[metric].values())
        else f"no difference in {METRICS[metric]} is shown"
        for metric in ("violation_rate", "cost")
    ]
    sentence = (
        "Against no hysteresis at all, DTP as it is set in the cell is shown to migrate less in "
        f"{counted(len(calmer), scenarios, 'scenarios')}; "
        f"{', and '.join(prices)}."
    )
    return Outcome(answer, sentence)


def _where(shown: Mapping[str, Comparative], word: Comparative) -> str:
    """``2 (step and mixture)``."""
    names = [name for name, said in shown.items() if said == word]
    return f"{len(names)} ({listed(names)})" if names else "none"


# ------------------------------------------------------------------------------- chapter


def written(
    grid: Sequence[StudyResult], escape: Sequence[StudyResult], cold: Sequence[StudyResult]
) -> Chapter:
    """Write the chapter of finished runs."""
    calm = against_none(grid)
    words = SETTINGS[CELLS]
    of_cells = {
        metric: {
            name.removesuffix(f": {words}"): said
            for name, said in one.verdicts.items()
            if name.endswith(f": {words}")
        }
        for metric, one in calm.items()
    }
    outcome = verdict(of_cells)
    early, late = of_escape(escape), of_cold(cold)
    numbers = grid_table(grid)
    return Chapter(
        slug="hysteresis",
        title="Does hysteresis calm DTP without making it worse?",
        design=design(grid, escape, cold),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(
            *settings_found(calm),
            *best_found(numbers),
            *shown("Escape", early),
            *shown("A cold migration", late),
            *price_found(cold),
        ),
        tables=(
            numbers,
            difference_table(calm, slug="hysteresis-none", title="Hysteresis, less none at all"),
            difference_table(early, slug="hysteresis-escape", title="Escape on, less off"),
            difference_table(late, slug="hysteresis-cold", title="Cold migrations, less warm"),
        ),
        figures=(
            grid_figure(numbers, "migrations"),
            grid_figure(numbers, "regret"),
            grid_figure(numbers, "violation_rate"),
        ),
    )


def design(
    grid: Sequence[StudyResult], escape: Sequence[StudyResult], cold: Sequence[StudyResult]
) -> str:
    """Say what was varied."""

    def where(results: Sequence[StudyResult]) -> str:
        return listed(scenario for result in results for scenario in result.study.scenarios)

    settings = settings_of(grid[0].study)
    dwells = dict.fromkeys(dwell for dwell, _ in settings)
    thresholds = dict.fromkeys(threshold for _, threshold in settings)
    lengths = listed(
        f"{result.study.windows} windows ({', '.join(result.study.scenarios)})" for result in grid
    )
    return (
        f"DTP with the estimator corrected; N_min of {listed(str(one) for one in dwells)} times "
        f"Δ_min of {listed(f'{one:g}' for one in thresholds)}, {len(grid[0].study.seeds)} seeds of "
        f"{lengths}. Some settings are compared to none at all, paired by seed (sign-flip test, "
        "Holm over scenarios and settings of a metric). Regret is against the reference in "
        "hindsight. Beside that, "
        f"escape on and off ({where(escape)}; {len(escape[0].study.seeds)} seeds; DTP with profile "
        f"and with corrected), and cold migrations against warm ones ({where(cold)}; "
        f"{len(cold[0].study.seeds)} seeds; {listed(MOVERS)}): a moved task takes "
        f"{number(START_MS, 0)} ms to start and has {number(STATE_BYTES / 1e6, 0)} MB of state."
    )


def settings_found(calm: Mapping[str, Family]) -> tuple[str, ...]:
    """Say what each setting changes against none, over scenarios."""
    found = []
    for words in SETTINGS.values():
        parts = []
        for metric, one in calm.items():
            mine = [said for name, said in one.verdicts.items() if name.endswith(f": {words}")]
            lower, higher = mine.count("lower"), mine.count("higher")
            parts.append(f"{METRICS[metric]} lower in {lower} and higher in {higher}")
        found.append(
            f"{words.capitalize()}, against none: {'; '.join(parts)} of {len(mine)} scenarios."
        )
    return tuple(found)


def best_found(numbers: Table) -> tuple[str, ...]:
    """Say which setting had the least J in each scenario."""
    found = []
    for (scenario,), mine in numbers.frame.group_by(["scenario"], maintain_order=True):
        rows = mine.to_dicts()
        least = min(rows, key=lambda row: row["cost"])
        most = max(rows, key=lambda row: row["cost"])
        cells = next(row for row in rows if (row["min_dwell"], row["min_improvement"]) == CELLS)
        found.append(
            f"In {scenario} J is least with N_min = {least['min_dwell']}, Δ_min = "
            f"{least['min_improvement']:g} ({number(least['cost'], 2)}, regret "
            f"{percent(least['regret'], 0)}), {number(cells['cost'], 2)} in the cell, and at most "
            f"{number(most['cost'], 2)} (N_min = {most['min_dwell']}, Δ_min = "
            f"{most['min_improvement']:g}); chosen on the same seeds, so that the least is too low."
        )
    return tuple(found)


def shown(what: str, families: Mapping[str, Family]) -> tuple[str, ...]:
    """Say where a setting was shown to change a metric."""
    parts = []
    for metric, one in families.items():
        verdicts, counts = one.verdicts, []
        for word in ("lower", "higher"):
            named = [name for name, said in verdicts.items() if said == word]
            counts.append(f"{word} in {len(named)}" + f" ({'; '.join(named)})" * bool(named))
        parts.append(
            f"{what} is shown to make {METRICS[metric]} {' and '.join(counts)} of {len(verdicts)} "
            "comparisons."
        )
    return tuple(parts)


def price_found(cold: Sequence[StudyResult]) -> tuple[str, ...]:
    """Say how many misses a cold migration adds."""
    found = []
    for result in cold:
        for scenario in result.study.scenarios:
            added = moved = 0.0
            for name in MOVERS:
                labels = {"scenario": scenario, "policy": f"{name}, cold"}
                warm = {"scenario": scenario, "policy": f"{name}, warm"}
                rate = values(result.runs, "violation_rate", labels)
                before = values(result.runs, "violation_rate", warm)
                cycles = values(result.runs, "cycles", labels)
                added += float(((rate - before) * cycles).sum())
                moved += float(values(result.runs, "migrations", labels).sum())
            if moved:
                found.append(
                    f"In {scenario} {number(added / moved, 1)} more cycles a migration are missed "
                    f"with cold migrations than with warm ones (all policies, {number(moved, 0)} "
                    "migrations; what they decide otherwise included)."
                )
    return tuple(found)


def grid_table(results: Sequence[StudyResult]) -> Table:
    """One row a scenario, dwell and threshold."""
    import polars as pl

    names = pl.DataFrame(
        [
            {
                "policy": grid_name(dwell, threshold),
                "min_dwell": dwell,
                "min_improvement": threshold,
            }
            for dwell, threshold in settings_of(results[0].study)
        ]
    )
    runs = pl.concat([result.runs for result in results])
    # Without the references' own rows.
    frame = over_seeds(
        runs.filter(pl.col("policy").is_in(names["policy"].to_list())),
        ("scenario", "policy"),
        tuple(UNITS),
    )
    study = results[0].study
    return Table(
        slug="hysteresis",
        title="Dwell and threshold",
        frame=frame.join(names, on="policy", how="left", maintain_order="left"),
        units={"scenario": "text", "min_dwell": "count", "min_improvement": "number", **UNITS},
        headings=HEADINGS,
        note=f"Mean over {len(study.seeds)} seeds, with its 95 % interval.",
    )


def grid_figure(numbers: Table, metric: str) -> Figure:
    """Return a metric over N_min, one line a Δ_min."""
    import polars as pl

    frame = numbers.frame.select(
        "scenario",
        pl.format(
            "Δ_min = {}",
            pl.col("min_improvement").cast(pl.String).str.strip_suffix(".0"),
        ).alias("threshold"),
        pl.col("min_dwell").alias("x"),
        *(pl.col(f"{metric}{end}").alias(f"y{end}") for end in ("", "_low", "_high")),
    )
    return Figure(
        slug=f"hysteresis-{metric.replace('_', '-')}",
        title=f"{SHOWN[metric].capitalize()} over the dwell",
        kind="lines",
        frame=frame,
        x="x",
        y="y",
        series="threshold",
        facet="scenario",
        x_label="N_min (windows)",
        y_label=SHOWN[metric],
        y_unit=UNITS[metric],
        line_at=0.05 if metric == "violation_rate" else None,
        line_label="5 %" if metric == "violation_rate" else "",
        note=numbers.note,
    )
