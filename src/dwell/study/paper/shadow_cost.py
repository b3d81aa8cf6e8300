"""What shadow jobs cost: load on the nodes, bytes on the links, and deadlines missed.

Every static placement is run with shadow jobs and without, on the same realisations: what differs
is theirs. What they put on links follows from which cycles are sent through which alternative.
"""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model import Problem
from dwell.study.chapter import Table, Unit
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.intervals import mean_interval
from dwell.study.paper.contrasts import Contrast, family_of, values
from dwell.study.paper.running import Scale
from dwell.study.paper.sentences import counted, number, percent, points
from dwell.study.study import Contender, Point, Study

__all__ = [
    "FRACTIONS",
    "shadow_bytes_per_s",
    "shadow_finding",
    "shadow_study",
    "shadow_table",
]

#: Shares of the cycles that are sent through each alternative as well.
FRACTIONS = (0.01, 0.02, 0.05, 0.1)

# Undisturbed, and with the node under stress that shadows of LOC are a load on, or LOC itself is.
SCENARIOS = ("baseline", "edge-cpu-stress", "robot-cpu-stress")


def _named(candidate: str, fraction: float) -> str:
    return f"{candidate} shadows {fraction:g}"


def shadow_study(problem: Problem, scale: Scale) -> Study:
    """Return every candidate alone, with shadow jobs and without."""
    alone = [Contender(name, name) for name in problem.candidates]
    shadowed = [
        Contender(_named(name, fraction), name, "shadow", {"controller.shadow_fraction": fraction})
        for name in problem.candidates
        for fraction in FRACTIONS
    ]
    return Study(
        name="dynamic-shadows",
        points=(Point({}, problem),),
        scenarios=tuple(name for name in SCENARIOS if name in problem.scenarios),
        contenders=(*alone, *shadowed),
        seeds=scale.some_seeds,
        windows=scale.windows,
    )


def shadow_bytes_per_s(problem: Problem, active: str, fraction: float) -> dict[str, float]:
    """Bytes a second that the shadows of a placement put on each link, if nothing is lost.

    Parameters
    ----------
    problem : Problem
    active : str
        Candidate that the cycles run under.
    fraction : float
        Of the cycles, for each alternative.

    Returns
    -------
    dict of str to float
        By the link's name; every link of the fabric.
    """
    pipeline, here = problem.pipeline, problem.candidates[active]
    total = dict.fromkeys(problem.fabric.links, 0.0)
    for name, other in problem.candidates.items():
        apart = pipeline.diverging(here, other) if name != active else frozenset()
        for flow in pipeline.flows:
            source, target = other[flow.source], other[flow.target]
            if flow.target in apart and source != target:
                total[f"{source}->{target}"] += flow.payload_bytes
    return {link: payload * fraction * 1e3 / pipeline.period_ms for link, payload in total.items()}


def shadow_family(result: StudyResult) -> Family:
    """Compare V_D with shadow jobs to V_D without, of every placement in every scenario."""
    study = result.study
    pairs: dict[str, Contrast] = {
        f"{scenario}: {_named(name, fraction)}": (
            {"scenario": scenario, "policy": _named(name, fraction)},
            {"scenario": scenario, "policy": name},
        )
        for scenario in study.scenarios
        for name in study.points[0].problem.candidates
        for fraction in FRACTIONS
    }
    return family_of(result.runs, "do shadow jobs miss deadlines?", "violation_rate", pairs)


