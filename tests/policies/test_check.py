"""check_policy: silent about sound policies, and one sentence for each way to be broken."""

from __future__ import annotations

import random
import signal
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from dwell.model import Decision, Placement, Problem, QoS, evolve
from dwell.policies import DTP, MinimalPolicy, Policy, by_name, check, check_policy
from dwell.policies.registry import REGISTRY
from tests.cells.paper import CANDIDATES, OBJECTIVE, place, problem

Estimates = Mapping[str, QoS]


class Sound:
    """Holds; what the broken ones below are made from."""

    def __init__(self) -> None:
        self.now = "LOC"

    def start(self, problem: Problem) -> None:
        self.now = problem.initial

    def decide(self, *, observed: QoS, estimates: Estimates) -> Decision:
        self.now = self.choose(observed, estimates)
        return Decision(CANDIDATES[self.now], self.now, False, "hold")

    def choose(self, observed: QoS, estimates: Estimates) -> str:
        return self.now


class Fastest:
    """The thirty lines of a user: no start, and a name for an answer."""

    def decide(self, *, observed: QoS, estimates: Estimates) -> str:
        return min(estimates, key=lambda name: estimates[name].l95_ms)


def only(faults: tuple[str, ...]) -> str:
    assert len(faults) == 1, faults
    return faults[0]


# --------------------------------------------------------------------------------------- sound


@pytest.mark.parametrize("name", [*REGISTRY, *CANDIDATES])
def test_the_own_policies_are_sound(name: str) -> None:
    assert check_policy(by_name(name, problem()), problem()) == ()


@pytest.mark.parametrize("name", REGISTRY)
def test_the_own_policies_are_sound_with_ages_prices_and_capped_misses(name: str) -> None:
    weighing = evolve(
        problem(),
        {
            "links[0].price_per_gb": 0.1,
            "objective.weights": {"age": 1, "price": 1},
            "objective.targets": {"age_ms": 50, "price_per_hour": 1},
            "objective.caps": {"latency_ms": 60, "misses": {"m": 1, "k": 20}},
        },
    )
    assert check_policy(by_name(name, weighing), weighing) == ()


def test_minimal_policies_are_sound() -> None:
    assert check_policy(Sound(), problem()) == ()
    assert check_policy(Fastest(), problem()) == ()
    assert isinstance(Fastest(), MinimalPolicy)
    assert not isinstance(Fastest(), Policy)


def test_degenerate_cells() -> None:
    alone = problem({"LOC": place("R1", "R2")})
    for name in ("dtp", "latency-first", "work-function", "LOC"):
        assert check_policy(by_name(name, alone), alone) == ()


def test_a_policy_that_has_run_is_left_as_it_is() -> None:
    policy = DTP(candidates=CANDIDATES, initial="LOC", objective=OBJECTIVE, min_dwell=0)
    good, bad = (QoS(ms, 0.0, dict.fromkeys(OBJECTIVE.tiers, 0.1)) for ms in (10.0, 90.0))
    policy.decide(observed=bad, estimates={"LOC": bad, "SO": good, "HYB": bad})
    assert policy.incumbent == "SO"
    assert check_policy(policy, problem()) == ()
    assert policy.incumbent == "SO"


def test_the_timer_is_given_back() -> None:
    def handler(number: int, frame: object) -> None:
        return None

    before = signal.signal(signal.SIGVTALRM, handler)
    try:
        assert check_policy(Sound(), problem()) == ()
        assert signal.getsignal(signal.SIGVTALRM) is handler
        assert signal.getitimer(signal.ITIMER_VIRTUAL)[0] == 0
    finally:
        signal.signal(signal.SIGVTALRM, before)


def test_a_policy_is_checked_in_another_thread_too() -> None:
    with ThreadPoolExecutor(1) as thread:
        faults = thread.submit(broken, lambda decision: replace(decision, dwell=-1)).result()
    assert "with dwell -1" in only(faults)


# -------------------------------------------------------------------------------------- broken


def test_no_decide() -> None:
    assert "no method decide" in only(check_policy(object(), problem()))  # type: ignore[arg-type]


