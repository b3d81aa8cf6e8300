"""Orders, terms, guard and return (rules 2, 5, 6) as a model: `python -m docs.protocol.orders`.

One stamper, two controllers that may both think that they are in charge, and a network that loses,
delays, repeats and reorders whatever is said: a message that was sent once may arrive at any time
later, any number of times, or never. Time is left out: the guard may fire, a lease may run out and
a process may die and come back whenever there are faults left to spend. Each rule can be left out
of the model, and the checker then has to find out what it is there for.

A stamp says where the cell is, and not who has moved it: a controller that hears of a new term by a
stamp takes it for the guard's doing unless it has ordered that very move, and may have forgotten it
even then. Answers say it.

A controller that wants to leave a fallback says so again and again, and probes count for as long as
that is what it says. Those that are needed take longer than a window, and than an order is waited
for: where that matters, the controller speaks after each of them.

No process lies here. A damaged or invented message that leaps is held back
(`dwell.live.wire.continuity`). A true message that is held back counts as lost or late, and the
model has such messages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

from docs.protocol.checker import Rules, Step, report

#: Candidates: the guard's first fallback, where the controllers would like to be, and a third one,
#: its second fallback.
FALLBACK, WANTED, OTHER = "LOC", "SO", "HYB"
CONTROLLERS = "A", "B"

Item = TypeVar("Item")

#: What can be left out.
RULES = {
    "term": "an order is accepted in the term that it was computed on only",
    "proof": "a fallback is left only after enough probes",
    "new term": "every change of the placement begins a term",
    "fresh proof": "a proof counts for the stay on the fallback that it was made in",
    "charge": "a second controller is refused while the first one is in charge",
    "book": "a stamper that starts again knows its term and placement",
    "answer": "an answer that it was no move of the guard ends the wait for a proof",
    "wish": "what is wanted is said until the cell is there, whatever is given up meanwhile",
}
#: Probes that come through before an order is given up, or a window closes: fewer than are needed.
PATIENCE = 1


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may happen.

    Parameters
    ----------
    fires : int
        Times that the guard moves the cell.
    crashes : int
        Processes that die and start again.
    lapses : int
        Times that a lease runs out although its controller lives.
    whims : int
        Orders to another placement than the one that is wanted otherwise: people's, who wait for no
        proof.
    controllers : int
        How many say something.
    probes : int
        How many are needed. Where it is 1 somebody always wants to leave.
    """

    fires: int = 2
    crashes: int = 1
    lapses: int = 1
    whims: int = 0
    controllers: int = len(CONTROLLERS)
    probes: int = 1


class Order(NamedTuple):
    """An order on its way; `fires` is how often the guard had moved when it was sent."""

    controller: str
    term: int
    placement: str
    fires: int


class Told(NamedTuple):
    """What the stamper has said of itself at some time, in answers and stamps."""

    term: int
    placement: str
    fallback: bool


ALL, LIMITS = Rules(), Limits()
#: One controller whose proof takes long, one that changes its mind, and two of one mind.
CASES = (
    Limits(fires=2, lapses=0, controllers=1, probes=3),
    Limits(fires=2, lapses=0, whims=1, controllers=1),
    LIMITS,
)
NOTHING = Told(0, "", False)


class State(NamedTuple):
    """Everything.

    Parameters
    ----------
    now : Told
        Term and placement of the stamper.
    charge : str
        Controller that is in charge.
    probed : frozenset of int
        Terms in which enough probes have come through; word of it may arrive at any time.
    wish : bool
        Whether the stamper has been told to send probes.
    counted : int
        Probes that have come through since then, while they are not enough.
    tried : int
        How many of them since the controller has last begun to want what it wants.
    spoken : bool
        Whether the controller has said what it wants since the last of them.
    proof : frozenset of int
        Terms of the probes that the stamper has heard of.
    told : frozenset of Told
        What has been said; may arrive at any time.
    orders : frozenset of Order
        What has been ordered; may arrive at any time.
    views : tuple of Told
        What each controller knows, or takes for true: nothing before it has heard anything.
    fires, crashes, lapses, whims : int
        How many there have been.
    done : frozenset of Order
        Orders that have taken effect, as an omniscient observer knows.
    """

    now: Told = Told(1, WANTED, False)
    charge: str = ""
    probed: frozenset[int] = frozenset()
    proof: frozenset[int] = frozenset()
    told: frozenset[Told] = frozenset({Told(1, WANTED, False)})
    orders: frozenset[Order] = frozenset()
    views: tuple[Told, ...] = (NOTHING, NOTHING)
    fires: int = 0
    crashes: int = 0
    lapses: int = 0
    whims: int = 0
    done: frozenset[Order] = frozenset()
    wish: bool = False
    counted: int = 0
    tried: int = 0
    spoken: bool = False


def initial() -> State:
    """Return the state in which a cell begins."""
    return State()


def good(state: State) -> bool:
    """Whether the cell is where its controllers want it, by an order."""
    return state.now.placement == WANTED and not state.now.fallback


def successors(state: State, rules: Rules = ALL, limits: Limits = LIMITS) -> Iterator[Step[State]]:
    """Return everything that may happen next."""
    yield from _faults(state, rules, limits)
    yield from _stamper(state, rules, limits)
    if limits.probes > 1 and state.now.fallback:
        yield from _speaks(state, rules)
    for index, name in enumerate(CONTROLLERS[: limits.controllers]):
        yield from _controller(state, rules, limits, index, name)


