"""Inventories of real hosts; a shell of this computer stands where ssh would."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from dwell.errors import LiveError, ProblemError
from dwell.live.local.timeline import Change, NodeState, usual_conditions
from dwell.model import LinkDisturbance, Normal
from dwell_lab.testbed.inventory import Inventory, LinkCommands, RealHost, load_inventory
from dwell_lab.testbed.real_hosts import RealHosts, require_commands
from tests.cells.small import make_problem
from tests.waiting import wait_until

PROBLEM = make_problem()
SHELL = ("sh", "-c")
LINK = next(iter(PROBLEM.fabric.links.values()))


def inventory(folder: Path, **links: LinkCommands) -> Inventory:
    host = RealHost(SHELL, "127.0.0.1", python=sys.executable, folder=str(folder))
    hosts = {
        node: replace(host, port=21_450 + 100 * i) for i, node in enumerate(PROBLEM.fabric.nodes)
    }
    return Inventory(hosts, links)


def written(folder: Path, document: object) -> Path:
    file = folder / "hosts.yaml"
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    return file


def hosts() -> dict[str, Any]:
    return {node: {"run": "ssh host", "address": "10.0.0.1"} for node in PROBLEM.fabric.nodes}


# -------------------------------------------------------------------------------- the file


def test_an_inventory_is_read(tmp_path: Path) -> None:
    told = hosts()
    told["E"] |= {"run": ["ssh", "the edge"], "port": 8000, "cpus": "2-3", "folder": "/srv/dwell"}
    links = {LINK.name: {"begin": "on {mean_ms} {std_ms} {loss_percent}", "end": "off"}}
    found = load_inventory(
        written(tmp_path, {"dwell-inventory": 1, "hosts": told, "links": links}), PROBLEM
    )
    assert found.hosts["R1"].run == ("ssh", "host")
    edge = found.hosts["E"]
    assert (edge.run, edge.port, edge.cpus, edge.folder) == (
        ("ssh", "the edge"),
        8000,
        "2-3",
        "/srv/dwell",
    )
    assert found.links[LINK.name].end == "off"
    moved = replace(found, hosts={**found.hosts, "E": replace(edge, address="10.0.0.9")})
    assert moved.digest != found.digest


def test_every_fault_is_told_at_once(tmp_path: Path) -> None:
    told = hosts()
    del told["R2"]
    told["E"] = {"run": "ssh 'edge", "port": 0, "cpus": "all", "folder": "dwell", "colour": "red"}
    told["R9"] = {"run": "ssh r9", "address": "r9"}
    links = {"R1->R9": {"begin": "on {jitter}", "end": ""}}
    with pytest.raises(ProblemError) as caught:
        load_inventory(
            written(tmp_path, {"dwell-inventory": 1, "hosts": told, "links": links}), PROBLEM
        )
    paths = {fault.path for fault in caught.value.faults}
    assert paths == {
        "hosts.R2",
        "hosts.R9",
        *(f"hosts.E.{key}" for key in ("run", "port", "cpus", "folder", "colour", "address")),
        "links.R1->R9",
        "links.R1->R9.begin",
        "links.R1->R9.end",
    }


@pytest.mark.parametrize("document", [None, [], {"hosts": {}}, {"dwell-inventory": 2}])
def test_what_is_no_inventory_is_refused(tmp_path: Path, document: object) -> None:
    with pytest.raises(ProblemError, match="dwell-inventory"):
        load_inventory(written(tmp_path, document), PROBLEM)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match="no such file"):
        load_inventory(tmp_path / "none.yaml", PROBLEM)


# --------------------------------------------------------------------- commands over there


# ------------------------------------------------------------------------------- the hosts


def test_paths_and_interpreter_become_those_over_there(tmp_path: Path) -> None:
    over_there = inventory(tmp_path / "far")
    cell = RealHosts(PROBLEM, over_there, tmp_path / "here", name="one")
    words = cell.inside("E", [sys.executable, "-m", "dwell", str(tmp_path / "here" / "cell.yaml")])
    assert f"{tmp_path}/far/dwell-one-E/cell.yaml" in words[-1]
    assert str(tmp_path / "here") not in words[-1]
    assert cell.problem.live.hosts["R2"].port != cell.problem.live.hosts["R1"].port


def test_files_go_there_and_runs_come_back(tmp_path: Path) -> None:
    cell = RealHosts(PROBLEM, inventory(tmp_path / "far"), tmp_path / "here", name="one")
    cell.folder.mkdir()
    there = tmp_path / "far" / f"dwell-one-{PROBLEM.controller_node}"
    cell.shell("E", f"mkdir -p {there}/runs/7 && cat > {there}/runs/7/run.json", b"{}")
    cell.fetch_runs()
    assert (tmp_path / "here" / "runs" / "7" / "run.json").read_bytes() == b"{}"


def test_a_line_that_fails_is_an_error_with_its_reason(tmp_path: Path) -> None:
    cell = RealHosts(PROBLEM, inventory(tmp_path), tmp_path, name="one")
    with pytest.raises(LiveError, match=r"E: .* ended with code 4 \(no such thing\)"):
        cell.shell("E", "echo no such thing >&2; exit 4")


def test_a_name_that_would_be_a_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LiveError, match=r"name is '\.\./other'"):
        RealHosts(PROBLEM, inventory(tmp_path), tmp_path, name="../other")


def test_disturbances_are_played_by_the_inventorys_commands(tmp_path: Path) -> None:
    log = tmp_path / "log"
    commands = LinkCommands(
        f"echo on {{mean_ms}} {{std_ms}} {{loss_percent}} >> {log}", f"echo off >> {log}"
    )
    cell = RealHosts(PROBLEM, inventory(tmp_path, **{LINK.name: commands}), tmp_path, name="one")
    usual = usual_conditions(LINK)
    delays = Normal(25.0, 5.0), Normal(100.0, 12.0)
    for shares, loss in (((1.0, 0.0), 0.02), ((1.0, 1.0), 0.5), ((0.0, 0.5), 0.0), ((0, 0), 0.0)):
        now = replace(
            usual, add_delays_ms=delays, shares=shares, loss=1 - (1 - usual.loss) * (1 - loss)
        )
        cell.apply(Change(0, LINK.name, now))
    cell.apply(Change(1, LINK.name, usual))
    told = ["on 25.0 5.0 2.0", "on 125.0 13.0 50.0", "on 50.0 6.0 0.0", "off"]
    assert log.read_text().splitlines() == told


def test_stress_runs_until_it_ends(tmp_path: Path) -> None:
    threads = tmp_path / "threads"
    over_there = inventory(tmp_path)
    line = f"echo {{threads}} > {threads}; sleep 1000"
    over_there = replace(
        over_there,
        hosts={name: replace(host, stress=line) for name, host in over_there.hosts.items()},
    )
    cell = RealHosts(PROBLEM, over_there, tmp_path, name="one")
    Path(cell.there("E")).mkdir(parents=True)
    cell.apply(Change(0, "E", NodeState(3)))
    wait_until(lambda: threads.is_file() and threads.read_text() == "3\n")
    process = next(iter(cell.stress.values()))
    cell.apply(Change(1, "E", NodeState(0)))
    assert process.poll() is not None


def test_links_without_commands_are_refused(tmp_path: Path) -> None:
    scenario = PROBLEM.scenario("network-impairment")
    with pytest.raises(LiveError, match="no commands that disturb"):
        require_commands(inventory(tmp_path), scenario)
    links = {
        item.link: LinkCommands("true", "true")
        for item in scenario
        if isinstance(item, LinkDisturbance)
    }
    require_commands(inventory(tmp_path, **links), scenario)
