"""A cell on this machine without root: it comes up, is disturbed, and leaves nothing."""

from __future__ import annotations

import socket
from pathlib import Path

import psutil
import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.local import loopback
from dwell.live.local.loopback import Loopback, on_this_machine
from dwell.live.local.timeline import Change, timeline_of
from tests.cells.light import write_cell
from tests.waiting import PATIENCE_S, wait_until


def test_every_process_has_ports_of_its_own_that_are_free(tmp_path: Path) -> None:
    problem = dwell.load(write_cell(tmp_path))
    hosts = on_this_machine(problem).live.hosts
    assert hosts.keys() == problem.fabric.nodes.keys()
    taken = min(host.port for host in hosts.values())
    with socket.socket() as held:
        held.bind(("127.0.0.1", taken))
        others = on_this_machine(problem).live.hosts
    assert taken not in {host.port for host in others.values()}
    assert len({host.port for host in others.values()}) == len(hosts)


def test_no_free_ports_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loopback, "PORTS", range(0))
    with pytest.raises(LiveError, match="free ports in a row"):
        on_this_machine(dwell.load(write_cell(tmp_path)))


def test_it_comes_up_is_disturbed_and_leaves_nothing(tmp_path: Path) -> None:
    problem = on_this_machine(dwell.load(write_cell(tmp_path / "cell")))
    cell = Loopback(problem, tmp_path / "there", {})
    # A worker of the tests may have children of earlier tests, such as a pool's resource tracker.
    before = psutil.Process().children(recursive=True)
    with cell:
        wait_until(lambda: bool(cell.sample(10.0)["window"]) and not cell.sample(10.0)["silent"])
        assert cell.sample(10.0)["placement"] == "SO"
        changes = timeline_of(problem, "impaired", seed=1, seconds=60).changes
        links: list[Change] = [one for one in changes if one.place in problem.fabric.links]
        assert links
        for change in links:
            cell.apply(change)
        children = [
            child for child in psutil.Process().children(recursive=True) if child not in before
        ]
        assert len(children) > len(problem.pipeline.tasks)
    _, alive = psutil.wait_procs(children, timeout=PATIENCE_S)
    assert alive == []
    (run,) = (tmp_path / "there" / "runs").iterdir()
    assert dwell.open_run(run).cycles.height > 0