def _moved(state: State, rules: Rules, placement: str, *, fallback: bool) -> State:
    term = state.now.term + 1 if rules.holds("new term") else state.now.term
    now = Told(term, placement, fallback)
    proof = frozenset[int]() if rules.holds("fresh proof") else state.proof
    moved = state._replace(now=now, told=state.told | {now}, proof=proof)
    return _forgets(moved)


def _forgets(state: State) -> State:
    """The stamper has no wish, and has counted nothing."""
    return state._replace(wish=False, counted=0, tried=0, spoken=False)


def _faults(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    if state.fires < limits.fires:
        to = FALLBACK if state.now.placement != FALLBACK else OTHER
        fired = _moved(state, rules, to, fallback=True)
        yield Step("the guard moves the cell", fired._replace(fires=state.fires + 1), fault=True)
    if state.crashes < limits.crashes:
        once = state._replace(crashes=state.crashes + 1)
        reborn = _forgets(once._replace(charge="", proof=frozenset()))
        if not rules.holds("book"):
            first = Told(1, WANTED, False)
            reborn = reborn._replace(now=first)
        yield Step("the stamper starts again", reborn, fault=True)
        for index, name in enumerate(CONTROLLERS):
            again = once._replace(views=_set(once.views, index, NOTHING))
            yield Step(f"controller {name} starts again", again, fault=True)
    if state.lapses < limits.lapses and state.charge:
        lapsed = state._replace(charge="", lapses=state.lapses + 1)
        yield Step(f"the lease of {state.charge} runs out", lapsed, fault=True)


def _set(values: tuple[Item, ...], index: int, value: Item) -> tuple[Item, ...]:
    return (*values[:index], value, *values[index + 1 :])


# -------------------------------------------------------------------------------- stamper


def _stamper(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    term = state.now.term
    if state.now.fallback and term not in state.probed:
        if limits.probes == 1:
            yield Step("a probe comes through", state._replace(probed=state.probed | {term}))
        elif state.wish and state.spoken:
            yield Step("a probe comes through", _probe(state, limits))
    for probed in state.probed - state.proof:
        if state.now.fallback and (probed == term or not rules.holds("fresh proof")):
            heard = state._replace(proof=state.proof | {probed})
            yield Step(f"a probe of term {probed} is heard of", heard)
    for order in state.orders:
        yield _arrives(state, rules, order)


def _probe(state: State, limits: Limits) -> State:
    count, tried = state.counted + 1, min(state.tried + 1, PATIENCE)
    if count == limits.probes:
        return _forgets(state._replace(probed=state.probed | {state.now.term}))
    return state._replace(counted=count, tried=tried, spoken=False)


def _speaks(state: State, rules: Rules) -> Iterator[Step[State]]:
    """The controller says what it wants, and is heard; word that is lost is none."""
    if state.now.term in state.probed:
        return
    if state.tried == PATIENCE and not rules.holds("wish"):
        yield Step("the controller has given up, and says so", _forgets(state))
    elif not state.spoken:
        told = state._replace(wish=True, spoken=True)
        yield Step("the controller says that it wants to leave", told)


def _arrives(state: State, rules: Rules, order: Order) -> Step[State]:
    """The stamper takes an order in, for the first time or again."""
    label = f"the order of {order.controller} in term {order.term} to {order.placement} arrives"
    if state.charge not in ("", order.controller) and rules.holds("charge"):
        return Step(label, state)
    charged = state._replace(charge=order.controller)
    here = order.placement == state.now.placement and not state.now.fallback
    stale = order.term != state.now.term and rules.holds("term")
    unproven = state.now.fallback and not state.proof and rules.holds("proof")
    if here or stale or unproven:
        return Step(label, charged)
    wrong = ""
    if order.fires < state.fires:
        wrong = "an order from before the guard's move takes effect after it"
    elif order in state.done:
        wrong = "an order takes effect twice"
    elif state.now.fallback and state.now.term not in state.probed:
        wrong = "the fallback is left without a proof"
    moved = _moved(charged, rules, order.placement, fallback=False)
    return Step(label, moved._replace(done=state.done | {order}), wrong=wrong)


# ----------------------------------------------------------------------------- controllers


def _controller(
    state: State, rules: Rules, limits: Limits, index: int, name: str
) -> Iterator[Step[State]]:
    view = state.views[index]
    for placement in (WANTED, OTHER):
        whim = placement != WANTED
        order = Order(name, view.term, placement, state.fires)
        here = placement == view.placement and not view.fallback
        if not view.term or here or order in state.orders:
            continue
        if whim and state.whims == limits.whims:
            continue
        if not whim and view.fallback and view.term not in state.probed:
            continue
        yield Step(
            f"{name} orders {placement} in term {view.term}",
            state._replace(orders=state.orders | {order}, whims=state.whims + whim),
        )
    for told in state.told:
        for what, heard in _hearings(rules, view, told):
            views = _set(state.views, index, heard)
            yield Step(f"{name} hears {what} of term {told.term}", state._replace(views=views))


def _hearings(rules: Rules, view: Told, told: Told) -> Iterator[tuple[str, Told]]:
    """What a controller makes of what the stamper has said, by how it was said."""
    if told.term > view.term:
        # A stamp of a move that it has ordered, and remembers, is as good.
        yield "an answer", told
        if not told.fallback:
            yield "a stamp", told._replace(fallback=True)
    elif told.term == view.term and view.fallback and not told.fallback and rules.holds("answer"):
        yield "an answer", told


if __name__ == "__main__":
    report(initial(), [partial(successors, limits=one) for one in CASES], good, RULES)
