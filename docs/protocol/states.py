"""Migrations of a task with a state (rule 8) as a model: `python -m docs.protocol.states`.

One task on two nodes, a stamper, a controller. Inputs reach a node in the order in which they were
sent; whatever else was said once may arrive at any time later, any number of times, or never. A
state is the set of the cycles whose inputs are in it. A task that is moved by order may lose none
of them; where the guard moves it, or its worker dies, it goes on with what is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from docs.protocol.checker import Rules, Step, report

NODES = "A", "B"

#: What can be left out.
RULES = {
    "wait": "a snapshot has all cycles before the first one that is forked",
    "early": "the first cycle that is forked is the first that is not stamped yet",
    "replay": "the target works on what came while the state was on its way",
    "log": "the target keeps what it was forked, also where it follows already",
    "ready": "the placement is ordered when the target has said that it is ready",
    "number": "what is said of an earlier migration is not taken for this one's",
    "hello": "whatever a controller says meanwhile says what is forked, too",
    "newest": "an order does not move the cell if a later one has come",
    "own": "a state does not replace one that has worked on later cycles by order",
    "later": "a state does not replace a later one that was taken over",
    "asked": "a state is taken for the snapshot that its target knows to be asked for",
    "stamped": "a state waits for the stamp of its last cycle",
    "past": "what the state is past is not worked on",
    "suppress": "the output of a cycle is sent where it is stamped only",
}


@dataclass(frozen=True, slots=True)
class Limits:
    """How much may happen.

    Parameters
    ----------
    cycles : int
        That are stamped.
    moves : int
        Migrations that are begun.
    fires : int
        Times that the guard moves the cell.
    crashes : int
        Workers that die and start again.
    hellos : int
        Times that the controller says that it is there while it moves the task.
    early : bool
        Whether a stamp may be drawn before its cycle is released.
    lies : int
        States of cycles to come that somebody makes up, the node that is asked for one included.
    """

    cycles: int = 2
    moves: int = 1
    fires: int = 0
    crashes: int = 0
    hellos: int = 0
    early: bool = False
    lies: int = 0


class Input(NamedTuple):
    """The input of a cycle on its way; `own` where the cycle is stamped with this node."""

    cycle: int
    own: bool
    excused: bool = False


class Worker(NamedTuple):
    """A worker.

    Parameters
    ----------
    held : int
        Cycles in its state, a bit each.
    own : int
        The last one that was stamped with this node.
    taken : int
        The last one in the state that it took over.
    log : int
        Cycles that it was forked.
    follows : bool
        Whether it has taken a state over and works on what it is forked.
    asked : tuple of int
        Number and first cycle that is forked, of a snapshot that it is asked for.
    excused : bool
        Whether it has died since it last worked.
    awaits : int
        Number of the snapshot whose state shall come here.
    """

    held: int = 0
    own: int = 0
    taken: int = 0
    log: int = 0
    follows: bool = False
    asked: tuple[int, int] = (0, 0)
    excused: bool = False
    awaits: int = 0


class Message(NamedTuple):
    """Something that was said.

    Parameters
    ----------
    kind : str
        ``order`` (also one that only forks, or only says hello), ``ask`` for a snapshot, ``state``,
        ``lie`` for one that is made up, ``ready``.
    number : int
    to : str
        Node: whither an order forks, or whose message it is; nothing where nothing is forked.
    term : int
        Of an order.
    moves : bool
        Whether an order moves the task.
    cycle : int
        The first cycle that is forked.
    held : int
        Cycles in a state.
    """

    kind: str
    number: int
    to: str
    term: int = 0
    moves: bool = False
    cycle: int = 0
    held: int = 0


class Move(NamedTuple):
    """A migration under way: what forks for it, and what moves the task, by their numbers."""

    number: int
    to: str
    term: int
    order: int = 0


class State(NamedTuple):
    """Everything.

    Parameters
    ----------
    cycle : int
        The next one to be stamped.
    active, term, fork : str, int, str
        The stamper's: where the task runs, the term, whither its inputs are forked.
    early : str
        Whither those of the next cycle are, where its stamp is drawn already; ``-`` where not.
    newest : int
        Number of the last order whose settings the stamper has taken over.
    by_guard : bool
        Whether the guard has moved the task, and no cycle been stamped since.
    inputs : tuple of tuple of Input
        On their way to each node.
    workers : tuple of Worker
    move : Move, optional
    number : int
        The controller's last.
    said : frozenset of Message
    lost : int
        Cycles that faults have cost the state, as an omniscient observer knows.
    moves, fires, crashes, hellos, lies : int
        How many there have been.
    """

    cycle: int = 1
    active: str = "A"
    term: int = 1
    fork: str = ""
    early: str = "-"
    newest: int = 0
    by_guard: bool = False
    inputs: tuple[tuple[Input, ...], ...] = ((), ())
    workers: tuple[Worker, ...] = (Worker(), Worker())
    move: Move | None = None
    number: int = 0
    said: frozenset[Message] = frozenset()
    lost: int = 0
    moves: int = 0
    fires: int = 0
    crashes: int = 0
    hellos: int = 0
    lies: int = 0


ALL, LIMITS = Rules(), Limits()
#: All that may happen at once is too much to look at every state.
CASES = (
    Limits(cycles=3, fires=1),
    Limits(cycles=2, hellos=1, early=True),
    Limits(cycles=2, fires=1, crashes=1),
    Limits(cycles=3, moves=2),
    Limits(cycles=3, lies=1),
)
#: Number of a state that nobody has asked for.
NOBODYS = 1_000


def initial() -> State:
    """Return the state in which a cell begins."""
    return State()


def good(state: State) -> bool:
    """Whether no migration is under way, or it has reached its end, or waits for a next cycle."""
    move = state.move
    if move is None or state.active == move.to or state.by_guard:
        return True
    index = NODES.index(move.to)
    return state.fork == move.to and _heard(state, index) < state.cycle - 1


def successors(state: State, rules: Rules = ALL, limits: Limits = LIMITS) -> Iterator[Step[State]]:
    """Return everything that may happen next."""
    yield from _faults(state, limits)
    yield from _stamper(state, rules, limits)
    for index in range(len(NODES)):
        yield from _worker(state, rules, index)
    yield from _controller(state, rules, limits)


def _faults(state: State, limits: Limits) -> Iterator[Step[State]]:
    if state.fires < limits.fires:
        other = NODES[1 - NODES.index(state.active)]
        moved = state._replace(active=other, term=state.term + 1, fork="", early="-", by_guard=True)
        yield Step("the guard moves the task", moved._replace(fires=state.fires + 1), fault=True)
    if state.crashes < limits.crashes:
        for index, name in enumerate(NODES):
            reborn = _set(state, index, Worker(excused=True))
            gone = (*state.inputs[:index], (), *state.inputs[index + 1 :])
            after = reborn._replace(inputs=gone, crashes=state.crashes + 1)
            yield Step(f"the worker on {name} starts again", after, fault=True)

    if state.lies < limits.lies:
        # Who is asked is believed, but for what cannot be; who is not, knows the newest stamp.
        ahead, newest = (4 << state.cycle) - 2, 1 << (state.cycle - 1) & ~1
        asked = {one.number: ahead for one in state.said if one.kind == "ask"}
        for name in NODES:
            for number, held in {NOBODYS: newest, **asked}.items():
                made_up = Message("lie", number, name, held=held)
                lied = _say(state, made_up)._replace(lies=state.lies + 1)
                yield Step(f"somebody makes up state {number} for {name}", lied, fault=True)


def _set(state: State, index: int, worker: Worker) -> State:
    workers = (*state.workers[:index], worker, *state.workers[index + 1 :])
    return state._replace(workers=workers)


def _say(state: State, message: Message) -> State:
    return state._replace(said=state.said | {message})


def _newest(cycles: int) -> int:
    """Return the last of some cycles."""
    return cycles.bit_length() - 1 if cycles else 0


# --------------------------------------------------------------------------------- stamper


def _stamper(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    if state.cycle <= limits.cycles:
        yield Step(f"cycle {state.cycle} is released", _release(state))
        if limits.early and state.early == "-":
            drawn = state._replace(early=state.fork)
            yield Step(f"cycle {state.cycle} is stamped early", drawn)
    for message in state.said:
        if message.kind == "order":
            yield _ordered(state, rules, message)


def _release(state: State) -> State:
    fork = state.fork if state.early == "-" else state.early
    inputs = list(state.inputs)
    for index, name in enumerate(NODES):
        if name == state.active:
            inputs[index] += (Input(state.cycle, own=True, excused=state.by_guard),)
        elif name == fork:
            inputs[index] += (Input(state.cycle, own=False),)
    return state._replace(cycle=state.cycle + 1, inputs=tuple(inputs), by_guard=False, early="-")


def _ordered(state: State, rules: Rules, order: Message) -> Step[State]:
    """The stamper takes an order in, for the first time or again."""
    what = "moves" if order.moves else f"forks to {order.to or 'nobody'}"
    label = f"order {order.number} arrives, which {what}"
    if order.term != state.term or (order.moves and order.to == state.active):
        return Step(label, state)
    if order.moves and order.number < state.newest and rules.holds("newest"):
        return Step(label, state)
    after = state
    if order.number > state.newest:
        after = after._replace(newest=order.number, fork=order.to)
    if order.moves:
        moved = after._replace(active=order.to, term=state.term + 1, early="-")
        return Step(label, moved)
    if order.to and after.fork == order.to:
        # The answer to it; who asked for it asks for the snapshot.
        drawn = after.early != "-" and rules.holds("early")
        first = after.cycle + 1 if drawn else after.cycle
        asked = [one for one in state.said if (one.kind, one.number) == ("ask", order.number)]
        source = NODES[1 - NODES.index(order.to)]
        if not asked:
            after = _say(after, Message("ask", order.number, source, cycle=first))
    return Step(label, after)


# --------------------------------------------------------------------------------- workers


def _worker(state: State, rules: Rules, index: int) -> Iterator[Step[State]]:
    name, worker = NODES[index], state.workers[index]
    if state.inputs[index]:
        first, *rest = state.inputs[index]
        inputs = (*state.inputs[:index], tuple(rest), *state.inputs[index + 1 :])
        yield _works(state._replace(inputs=inputs), rules, index, first)
    number, cycle = worker.asked
    if number and (_newest(worker.held) >= cycle - 1 or not rules.holds("wait")):
        other = NODES[1 - index]
        told = _set(state, index, worker._replace(asked=(0, 0)))
        answer = Message("state", number, other, held=worker.held)
        yield Step(f"{name} hands its state out", _say(told, answer))
    for message in state.said:
        if message.to != name:
            if message.kind == "ask":
                knows = worker._replace(awaits=message.number)
                yield Step(f"{name} knows that it is asked for", _set(state, index, knows))
            continue
        answered = any(one.kind == "state" and one.number == message.number for one in state.said)
        if message.kind == "ask" and not answered:
            asked = worker._replace(asked=(message.number, message.cycle))
            yield Step(f"{name} is asked for its state", _set(state, index, asked))
        elif message.kind in ("state", "lie"):
            yield _restores(state, rules, index, message)


def _works(state: State, rules: Rules, index: int, one: Input) -> Step[State]:
    """A worker takes its next input."""
    name, worker = NODES[index], state.workers[index]
    past = one.cycle <= _newest(worker.held) and rules.holds("past")
    bit = 1 << one.cycle
    if not one.own:
        keeps = rules.holds("log") or not worker.follows
        log = worker.log | bit if keeps else worker.log
        if not worker.follows or past:
            return Step(f"{name} keeps {one.cycle}", _set(state, index, worker._replace(log=log)))
        wrong = _muddled(worker, one.cycle)
        if not rules.holds("suppress"):
            wrong = "a cycle has two outputs"
        followed = worker._replace(log=log, held=worker.held | bit)
        return Step(f"{name} follows {one.cycle}", _set(state, index, followed), wrong=wrong)
    label = f"{name} works on {one.cycle}"
    if past:
        return Step(f"{name} leaves {one.cycle} out", state)
    before = (bit - 1) & ~1
    if one.excused or worker.excused:
        state = state._replace(lost=state.lost | (before & ~worker.held))
    wrong = _muddled(worker, one.cycle)
    if not wrong and before & ~worker.held & ~state.lost:
        wrong = "a state lacks an input"
    done = worker._replace(
        held=worker.held | bit, own=one.cycle, log=0, follows=False, excused=False, awaits=0
    )
    return Step(label, _set(state, index, done), wrong=wrong)


def _heard(state: State, index: int) -> int:
    """Return the last cycle whose stamp may have come to a worker, with an input that waits."""
    worker = state.workers[index]
    waiting = (one.cycle for one in state.inputs[index])
    return max(worker.own, _newest(worker.log), _newest(worker.held), *waiting)


def _muddled(worker: Worker, cycle: int) -> str:
    if worker.held & (1 << cycle):
        return "a state has the same input twice"
    return "a state gets an input after a later one" if _newest(worker.held) > cycle else ""


def _restores(state: State, rules: Rules, index: int, message: Message) -> Step[State]:
    name, worker = NODES[index], state.workers[index]
    label = f"state {message.number} reaches {name}"
    if message.number != worker.awaits and rules.holds("asked"):
        return Step(f"{label}, which does not await it", state)
    if _newest(message.held) > _heard(state, index) and rules.holds("stamped"):
        return Step(f"{label}, which has not heard of its last cycle", state)
    if _newest(message.held) < worker.own and rules.holds("own"):
        return Step(f"{label}, which has worked on more", state)
    ready = Message("ready", message.number, name)
    if _newest(message.held) < worker.taken and rules.holds("later"):
        return Step(f"{label}, which has a later one", _say(state, ready))
    held = message.held
    if rules.holds("replay"):
        held |= worker.log & ~((2 << _newest(held)) - 1)
    restored = worker._replace(held=held, taken=_newest(message.held), follows=True)
    restored = restored._replace(awaits=0)
    wrong = "a state has a cycle that nobody has stamped" if message.held >> state.cycle else ""
    return Step(label, _say(_set(state, index, restored), ready), wrong=wrong)


# ------------------------------------------------------------------------------ controller


def _controller(state: State, rules: Rules, limits: Limits) -> Iterator[Step[State]]:
    move, number = state.move, state.number + 1
    if move is None:
        if state.moves < limits.moves:
            to = NODES[1 - NODES.index(state.active)]
            begun = state._replace(
                move=Move(number, to, state.term), number=number, moves=state.moves + 1
            )
            order = Message("order", number, to, term=state.term)
            yield Step(f"the controller begins to move the task to {to}", _say(begun, order))
        return
    ended = state._replace(move=None)
    if state.term != move.term:
        yield Step("the controller hears of a new term", ended)
    if move.order and move.order < state.newest and rules.holds("newest"):
        yield Step("the controller hears that its order was late", ended)
    # It can do without, as long as nobody has died who was to hand the state out or take it over.
    end = Message("order", number, "", term=move.term)
    given_up = _say(ended._replace(number=number), end)
    yield Step("the controller gives up", given_up, fault=not state.crashes)
    if state.hellos < limits.hellos:
        hello = Message("order", number, move.to if rules.holds("hello") else "", move.term)
        there = state._replace(number=number, hellos=state.hellos + 1)
        yield Step("the controller says that it is there", _say(there, hello))
    ready = any(
        one.kind == "ready" and (one.number == move.number or not rules.holds("number"))
        for one in state.said
    )
    if not move.order and (ready or not rules.holds("ready")):
        order = Message("order", number, move.to, term=move.term, moves=True)
        ordered = state._replace(move=move._replace(order=number), number=number)
        yield Step(f"the controller orders {move.to}", _say(ordered, order))


if __name__ == "__main__":
    report(initial(), [partial(successors, limits=limits) for limits in CASES], good, RULES)
