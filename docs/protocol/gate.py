"""Cycle numbers and the sink's gate (rules 1, 7) as a model: `python -m docs.protocol.gate`.

A stamper that numbers cycles, and a sink before an actuator; both die and start again. What was
stamped once may reach the sink as a command at any time later, any number of times, or never. The
actuator may raise, at a command and when it is told to hold, and has been told in the end.

The stamper's computer may lose its power: its book is then an old one or gone, and its clock may
be right or not set at all. The sink repeats the run of its newest command, and one message may
claim any run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

from docs.protocol.checker import Rules, Step, report

#: What can be left out.
RULES = {
    "reservation": "numbers are reserved before they are used, and left out after a restart",
    "order": "a command that is not newer than the newest one is dropped",
    "memory": "a sink that starts again knows the newest command",
    "before": "a command is remembered before it is applied, not after",
    "age": "a command that is too old is dropped",
    "run": "a stamper whose book is gone begins another run",
    "boot": "a stamper with a book of another boot begins a run beyond it",
    "heard": "a stamper without a book of this boot goes beyond the run that the sink repeats",
    "equal": "an unsigned claim is believed when it comes again without another between",
    "refused": "a command that the actuator has refused is not applied again",
    "again": "an actuator that raises when it is told to hold is told again",
}

#: Run and cycle.
Number: TypeAlias = tuple[int, int]
NONE: Number = (0, -1)


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may happen.

    Parameters
    ----------
    cycles : int
        Numbers that are used.
    crashes : int
        Processes that die and start again, and calls at which the actuator raises.
    losses : int
        Times that the stamper's book is gone or old, too.
    lies : int
        Claims of a run that does not exist.
    block : int
        Numbers that are reserved at a time.
    fresh : int
        Cycles after whose release a command is too old.
    """

    cycles: int = 5
    crashes: int = 3
    losses: int = 1
    lies: int = 1
    block: int = 2
    fresh: int = 3


ALL, LIMITS = Rules(), Limits()
#: All that may happen at once is too much to look at every state.
CASES = Limits(losses=0, lies=0), Limits(crashes=2)
#: Run that the clock names at the first start and later, and where it was not set; the highest.
EARLIER, LATER, UNSET, TOP = 2, 5, 1, 9


class State(NamedTuple):
    """Everything.

    Parameters
    ----------
    run, cycle, reserved : int
        The stamper's; the book has the run and the reservation.
    stamped : tuple of tuple
        Numbers in the order of their use.
    newest : tuple
        What the sink takes for the newest command.
    book : tuple
        What it has remembered.
    under_way : tuple
        Command that has passed the gate and is not yet applied (or remembered).
    actuated : tuple
        What the actuator has had last.
    watch : str
        Whether the actuator is to be told to hold when no command comes: ``armed``; ``rests`` where
        it has been told, or never moved; ``gone`` where it has not, and nobody will tell it.
    unsure : bool
        Whether the stamper has no book of this boot.
    claim : tuple
        Run that was claimed last, and how many times in a row.
    crashes, losses, lies : int
        How many there have been.
    """

    run: int = EARLIER
    cycle: int = 0
    reserved: int = 0
    stamped: tuple[Number, ...] = ()
    newest: Number = NONE
    book: Number = NONE
    under_way: Number = NONE
    actuated: Number = NONE
    watch: str = "rests"
    unsure: bool = False
    claim: tuple[int, int] = (0, 0)
    crashes: int = 0
    losses: int = 0
    lies: int = 0


def initial() -> State:
    """Return the state in which a cell begins."""
    return State()


def good(state: State) -> bool:
    """Whether the actuator has had the last cycle, or rests where none may come any more."""
    over = len(state.stamped) == LIMITS.cycles and state.watch == "rests"
    over = over and state.run >= state.newest[0]
    return over or (bool(state.stamped) and state.actuated == state.stamped[-1])


def successors(state: State, rules: Rules = ALL, limits: Limits = LIMITS) -> Iterator[Step[State]]:
    """Return everything that may happen next."""
    yield from _faults(state, rules, limits)
    yield from _stamp(state, limits)
    yield from _claims(state, rules, limits)
    if state.under_way == NONE:
        for number in set(state.stamped):
            if _passes(state, rules, limits, number):
                seen = state._replace(under_way=number, newest=number)
                if rules.holds("before"):
                    seen = seen._replace(book=number)
                yield Step(f"the gate lets {number} through", seen)
        yield from _silence(state, rules, limits)
    else:
        yield _apply(state, rules, limits)
        if state.crashes < limits.crashes:
            # It may have moved all the same.
            had = state._replace(actuated=state.under_way, watch="armed", crashes=state.crashes + 1)
            refused = had._replace(under_way=NONE) if rules.holds("refused") else had
            yield Step(f"the actuator refuses {state.under_way}", refused, fault=True)


