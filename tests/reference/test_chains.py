"""Ages of chains and of cycles in windows, against ages worked out from the reference's record."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from random import Random

import pytest

import dwell
from dwell.model import Chain, Problem, Targets, Weights
from dwell.model.chain import behind
from tests.reference.chains import (
    actuations,
    age_l95_ms,
    bound_ns,
    completions,
    mean_age_ms,
    reaction_l95_ms,
)
from tests.reference.rates import Rates
from tests.reference.simulator import Result
from tests.reference.test_against import (
    Case,
    Played,
    make_case,
    play,
    reference,
    window_differences,
)

CASES = 12


def with_chains(problem: Problem, rng: Random) -> Problem:
    """Give a cell up to three chains between connected tasks, some with a bound."""
    pipeline = problem.pipeline
    pairs = [(name, other) for name in pipeline.tasks for other in behind(name, pipeline.flows)]
    picked = rng.sample(sorted(pairs), min(3, len(pairs)))
    chains = {
        f"{source}-{target}": Chain(
            source, target, rng.choice([math.inf, rng.uniform(0.5, 5) * pipeline.period_ms])
        )
        for source, target in picked
    }
    return replace(problem, pipeline=replace(pipeline, chains=chains))


def differences(case: Case, windows: object, result: Result) -> Iterator[str]:
    width, release_ns = case.problem.window_cycles, case.real.release_ns.tolist()
    for name, chain in case.problem.pipeline.chains.items():
        acted = actuations(case.problem, result, release_ns, chain.source, chain.target)
        every = Rates(case.problem.pipeline).of[chain.source]
        known = {one.cycle: one.age_ns for one in acted}
        for row in windows.iter_rows(named=True):  # type: ignore[attr-defined]
            cycles = range(row["first_cycle"], row["first_cycle"] + width)
            ages = sorted(known[k] for k in cycles if k in known)
            l95 = ages[math.ceil(0.95 * len(ages)) - 1] / 1e6 if ages else math.inf
            over = sum(age > bound_ns(chain) for age in ages)
            missed = over / len(ages) if ages else 1.0
            expected = l95, missed, reaction_l95_ms(acted, release_ns, every, cycles)
            found = tuple(row[f"{of}_{name}"] for of in ("age_l95", "age_missed", "reaction_l95"))
            if found != expected:
                yield f"window {row['window']}, {name}: {found}, expected {expected}"


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
def test_ages_of_random_chains_equal_to_the_nanosecond(whole_ms: bool) -> None:
    chains = 0
    for seed in range(CASES):
        case = make_case(seed, ("fifo", "priority"), orders=True, whole_ms=whole_ms, rates=True)
        case = replace(case, problem=with_chains(case.problem, Random(seed)))
        chains += len(case.problem.pipeline.chains)
        found, result = play(case), reference(case)
        assert not list(differences(case, found.windows, result)), f"seed {seed}"
        # V_D, too: cycles miss by the ages of their actuations.
        assert not list(window_differences(case, found.windows, result, 0)), f"seed {seed}"
    assert chains > CASES


def test_ages_do_not_change_what_is_played() -> None:
    problem = dwell.load("examples/canonical.yaml")
    chain = {"see": Chain("sensing", "control", 150)}
    other = replace(problem, pipeline=replace(problem.pipeline, chains=chain))
    runs = [dwell.simulate(one, seed=1, windows=10, policy="dtp") for one in (problem, other)]
    assert runs[0].cycles.equals(runs[1].cycles)
    windows = runs[1].windows
    # One rate and no sampled flow: the age at an actuation is the latency of its cycle.
    assert windows["age_l95_see"].to_list() == windows["l95_ms"].to_list()


def with_ages(problem: Problem, rng: Random) -> Problem:
    """Give a cell chains, and an objective with ages: of a chain if one is frequent enough."""
    problem = with_chains(problem, rng)
    rates = problem.pipeline.rates
    frequent = [
        name
        for name, chain in problem.pipeline.chains.items()
        if rates[chain.target] <= problem.decide_cycles
    ]
    objective = replace(
        problem.objective,
        weights=Weights(age=rng.uniform(0.1, 2)),
        targets=Targets(latency_ms=problem.pipeline.deadline_ms, age_ms=rng.uniform(5, 50)),
        latency=rng.choice([None, *frequent]),
    )
    return replace(problem, objective=objective)


def seen_differences(case: Case, run: Played, result: Result) -> Iterator[str]:
    """Yield the windows and decisions whose L95 or mean age differ from the reference's."""
    problem, release_ns = case.problem, case.real.release_ns.tolist()
    chain = problem.latency_chain
    known = completions(result, release_ns)
    if chain is not None:
        known = actuations(problem, result, release_ns, chain.source, chain.target)

    most_ms = round(problem.censor_ms * 1e6) / 1e6

    def seen(first: int, count: int, close_ns: int) -> tuple[float, float]:
        age_ms = mean_age_ms(known, release_ns[first], close_ns, release_ns[0], most_ms)
        return min(age_l95_ms(known, first, count, close_ns), most_ms), age_ms

    assert run.decisions is not None
    looked = [(look.first, look.last - look.first + 1, look.close_ns) for look in result.looks]
    closed = [(one.first_cycle, problem.window_cycles, one.close_ns) for one in result.windows]
    by_end = {first + count - 1: (first, count, at_ns) for first, count, at_ns in looked or closed}
    rows = [(row, closed[row["window"]]) for row in run.windows.iter_rows(named=True)]
    if "seen_l95_ms" in run.decisions.columns:
        decided = run.decisions.filter(run.decisions["cycles"] > 0).iter_rows(named=True)
        rows += [(row, by_end[row["last_cycle"]]) for row in decided]
    for row, cycles in rows:
        l95_ms, age_ms = seen(*cycles)
        if row["seen_age_ms"] is None:
            continue
        found = row["seen_l95_ms"] if chain is not None else l95_ms, row["seen_age_ms"]
        if found != (l95_ms, pytest.approx(age_ms, rel=1e-9, abs=1e-9)):
            yield f"{cycles}: {found}, expected {(l95_ms, age_ms)}"


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
def test_ages_as_a_controller_sees_them_equal_to_the_nanosecond(whole_ms: bool) -> None:
    chained = 0
    for seed in range(CASES // 2):
        case = make_case(
            seed, ("fifo", "priority"), orders=True, whole_ms=whole_ms, rates=seed % 2 == 0
        )
        case = replace(case, problem=with_ages(case.problem, Random(seed)))
        chained += case.problem.objective.latency is not None
        found, result = play(case), reference(case)
        assert not list(seen_differences(case, found, result)), f"seed {seed}"
    assert 0 < chained < CASES // 2
