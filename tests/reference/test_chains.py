"""Data ages of chains in windows, against ages worked out from the reference's record."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from random import Random

import pytest

import dwell
from dwell.model import Chain, Problem
from dwell.model.chain import behind
from tests.reference.chains import actuations, bound_ns
from tests.reference.simulator import Result
from tests.reference.test_against import Case, make_case, play, reference, window_differences

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
        known = {
            one.cycle: one.age_ns
            for one in actuations(case.problem, result, release_ns, chain.source, chain.target)
        }
        for row in windows.iter_rows(named=True):  # type: ignore[attr-defined]
            cycles = range(row["first_cycle"], row["first_cycle"] + width)
            ages = sorted(known[k] for k in cycles if k in known)
            l95 = ages[math.ceil(0.95 * len(ages)) - 1] / 1e6 if ages else math.inf
            over = sum(age > bound_ns(chain) for age in ages)
            missed = over / len(ages) if ages else 1.0
            found = row[f"age_l95_{name}"], row[f"age_missed_{name}"]
            if found != (l95, missed):
                yield f"window {row['window']}, {name}: {found}, expected {(l95, missed)}"


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
