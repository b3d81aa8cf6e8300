"""The guard's way through its fallbacks (rule 5) as a model: `python -m docs.protocol.fallbacks`.

A placement carries cycles or does not, and is heard or is not, whatever the one says of the other:
beats may pass where images do not. Time is left out: a silence is a step, and so is a rest. Orders
may come at any time, to any placement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from docs.protocol.checker import Rules, Step, report

#: Fallbacks, best first, and a placement that is none.
FALLBACKS = "LOC", "HYB", "EDGE"
WANTED = "SO"
PLACEMENTS = *FALLBACKS, WANTED

#: What can be left out.
RULES = {
    "once": "each fallback is tried once a round",
    "last": "what has failed is tried after what has not",
    "carrier": "after a return that fails comes what carried the cell before it",
    "rest": "the guard rests when all that are heard have been tried",
    "at once": "what is heard again meanwhile is tried at once",
    "again": "another round begins after the rest",
    "over": "a cycle that completes ends the round",
}


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may happen.

    Parameters
    ----------
    faults : int
        Times that a placement can carry cycles no more, or again; or is heard no more, or again.
    orders : int
        Orders, to any placement.
    """

    faults: int = 2
    orders: int = 1


ALL, LIMITS = Rules(), Limits()
CASES = LIMITS, Limits(faults=4, orders=0), Limits(faults=2, orders=2)


class State(NamedTuple):
    """Everything.

    Parameters
    ----------
    at : str
        Placement that holds.
    own : bool
        Whether the guard itself has moved the cell there.
    carries : bool
        Whether a cycle has completed since.
    failed : tuple of str
        What has failed since a cycle has completed or an order has come, in this order.
    tried : frozenset of str
        What the guard has moved to in this round.
    rests : bool
        Whether the round is over without success.
    carrier : str
        What carried the cell before an order left it, until a cycle has completed.
    able, heard : frozenset of str
        Placements that can carry cycles, and those whose parts are heard.
    faults, orders : int
        How many there have been.
    moved : frozenset of str
        What the guard has moved to since a cycle has completed, an order has come or a rest has
        ended, as an omniscient observer knows.
    """

    at: str = WANTED
    own: bool = False
    carries: bool = True
    failed: tuple[str, ...] = ()
    tried: frozenset[str] = frozenset()
    rests: bool = False
    carrier: str = ""
    able: frozenset[str] = frozenset(PLACEMENTS)
    heard: frozenset[str] = frozenset(FALLBACKS)
    faults: int = 0
    orders: int = 0
    moved: frozenset[str] = frozenset()


def initial() -> State:
    """Return the state in which a cell begins."""
    return State(able=frozenset({WANTED}))


def good(state: State) -> bool:
    """Whether cycles complete, or no fallback could help."""
    return state.at in state.able or not state.able & state.heard & set(FALLBACKS)


def successors(state: State, rules: Rules = ALL, limits: Limits = LIMITS) -> Iterator[Step[State]]:
    """Return everything that may happen next."""
    yield from _world(state, limits)
    if state.at in state.able:
        yield Step("a cycle completes", _completed(state, rules))
    elif not state.rests:
        yield from _silence(state, rules)
    else:
        found = next(iter(_options(state, rules)), None) if rules.holds("at once") else None
        if found is not None:
            yield _move(state, rules, found)
        elif rules.holds("again"):
            again = state._replace(rests=False, tried=frozenset(), moved=frozenset())
            yield Step("the rest is over", again, wrong=_missed(state))


def _world(state: State, limits: Limits) -> Iterator[Step[State]]:
    if state.faults < limits.faults:
        once = state._replace(faults=state.faults + 1)
        for name in PLACEMENTS:
            able, heard = state.able ^ {name}, state.heard ^ {name}
            again = "no more" if name in state.able else "again"
            yield Step(f"{name} can carry {again}", once._replace(able=able), fault=True)
            if name in FALLBACKS:
                again = "no more" if name in state.heard else "again"
                yield Step(f"{name} is heard {again}", once._replace(heard=heard), fault=True)
    if state.orders < limits.orders:
        for name in PLACEMENTS:
            if name != state.at:
                own = state.at if state.carries else ""
                carrier = own if state.own else state.carrier
                ordered = State(
                    *(name, False, False, (), frozenset(), False, carrier),
                    *(state.able, state.heard, state.faults, state.orders + 1),
                )
                yield Step(f"an order to {name}", ordered, fault=True)


def _completed(state: State, rules: Rules) -> State:
    done = state._replace(carries=True, carrier="", moved=frozenset(), rests=False)
    return done._replace(failed=(), tried=frozenset()) if rules.holds("over") else done


def _options(state: State, rules: Rules) -> list[str]:
    """Return the fallbacks that are heard and may be tried, the next one first."""
    fresh = [name for name in FALLBACKS if name not in state.failed or not rules.holds("last")]
    carrier = [state.carrier] if state.carrier and rules.holds("carrier") else []
    order = dict.fromkeys((*carrier, *fresh, *state.failed))
    used = state.tried if rules.holds("once") else frozenset[str]()
    return [name for name in order if name in state.heard - used and name != state.at]


def _silence(state: State, rules: Rules) -> Iterator[Step[State]]:
    """Nothing has completed for g periods."""
    options = _options(state, rules)
    if options:
        yield _move(state, rules, options[0])
        return
    if not state.own or not state.tried:
        return
    if rules.holds("rest"):
        yield Step("the guard rests", state._replace(rests=True), wrong=_missed(state))
    else:
        yield Step("a round begins", state._replace(tried=frozenset()))


def _missed(state: State) -> str:
    missed = state.heard & set(FALLBACKS) - state.moved - {state.at}
    return f"it rests, and {min(missed)} is heard and has not been tried" if missed else ""


def _move(state: State, rules: Rules, to: str) -> Step[State]:
    left = tuple(name for name in state.failed if name != state.at)
    failed = (*left, state.at) if state.at in FALLBACKS else left
    return Step(
        f"the guard moves the cell to {to}",
        state._replace(
            at=to,
            own=True,
            carries=False,
            failed=failed,
            tried=state.tried | {to},
            rests=False,
            carrier="",
            moved=state.moved | {to},
        ),
        wrong=_wrong(state, to),
    )


def _wrong(state: State, to: str) -> str:
    """Return what is wrong with a move, by what an observer knows."""
    others = state.heard & set(FALLBACKS) - set(state.failed) - state.moved - {state.at}
    if to in state.moved:
        return f"{to} is tried twice"
    if state.carrier in state.heard - {state.at, to}:
        return f"{to} is tried before {state.carrier}, which carried the cell"
    if to != state.carrier and to in state.failed and others:
        return f"{to} has failed, and is tried before {min(others)}"
    return ""


if __name__ == "__main__":
    report(initial(), [partial(successors, limits=one) for one in CASES], good, RULES)