def _silence(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    """No command comes for too long."""
    if state.watch != "armed":
        return
    yield Step("it is told to hold", state._replace(watch="rests"))
    if state.crashes < limits.crashes:
        watch = "armed" if rules.holds("again") else "gone"
        raised = state._replace(watch=watch, crashes=state.crashes + 1)
        yield Step("it is told to hold, and raises", raised, fault=True)


def _faults(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    if state.crashes == limits.crashes:
        return
    once = state._replace(crashes=state.crashes + 1)
    # Without the reservation the book has the newest number only now and then.
    behind = max(state.cycle - 1, 0)
    cycle = state.reserved if rules.holds("reservation") else behind
    yield Step("the stamper starts again", once._replace(cycle=cycle), fault=True)
    if state.losses < limits.losses:
        lost = once._replace(unsure=True, claim=(0, 0), losses=state.losses + 1)
        for clock in (LATER, UNSET):
            run = clock if rules.holds("run") else state.run
            fresh = lost._replace(run=run, cycle=0, reserved=0)
            yield Step(f"its book is gone, and its clock says {clock}", fresh, fault=True)
            old = lost._replace(run=max(clock, state.run + 1), cycle=0, reserved=0)
            if not rules.holds("boot"):
                old = lost._replace(cycle=1, reserved=1)
            yield Step(f"its book is old, and its clock says {clock}", old, fault=True)
    known = state.book if rules.holds("memory") else NONE
    watch = "rests" if known == NONE else "armed"
    reborn = once._replace(newest=known, under_way=NONE, watch=watch)
    yield Step("the sink starts again", reborn, fault=True)
    if state.under_way != NONE and not rules.holds("before"):
        applied = reborn._replace(actuated=state.under_way)
        yield Step("the sink applies, and starts again", applied, fault=True)


def _claims(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    """Somebody says which run the sink has let through."""
    if state.newest != NONE and rules.holds("heard"):
        claimed = _claimed(state, rules, state.newest[0])
        yield Step(f"the sink says that it knows run {state.newest[0]}", claimed)
    if state.lies < limits.lies:
        claimed = _claimed(state, rules, TOP)._replace(lies=state.lies + 1)
        wrong = "the numbers are used up" if claimed.run > TOP else ""
        yield Step(f"somebody makes up run {TOP}", claimed, fault=True, wrong=wrong)


def _claimed(state: State, rules: Rules, run: int) -> State:
    """Return what a stamper makes of a claim."""
    if not state.unsure:
        return state
    before, count = state.claim
    count = min(count + 1, 2) if before == run else 1
    state = state._replace(claim=(run, count))
    if run <= state.run or (count < 2 and rules.holds("equal")):
        return state
    return state._replace(run=run + 1, claim=(0, 0))


def _stamp(state: State, limits: Limits) -> Iterator[Step[State]]:
    if len(state.stamped) == limits.cycles:
        return
    reserved = state.reserved
    if state.cycle >= reserved:
        reserved = state.cycle + limits.block
    number = state.run, state.cycle
    wrong = "a number is used twice" if number in state.stamped else ""
    after = state._replace(
        cycle=state.cycle + 1, reserved=reserved, stamped=(*state.stamped, number)
    )
    yield Step(f"{number} is stamped", after, wrong=wrong)


def _passes(state: State, rules: Rules, limits: Limits, number: Number) -> bool:
    if rules.holds("order") and number <= state.newest:
        return False
    return not rules.holds("age") or not _old(state, limits, number)


def _old(state: State, limits: Limits, number: Number) -> bool:
    return len(state.stamped) - state.stamped.index(number) > limits.fresh


def _apply(state: State, rules: Rules, limits: Limits) -> Step[State]:
    number = state.under_way
    wrong = ""
    if number == state.actuated:
        wrong = "a command is applied twice"
    elif number < state.actuated:
        wrong = "a command is applied after a later one"
    elif not rules.holds("age") and _old(state, limits, number):
        wrong = "an old command is applied"
    after = state._replace(under_way=NONE, book=max(state.book, number), actuated=number)
    after = after._replace(watch="armed")
    return Step(f"{number} is applied", after, wrong=wrong)


if __name__ == "__main__":
    report(initial(), [partial(successors, limits=limits) for limits in CASES], good, RULES)