def test_not_copyable() -> None:
    policy = Sound()
    policy.__dict__["lock"] = threading.Lock()
    assert "cannot be copied" in only(check_policy(policy, problem()))


def test_a_wrong_signature() -> None:
    class Positional:
        def decide(self, observed: QoS) -> str:
            return "LOC"

    fault = only(check_policy(Positional(), problem()))  # type: ignore[arg-type]
    assert "decide() raised TypeError" in fault


def test_it_raises_when_all_is_zero() -> None:
    class Divides(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            return self.now if 1 / observed.l95_ms else ""

    fault = only(check_policy(Divides(), problem()))
    assert "decide() raised ZeroDivisionError" in fault
    assert "window 0 of 'all metrics zero'" in fault


def test_it_raises_when_none_is_eligible() -> None:
    class Strict(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            next(name for name in estimates if estimates[name].l95_ms <= 120)
            return self.now

    assert "raised StopIteration" in only(check_policy(Strict(), problem()))


def test_it_raises_at_the_start() -> None:
    class Stumbles(Sound):
        def start(self, problem: Problem) -> None:
            raise RuntimeError("not today")

    assert "start() raised RuntimeError('not today')" in only(check_policy(Stumbles(), problem()))


def test_it_raises_when_the_guard_moves_the_cell() -> None:
    class Stubborn(Sound):
        def adopt(self, name: str) -> None:
            raise RuntimeError(name)

    fault = only(check_policy(Stubborn(), problem()))
    assert "adopt() raised RuntimeError" in fault
    assert "a guard moves the cell" in fault


def test_it_ignores_where_the_guard_moved_the_cell() -> None:
    class Deaf(DTP):
        def adopt(self, name: str) -> None:
            pass

    policy = Deaf(candidates=CANDIDATES, initial="LOC", objective=OBJECTIVE)
    assert any("migrated=False" in fault for fault in check_policy(policy, problem()))


def test_it_works_only_for_a_while() -> None:
    class Tires(Sound):
        def start(self, problem: Problem) -> None:
            super().start(problem)
            self.left = 250

        def choose(self, observed: QoS, estimates: Estimates) -> str:
            self.left -= 1
            if self.left < 0:
                raise OverflowError
            return self.now

    fault = only(check_policy(Tires(), problem()))
    assert "raised OverflowError() in window 250 of 'a random walk'" in fault


@pytest.mark.parametrize("answer", [None, 3, ("LOC", "SO"), ["LOC"]])
def test_it_returns_something_else(answer: object) -> None:
    class Odd:
        def decide(self, *, observed: QoS, estimates: Estimates) -> object:
            return answer

    fault = only(check_policy(Odd(), problem()))  # type: ignore[arg-type]
    assert f"it returned {answer!r}" in fault
    assert "must return a Decision, or the name of a candidate" in fault


def test_it_chooses_an_unknown_candidate() -> None:
    class Elsewhere:
        def decide(self, *, observed: QoS, estimates: Estimates) -> str:
            return "CLOUD"

    fault = only(check_policy(Elsewhere(), problem()))
    assert "chose 'CLOUD'" in fault
    assert "candidates: LOC, SO, HYB" in fault


def test_it_starts_on_an_unknown_candidate() -> None:
    class Lost(Sound):
        initial = "CLOUD"

    assert "its initial is 'CLOUD'" in only(check_policy(Lost(), problem()))


def broken(change: Callable[[Decision], Decision]) -> tuple[str, ...]:
    """Return what is said of a policy whose every decision is changed so."""

    class Broken(Sound):
        def decide(self, *, observed: QoS, estimates: Estimates) -> Decision:
            return change(Sound.decide(self, observed=observed, estimates=estimates))

    return check_policy(Broken(), problem())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"placement": CANDIDATES["SO"]}, "with another placement than that candidate's"),
        ({"placement": Placement({"sensing": "R1"})}, "with another placement"),
        ({"placement": None}, "with another placement"),
        ({"migrated": True}, "with migrated=True, when LOC was the incumbent"),
        ({"reason": "because"}, "with reason 'because'; it must be one of dwell, hold"),
        ({"reason": "migrate"}, "that stays, with reason 'migrate'"),
        ({"dwell": -1}, "with dwell -1"),
        ({"dwell": 0.5}, "with dwell 0.5"),
        ({"costs": {"LOC": float("nan")}}, "with the cost nan for 'LOC'"),
        ({"costs": {"CLOUD": 1.0}}, "with the cost 1.0 for 'CLOUD'"),
        ({"name": "SO"}, "with another placement"),
    ],
)
def test_a_decision_that_contradicts_itself(changes: dict[str, object], message: str) -> None:
    faults = broken(lambda decision: replace(decision, **changes))  # type: ignore[arg-type]
    assert any(message in fault for fault in faults), faults
    if "name" not in changes:
        assert len(faults) == 1


