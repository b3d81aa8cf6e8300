"""Prices of transmitted bytes in windows, against the transmissions of the reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from random import Random

import pytest

from dwell.model import Problem, Targets, Weights
from tests.reference.simulator import Result
from tests.reference.test_against import Case, Played, make_case, play, reference

CASES = 5
HOUR_NS = 3.6e12


def with_prices(problem: Problem, rng: Random) -> Problem:
    """Let some links have a price, and J a term of it."""
    links = {
        name: replace(link, price_per_gb=rng.choice([0.0, rng.uniform(0.01, 100)]))
        for name, link in problem.fabric.links.items()
    }
    first = next(iter(links))
    links[first] = replace(links[first], price_per_gb=rng.uniform(0.01, 100))
    flows = tuple(
        replace(flow, payload_bytes=rng.randrange(100_000)) for flow in problem.pipeline.flows
    )
    objective = replace(
        problem.objective,
        weights=Weights(price=rng.uniform(0.1, 2)),
        targets=Targets(latency_ms=problem.pipeline.deadline_ms, price_per_hour=10.0),
    )
    return replace(
        problem,
        pipeline=replace(problem.pipeline, flows=flows),
        fabric=replace(problem.fabric, links=links),
        objective=objective,
    )


def differences(case: Case, run: Played, result: Result) -> Iterator[str]:
    """Yield the windows and decisions whose price differs from the reference's."""
    links, release_ns = case.problem.fabric.links, case.real.release_ns.tolist()
    paid = [
        (one.at_ns, links[one.link].price_per_gb * one.payload_bytes / 1e9)
        for one in result.transmitted
    ]

    def per_hour(begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the least and the largest price: events of one instant may be before or after."""
        within = [sum(price for at, price in paid if begin_ns < at < end_ns)]
        within.append(sum(price for at, price in paid if begin_ns <= at <= end_ns))
        least, most = (price * HOUR_NS / (end_ns - begin_ns) for price in within)
        return least, most

    assert run.decisions is not None
    closed = {one.first_cycle: (one.first_cycle, one.close_ns) for one in result.windows}
    rows = [(row, closed[row["first_cycle"]]) for row in run.windows.iter_rows(named=True)]
    looks = {look.last: (look.first, look.close_ns) for look in result.looks}
    if looks:
        decided = run.decisions.filter(run.decisions["cycles"] > 0).iter_rows(named=True)
        rows += [(row, looks[row["last_cycle"]]) for row in decided]
    for row, (first, close_ns) in rows:
        found = row["seen_price_per_hour"]
        if found is None:
            continue
        least, most = per_hour(release_ns[first], close_ns)
        if not least * (1 - 1e-9) - 1e-9 <= found <= most * (1 + 1e-9) + 1e-9:
            yield f"{first} to {close_ns} ns: {found}, expected {least} to {most}"


@pytest.mark.parametrize("feature", ["orders", "in_order", "rates", "replicas"])
def test_prices_of_windows_are_those_of_the_transmissions(feature: str) -> None:
    paid = 0.0
    for seed in range(CASES):
        case = make_case(seed, ("fifo", "priority"), **{"orders": True, feature: True})
        if not case.problem.fabric.links:
            continue
        case = replace(case, problem=with_prices(case.problem, Random(seed)))
        found, result = play(case), reference(case)
        assert not list(differences(case, found, result)), f"seed {seed}"
        paid += sum(found.windows["seen_price_per_hour"].drop_nulls().to_list())
    assert paid > 0