def shadow_table(result: StudyResult) -> Table:
    """One row a scenario, placement and fraction: what shadow jobs add."""
    import polars as pl

    study = result.study
    problem = study.points[0].problem
    family = shadow_family(result)
    adjusted, verdicts = family.adjusted, family.verdicts
    used = [link for link, sent in _most_bytes(problem).items() if sent > 0]
    rows = []
    for scenario in study.scenarios:
        for name in problem.candidates:
            for fraction in FRACTIONS:
                key = f"{scenario}: {_named(name, fraction)}"
                found = family.comparisons[key]
                rates = shadow_bytes_per_s(problem, name, fraction)
                row: dict[str, object] = {
                    "scenario": scenario,
                    "placement": name,
                    "fraction": fraction,
                    "violation_rate": getattr(found, "mean", float("nan")),
                    "violation_rate_low": found.low,
                    "violation_rate_high": found.high,
                    "p_holm": adjusted[key],
                    "verdict": verdicts[key],
                }
                for node in problem.fabric.nodes:
                    row |= _more(result, scenario, name, fraction, f"node_{node}")
                rows.append(row | {f"bytes {link}": rates[link] / 1e3 for link in used})
    nodes: dict[str, Unit] = {f"node_{node}": "change" for node in problem.fabric.nodes}
    links: dict[str, Unit] = {f"bytes {link}": "number" for link in used}
    return Table(
        slug="dynamic-shadows",
        title="What shadow jobs cost a placement that never moves",
        frame=pl.DataFrame(rows, infer_schema_length=None).fill_nan(None),
        units={
            "scenario": "text",
            "placement": "text",
            "fraction": "percent",
            "violation_rate": "change",
            "p_holm": "p",
            "verdict": "text",
            **nodes,
            **links,
        },
        headings={
            "fraction": "of the cycles, each alternative",
            "violation_rate": "V_D",
            "p_holm": "p (Holm)",
            "verdict": "V_D is",
            **{f"node_{node}": f"utilisation of {node}" for node in problem.fabric.nodes},
            **{f"bytes {link}": f"{link} (kB/s)" for link in used},
        },
        note=(
            f"V_D and utilisation with shadow jobs less without, {len(study.seeds)} seeds of "
            f"{study.windows} windows, paired; Holm over these {len(rows)} comparisons of V_D. "
            "Bytes follow from the flows and the plan of shadows, with nothing lost."
        ),
    )


def _most_bytes(problem: Problem) -> Mapping[str, float]:
    """Bytes a second on each link under whichever placement shadows put most there."""
    rates = [shadow_bytes_per_s(problem, name, 1.0) for name in problem.candidates]
    return {link: max(one[link] for one in rates) for link in problem.fabric.links}


def _more(
    result: StudyResult, scenario: str, name: str, fraction: float, column: str
) -> dict[str, float]:
    """How much more of a column there is with shadow jobs, with its interval."""
    with_them, without = (
        values(result.runs, column, {"scenario": scenario, "policy": policy})
        for policy in (_named(name, fraction), name)
    )
    known = mean_interval(with_them - without)
    return dict(zip((column, f"{column}_low", f"{column}_high"), known, strict=True))


def shadow_finding(result: StudyResult) -> tuple[str, ...]:
    """Say what the cell's usual fraction costs at most, and where deadlines are missed for it."""
    family = shadow_family(result)
    verdicts = family.verdicts
    higher = [name for name, said in verdicts.items() if said == "higher"]
    usual = result.study.points[0].problem.controller.shadow_fraction
    named = f"shadows {usual:g}"
    means = {
        name: float(getattr(one, "mean", float("nan")))
        for name, one in family.comparisons.items()
        if name.endswith(named)
    }
    problem = result.study.points[0].problem
    sent = {
        f"{name}, {link}": rate / 1e3
        for name in problem.candidates
        for link, rate in shadow_bytes_per_s(problem, name, usual).items()
    }
    heaviest = max(sent, key=sent.__getitem__, default="")
    text = f"Shadow jobs are shown to raise V_D in {counted(len(higher), len(verdicts), 'cases')}"
    text += f" ({'; '.join(higher)})." if higher else "."
    if means:
        worst = max(means, key=means.__getitem__)
        text += (
            f" At {percent(usual, 0)} of the cycles for each alternative they add at most "
            f"{points(means[worst], 2)} ({worst.removesuffix(' ' + named)})"
        )
        text += (
            f", and at most {number(sent[heaviest])} kB/s on a link ({heaviest})." if sent else "."
        )
    return (text,)