def test_a_migration_that_says_hold() -> None:
    class Coy(Sound):
        def decide(self, *, observed: QoS, estimates: Estimates) -> Decision:
            before = self.now
            self.now = "SO"
            return Decision(CANDIDATES["SO"], "SO", before != "SO", "hold")

    assert "that migrates, with reason 'hold'" in only(check_policy(Coy(), problem()))


def test_it_never_says_that_it_migrates() -> None:
    class Silent(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            return "SO"

    faults = check_policy(Silent(), problem())
    assert any("migrated=False, when LOC was the incumbent" in fault for fault in faults)


def test_it_takes_estimates_away() -> None:
    class Takes(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            estimates.pop("HYB")  # type: ignore[attr-defined]
            return self.now

    fault = only(check_policy(Takes(), problem()))
    assert "decide() raised TypeError('FrozenDict cannot be changed; " in fault


def test_it_changes_estimates_by_force() -> None:
    class Takes(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            dict.pop(estimates, "HYB")  # type: ignore[call-overload]
            return self.now

    assert "changed the metrics it was given" in only(check_policy(Takes(), problem()))


def test_it_rewrites_what_it_observed() -> None:
    class Rewrites(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            object.__setattr__(observed, "l95_ms", observed.l95_ms / 2 + 1)
            return self.now

    assert "changed the metrics it was given" in only(check_policy(Rewrites(), problem()))


def test_it_rewrites_the_candidates() -> None:
    class Rewrites(Sound):
        def start(self, problem: Problem) -> None:
            super().start(problem)
            dict.__setitem__(dict(problem.candidates)["SO"], "perception", "R1")

    cell = problem({name: Placement(dict(moves)) for name, moves in CANDIDATES.items()})
    assert any("changed the candidates" in fault for fault in check_policy(Rewrites(), cell))


def test_it_does_not_forget() -> None:
    class Remembers(Fastest):
        seen = 0

        def start(self, problem: Problem) -> None:
            pass

        def decide(self, *, observed: QoS, estimates: Estimates) -> str:
            self.seen += 1
            return "SO" if self.seen > 30 else "LOC"

    fault = only(check_policy(Remembers(), problem()))
    assert "other decisions after a restart" in fault


@pytest.mark.parametrize("with_start", [True, False])
def test_it_draws_without_a_seed(with_start: bool) -> None:
    class Draws:
        def decide(self, *, observed: QoS, estimates: Estimates) -> str:
            return random.choice(list(estimates))

    class DrawsAgain(Draws):
        def start(self, problem: Problem) -> None:
            pass

    policy = DrawsAgain() if with_start else Draws()
    assert "randomness needs a fixed seed" in only(check_policy(policy, problem()))


def test_it_never_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "LIMIT_S", 0.1)

    class Endless(Sound):
        def choose(self, observed: QoS, estimates: Estimates) -> str:
            while observed.l95_ms > 100:
                pass
            return self.now

    fault = only(check_policy(Endless(), problem()))
    assert "decide() did not return within 0.1 s of CPU" in fault
    assert "latencies at their bound" in fault


def test_several_faults_are_told_apart() -> None:
    faults = broken(lambda decision: replace(decision, migrated=True, dwell=-1))
    assert len(faults) == 2
