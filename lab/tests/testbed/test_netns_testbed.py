"""The testbed as a whole: what it refuses, and that it harms nodes and links as a scenario says."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import LiveError
from dwell.live.local.processes import expected
from dwell.live.local.timeline import Change, NodeState, usual_conditions
from dwell.model import Constant
from dwell_lab.testbed.hosts import namespace_name, namespace_path
from dwell_lab.testbed.netns_testbed import NetnsTestbed
from lab.tests.testbed.machine import no_groups, no_hosts, own_name
from tests.cells.light import document, write_cell
from tests.waiting import wait_until


@pytest.fixture(scope="module")
def testbed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NetnsTestbed]:
    """One that runs."""
    if why := no_hosts() or no_groups():
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("testbed")
    cell = write_cell(folder)
    with NetnsTestbed(dwell.load(cell), folder / "out", name=own_name()) as one:
        yield one


def test_what_a_testbed_does_not_have_is_refused(tmp_path: Path) -> None:
    nodes = document()["nodes"]
    nodes["E"]["bursts"] = {"every_ms": 100, "for_ms": 10, "threads": 1}
    links = [dict(link) for link in document()["links"]]
    links[0]["bursts"] = {"every_ms": 100, "for_ms": 10, "add_delay_ms": 5}
    problem = from_document(document(nodes=nodes, links=links))
    with pytest.raises(LiveError, match=r"nodes\.E\.bursts.*links R1->E: bursts"):
        NetnsTestbed(problem, tmp_path / "out", name="refused")
    assert not (tmp_path / "out").exists()


def test_a_run_begins_anew_with_everybody_there(testbed: NetnsTestbed) -> None:
    watcher = testbed.watcher
    begun_ns = time.monotonic_ns()
    before = {testbed.begin()}
    # Nothing of the time until everybody was there is part of it.
    assert min(before) > begun_ns
    status = watcher.status(10.0)
    assert status["placement"] == "SO"
    assert status["origin_ns"] in before
    assert set(expected(testbed.problem)) <= status["processes"].keys()
    testbed.processes.stop_controller()
    # Another one is another run.
    again = testbed.begin()
    assert again not in before
    assert watcher.status(10.0)["run"] != status["run"]


def test_stress_is_in_the_group_of_its_node(testbed: NetnsTestbed) -> None:
    testbed.apply(Change(0, "R2", NodeState(2)))
    begun_ns = testbed.used_ns["R2"]()
    # Far less than its quota, far more than its stages take.
    wait_until(
        lambda: testbed.used_ns["R2"]() - begun_ns > 500_000_000, "half a second of CPU time"
    )
    testbed.apply(Change(1, "R2", NodeState(0)))


def test_a_link_that_is_down_lets_nothing_through(testbed: NetnsTestbed) -> None:
    link = testbed.links[frozenset(("R1", "R2"))]
    usual = usual_conditions(testbed.problem.fabric.links["R1->R2"])
    testbed.apply(Change(0, "R1->R2", replace(usual, down=True, loss=0.5)))
    wait_until(lambda: link.read()["R1", "R2"].vanished > 0, "packets that vanish")
    testbed.apply(Change(1, "R1->R2", usual))
    link.read()
    wait_until(lambda: link.read()["R1", "R2"].packets > 0, "packets that arrive")


def test_delays_at_once_add_up_each_at_its_strength(testbed: NetnsTestbed) -> None:
    link = testbed.links[frozenset(("R1", "R2"))]
    usual = usual_conditions(testbed.problem.fabric.links["R1->R2"])
    own_ms, delays = usual.delay_ms.expectation, (Constant(4.0), Constant(9.0))
    for shares in ((1.0, 1.0), (1.0, 1 / 3), (0.0, 0.0)):
        now = replace(usual, add_delays_ms=delays, shares=shares)
        testbed.apply(Change(0, "R1->R2", now))
        # What began before has the delay of before.
        link.read()
        wait_until(lambda: link.read(reset=False)["R1", "R2"].bursts >= 5, "messages")
        added_ms = 4.0 * shares[0] + 9.0 * shares[1]
        assert link.read()["R1", "R2"].delay_mean_ms == pytest.approx(own_ms + added_ms, abs=1e-3)
    testbed.apply(Change(1, "R1->R2", usual))


def test_a_node_that_was_down_comes_back(testbed: NetnsTestbed) -> None:
    watcher = testbed.watcher
    if "controller@E" not in testbed.processes.running:
        testbed.begin()
    there = set(testbed.switches["R2"]())
    testbed.apply(Change(0, "R2", NodeState(0, down=True)))
    assert not testbed.switches["R2"]()
    testbed.apply(Change(1, "R2", NodeState(0)))

    def ready() -> bool:
        heard = watcher.status(10.0)["processes"]
        names = [who for who in expected(testbed.problem) if "@R2" in who]
        return all(who in heard and heard[who]["age_ms"] < 1_000 for who in names)

    wait_until(ready, "the processes of R2")
    assert not there & set(testbed.switches["R2"]())


def test_nothing_is_left(testbed: NetnsTestbed) -> None:
    """The last: it takes the testbed down."""
    namespaces = [namespace_path(namespace_name(testbed.name, node)) for node in testbed.nodes]
    assert all(path.exists() for path in namespaces)
    testbed.stop()
    assert not any(path.exists() for path in namespaces)
