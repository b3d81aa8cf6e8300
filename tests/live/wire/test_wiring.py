"""Who is there, where they listen, and whether everybody who has to can be heard."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations, product
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import dwell
from dwell.errors import LiveError
from dwell.live.wire.wiring import (
    IMAGE_BYTES,
    Locator,
    Role,
    Wiring,
    WiringEntry,
    roles,
    session_of,
    wire,
)
from dwell.model import (
    Constant,
    ControllerSettings,
    Endpoint,
    Execution,
    Flow,
    Host,
    Link,
    LiveSettings,
    Node,
    Placement,
    Problem,
    Replicas,
    Task,
)
from tests.cells.generated import make_problem, random_problem
from tests.live.memory_transport import connected, hears

NODES = [Node("R1", "robot", 2), Node("E", "edge", 4), Node("R2", "robot", 2)]
FLOWS = [
    Flow("sensing", "perception", 900_000),
    Flow("perception", "planning", 400),
    Flow("planning", "control", 100),
]


def cell(**controller: Any) -> Problem:
    """R1 senses, R1 or E perceives, R2 or E plans, R2 controls; the first flow is of images."""

    def task(name: str, *nodes: str, state_bytes: int = 0) -> Task:
        on = {node: Execution(Constant(1.0)) for node in nodes}
        return Task(name, on, state_bytes=state_bytes)

    return make_problem(
        NODES,
        [
            task("sensing", "R1"),
            task("perception", "R1", "E", state_bytes=IMAGE_BYTES),
            task("planning", "R2", "E"),
            task("control", "R2"),
        ],
        FLOWS,
        links=[Link(one.name, other.name, Constant(1.0)) for one, other in permutations(NODES, 2)],
        candidates={"LOC": {}, "HYB": {"perception": "E"}},
        controller=ControllerSettings(**controller),
    )


def housed(problem: Problem, hosts: Mapping[str, Host] | None = None, **live: Any) -> Problem:
    """The cell on loopback, a thousand ports a node."""
    if hosts is None:
        nodes = enumerate(problem.fabric.nodes)
        hosts = {node: Host("127.0.0.1", 10_000 + 1_000 * i) for i, node in nodes}
    return replace(problem, live=LiveSettings(hosts=hosts, **live))


@pytest.fixture
def problem() -> Problem:
    return housed(cell(fallbacks=("LOC",)))


@pytest.fixture
def wiring(problem: Problem) -> Wiring:
    return wire(problem)


def test_everybody_is_there(problem: Problem) -> None:
    assert [role.who for role in roles(problem)] == [
        "stamper@R1",
        "sink.control@R2",
        "agent@R1",
        "agent@E",
        "agent@R2",
        "sensing@R1",
        "perception@R1",
        "perception@R1.shadow",
        "perception@E",
        "perception@E.shadow",
        # Behind the task that moves; where no candidate puts it there is nothing to measure.
        "planning@R2",
        "planning@R2.shadow",
        "planning@E",
        # A shadow stops before the sink.
        "control@R2",
        "controller@E",
    ]
    assert Role("perception@E.shadow", "E", "shadow", "perception") in roles(problem)
    assert Role("stamper@R1", "R1", "stamper") in roles(problem)


@pytest.mark.parametrize(
    ("controller", "shadows"),
    [
        ({}, 0),
        ({"fallbacks": ("LOC",)}, 3),
        ({"estimator": "shadow"}, 3),
        ({"estimator": "corrected"}, 3),
    ],
)
def test_shadow_workers_are_there_where_something_asks_for_them(
    controller: dict[str, Any], shadows: int
) -> None:
    found = [role for role in roles(cell(**controller)) if role.kind == "shadow"]
    assert len(found) == shadows


def test_ports_go_by_the_order_on_the_node(problem: Problem, wiring: Wiring) -> None:
    ports = {
        who: {name: end.port for name, end in entry.listen.items()}
        for who, entry in wiring.entries.items()
    }
    assert ports["stamper@R1"] == {"control": 10_000}
    assert ports["agent@R1"] == {"control": 10_003}
    # Only downstream workers connect to it, on this node and on another.
    assert ports["sensing@R1"] == {"images": 10_007, "local": 10_008}
    assert ports["agent@E"] == {"control": 11_000}
    # Nobody of the cell connects to it, but visitors may.
    assert ports["controller@E"] == {"control": 11_012}
    assert wire(problem) == wiring


def test_images_that_stay_on_a_node_have_a_session_of_their_own(wiring: Wiring) -> None:
    assert connected(wiring, "sensing@R1", "perception@R1") == {"local"}
    assert connected(wiring, "sensing@R1", "perception@R1.shadow") == {"local"}
    assert connected(wiring, "sensing@R1", "perception@E") == {"images"}
    assert connected(wiring, "perception@E", "planning@E") == {"control"}
    # A state as large as an image travels as one.
    assert connected(wiring, "perception@E", "perception@R1") == {"images"}
    assert connected(wiring, "planning@E", "planning@R2") == {"control"}
    assert connected(wiring, "perception@R1", "perception@R1.shadow") == frozenset()


def test_what_has_to_be_heard_can_be(problem: Problem, wiring: Wiring) -> None:
    everybody = roles(problem)
    stamper, controller = "stamper@R1", "controller@E"

    def both_ways(one: str, other: str) -> bool:
        key = "dwell/test/beat/R1/x"
        return hears(wiring, one, other, "control", key) and hears(
            wiring, other, one, "control", key
        )

    for role in everybody:
        if role.who != stamper:
            assert both_ways(role.who, stamper)
        if role.node != "E":
            assert both_ways(role.who, "agent@E")  # the relay
        if role.who != f"agent@{role.node}":
            assert both_ways(role.who, f"agent@{role.node}") or role.kind == "controller"
        if role.kind in ("stamper", "sink", "agent"):
            assert both_ways(role.who, controller)
        if role.kind == "worker" and role.task != "sensing":
            # It reports a shadow that stopped, or that a state has arrived.
            assert both_ways(role.who, controller)
    assert both_ways("control@R2", "sink.control@R2")
    assert not both_ways("sensing@R1", "sink.control@R2")
    for flow in FLOWS:
        senders = [role for role in everybody if role.works and role.task == flow.source]
        receivers = [role for role in everybody if role.works and role.task == flow.target]
        lane = "images" if flow.payload_bytes >= IMAGE_BYTES else "control"
        for sender, receiver in product(senders, receivers):
            key = f"dwell/test/in/{flow.target}/{receiver.node}/main"
            assert hears(wiring, sender.who, receiver.who, lane, key)  # type: ignore[arg-type]


def test_a_session_follows_from_lane_and_node() -> None:
    end = Locator("127.0.0.1", 1)
    entry = WiringEntry(Role("a@E", "E", "worker"), {"local": end}, {"images": (end,)})
    assert session_of(entry, "images", "dwell/c/in/task/E/main") == "local"
    assert session_of(entry, "images", "dwell/c/in/task/R1/main") == "images"
    assert session_of(entry, "images", "dwell/c/state/task/R1") == "images"
    assert session_of(entry, "control", "dwell/c/in/task/E/main") == "control"
    alone = WiringEntry(Role("a@E", "E", "worker"), {}, {"control": (end,)})
    assert session_of(alone, "images", "dwell/c/in/task/R1/main") == "control"
    assert entry.sessions == ("images", "local")


def test_a_node_may_be_seen_elsewhere(problem: Problem) -> None:
    hosts = dict(problem.live.hosts)
    hosts["R1"] = Host("127.0.0.1", 10_000, {"E": Endpoint("127.0.0.2", 20_000)})
    direct, wiring = wire(problem), wire(housed(problem, hosts))
    node = {role.who: role.node for role in roles(problem)}
    at_r1 = [end for who in node if node[who] == "R1" for end in wiring.entry(who).listen.values()]
    seen_by_e = {end: Locator("127.0.0.2", end.port + 10_000) for end in at_r1}
    assert Locator("127.0.0.1", 10_000) in seen_by_e
    for who, entry in wiring.entries.items():
        assert entry.listen == direct.entry(who).listen
        for session, ends in direct.entry(who).connect.items():
            moved = tuple(seen_by_e.get(end, end) for end in ends)
            assert entry.connect[session] == (moved if node[who] == "E" else ends)


def test_the_relay_is_heard_by_all_other_nodes(problem: Problem) -> None:
    wiring = wire(housed(problem, relay="R2"))
    assert connected(wiring, "sensing@R1", "agent@R2") == {"control"}
    assert connected(wiring, "sensing@R1", "agent@E") == frozenset()


def test_a_standby_hears_what_it_stands_by_for(problem: Problem) -> None:
    control = problem.pipeline.tasks["control"]
    on = {"R2": replace(control.on["R2"], standby=1)}
    tasks = {**problem.pipeline.tasks, "control": replace(control, on=on)}
    problem = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
    assert Role("control@R2.1", "R2", "standby", "control", 1) in roles(problem)
    wiring = wire(problem)
    for other in ("planning@E", "planning@R2.shadow", "sink.control@R2", "stamper@R1"):
        assert connected(wiring, "control@R2.1", other) == {"control"}


def test_a_visitor_talks_to_one_process(wiring: Wiring) -> None:
    entry = wiring.visitor("status", "controller@E")
    assert entry.listen == {}
    assert entry.connect == {"control": (Locator("127.0.0.1", 11_012),)}
    with pytest.raises(LiveError, match=r"no process 'nobody'; there are stamper@R1"):
        wiring.visitor("status", "nobody")


def test_everything_that_is_wrong_is_said_at_once(problem: Problem) -> None:
    hosts = {"R1": Host("a", 65_000), "E": Host("b", 2_000, {"R1": Endpoint("c", 65_000)})}
    many = {f"t{i}": Task(f"t{i}", {"E": Execution(Constant(1.0))}) for i in range(180)}
    tasks = {**problem.pipeline.tasks, **many}
    candidates = {
        name: Placement({**placement, **dict.fromkeys(many, "E")})
        for name, placement in problem.candidates.items()
    }
    large = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks), candidates=candidates)
    with pytest.raises(LiveError) as caught:
        wire(housed(large, hosts))
    said = str(caught.value)
    assert "live.hosts.R2: missing" in said
    assert "live.hosts.E.seen_from.R1.port: 65000 is above" in said
    assert "live.hosts.R1.port" not in said


@pytest.mark.parametrize(
    ("e_port", "seen"), [(10_006, {}), (11_000, {"R1": Endpoint("127.0.0.1", 12_000)})]
)
def test_two_on_one_port_are_named(
    problem: Problem, e_port: int, seen: dict[str, Endpoint]
) -> None:
    hosts = {**problem.live.hosts, "E": Host("127.0.0.1", e_port, seen)}
    with pytest.raises(LiveError, match=r"are both at tcp/127\.0\.0\.1:1\d+"):
        wire(housed(problem, hosts))


@pytest.mark.parametrize(
    ("address", "text"), [("10.0.0.1", "tcp/10.0.0.1:7"), ("fe80::1", "tcp/[fe80::1]:7")]
)
def test_an_endpoint_reads_as_a_locator(address: str, text: str) -> None:
    assert str(Locator(address, 7)) == text


@given(st.integers(0, 2**32))
def test_any_cell_is_wired_without_clashes(seed: int) -> None:
    problem = random_problem(Random(seed))
    everybody = roles(problem)
    names = [role.who for role in everybody]
    assert len(set(names)) == len(names)
    wiring = wire(housed(problem))
    rank = {who: i for i, who in enumerate(names)}
    pairs = [(wire.session, wire.source, wire.target) for wire in wiring.wires]
    assert len({(session, frozenset(pair)) for session, *pair in pairs}) == len(pairs)
    listening = [end for entry in wiring.entries.values() for end in entry.listen.values()]
    assert len(set(listening)) == len(listening)
    for session, source, target in pairs:
        # Who comes later connects, so that nobody waits for two to find each other.
        assert rank[source] > rank[target]
        assert wiring.entry(target).listen[session] in wiring.entry(source).connect[session]


@pytest.mark.parametrize(("after_ms", "state_bytes"), [(10.0, 0), (0.0, 9), (10.0, 9)])
def test_states_of_a_later_second_copy_are_refused(after_ms: float, state_bytes: int) -> None:
    problem = dwell.load("examples/live/cell.yaml")
    tasks = dict(problem.pipeline.tasks)
    tasks["planning"] = replace(tasks["planning"], state_bytes=state_bytes)
    members = {name: problem.candidates[name] for name in ("LOC", "SO")}
    candidates = {**problem.candidates, "BOTH": Replicas(members, after_ms)}
    pipeline = replace(problem.pipeline, tasks=tasks)
    problem = replace(problem, pipeline=pipeline, candidates=candidates)
    if after_ms and state_bytes:
        with pytest.raises(
            LiveError, match=r"candidates.BOTH.after_ms: 10 .*R2 and E.*set it to 0"
        ):
            wire(problem)
        return
    # Workers of both copies get the completions of the sink.
    connected = {frozenset((one.source, one.target)) for one in wire(problem).wires}
    for who in ("camera@R1", "perception@E", "planning@E"):
        assert frozenset((who, "sink.control@R2")) in connected


def test_a_weighed_price_is_refused_but_not_prices_alone() -> None:
    problem = dwell.load("examples/live/cell.yaml")
    links = {name: replace(one, price_per_gb=0.5) for name, one in problem.fabric.links.items()}
    problem = replace(problem, fabric=replace(problem.fabric, links=links))
    assert wire(problem).wires
    objective = replace(
        problem.objective,
        weights=replace(problem.objective.weights, price=1.0),
        targets=replace(problem.objective.targets, price_per_hour=1.0),
    )
    with pytest.raises(LiveError, match=r"objective\.weights\.price: not supported"):
        wire(replace(problem, objective=objective))
