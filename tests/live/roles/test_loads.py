"""Loads of nodes and processes between two reports."""

from __future__ import annotations

import numpy as np

from dwell.live.roles.loads import NodeLoad, ProcessLoads
from dwell.live.wire.messages import Load


def load(at_ns: int, busy_ns: int, *, life: int = 1, accelerator: float = 0.0) -> Load:
    """Return a report of a node of whose work half is the cell's."""
    return Load(
        node="E",
        life=life,
        at_ns=at_ns,
        busy_ns=busy_ns,
        own_ns=busy_ns // 2,
        shadow_ns=0,
        accelerator=accelerator,
    )


def test_a_node_counts_in_proportion_between_two_reports() -> None:
    node = NodeLoad()
    assert node.at(50).tolist() == [0, 0, 0, 0, 0]
    for at_ns, busy_ns in ((100, 1_000), (200, 1_080), (300, 1_080)):
        node.report(load(at_ns, busy_ns, accelerator=0.5))
    used = node.at(250) - node.at(150)
    assert used.tolist() == [40.0, 20.0, 0.0, 50.0, 100.0]


def test_a_node_that_falls_silent_counts_as_idle() -> None:
    node = NodeLoad()
    for at_ns, busy_ns in ((100, 0), (200, 100)):
        node.report(load(at_ns, busy_ns))
    # It goes on for one more interval, and no longer.
    assert node.at(300)[0] - node.at(200)[0] == 100.0
    assert np.array_equal(node.at(10_000), node.at(300))


def test_an_agent_that_starts_again_counts_on() -> None:
    node = NodeLoad()
    for report in (load(100, 500), load(200, 600), load(300, 20, life=2), load(400, 70, life=2)):
        node.report(report)
    assert node.at(400)[0] - node.at(100)[0] == 150.0


def test_copies_and_late_reports_change_nothing() -> None:
    node = NodeLoad()
    for at_ns, busy_ns in ((100, 0), (200, 80), (200, 999), (150, 999)):
        node.report(load(at_ns, busy_ns))
    assert node.at(200)[0] - node.at(100)[0] == 80.0


def test_reports_that_are_not_needed_are_dropped() -> None:
    node, kept = NodeLoad(), NodeLoad()
    for one in (node, kept):
        for k in range(10):
            one.report(load(100 * k + 100, 10 * k))
    node.forget(750)
    assert np.array_equal(node.at(850) - node.at(750), kept.at(850) - kept.at(750))
    # Before what is left it is known for one interval only.
    assert node.at(0)[0] > kept.at(0)[0]


def test_processes_count_on_when_they_start_again() -> None:
    loads = ProcessLoads()
    for at_ns, cpu_ns in ((0, 500), (100, 600), (200, 50), (300, 150)):
        loads.report("E", at_ns, [("a", cpu_ns)])
    assert loads.between("E", 0, 300) == {"a": 250.0}
    assert loads.between("E", 50, 250) == {"a": 150.0}
    assert loads.between("R1", 0, 300) == {}
    # A clock that begins anew has nothing to do with what was before.
    loads.report("E", 10, [("a", 200)])
    loads.report("E", 20, [("a", 230)])
    assert loads.between("E", 10, 20) == {"a": 30.0}
