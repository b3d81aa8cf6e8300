"""A run on the hosts of an inventory: three of them, all of them this computer."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import yaml

import dwell
from dwell.kernels.random_draws import Drawing
from dwell_lab.testbed.inventory import load_inventory
from dwell_lab.testbed.real_hosts import run_on_hosts
from tests.cells.light import write_cell

WIND = {"name": "wind", "every_s": 1, "for_s": 1}
SCENARIO = [
    {"link": "R1->E", "add_delay_ms": 5, "for_s": 6, "episodes": WIND},
    {"link": "R1->E", "add_delay_ms": 7, "at_s": 2, "for_s": 2.5},
    {"node": "R2", "stress_threads": 2, "at_s": 0.5, "for_s": 5, "ramp_s": 2},
]
#: Some more than the scenario takes: changes may be late where the machine is busy.
SECONDS, FIRST_PORT = 11.0, 24_000


def test_a_scenario_is_played_by_the_commands_of_an_inventory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_cell(tmp_path / "cell", scenarios={"some": SCENARIO})
    problem = dwell.load(file)
    links, stress = tmp_path / "links", tmp_path / "stress"
    hosts = {
        node: {
            "run": ["sh", "-c"],
            "address": "127.0.0.1",
            "port": FIRST_PORT + 100 * i,
            "folder": str(tmp_path / "far"),
            "python": sys.executable,
            "stress": f"echo {{threads}} >> {stress}; sleep 1000",
        }
        for i, node in enumerate(problem.fabric.nodes)
    }
    commands = {"begin": f"echo {{mean_ms}} >> {links}", "end": f"echo off >> {links}"}
    inventory = tmp_path / "hosts.yaml"
    written = {"dwell-inventory": 1, "hosts": hosts, "links": {"R1->E": commands}}
    inventory.write_text(yaml.safe_dump(written))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(file.parent), *sys.path]))
    folder = run_on_hosts(
        load_inventory(inventory, problem),
        problem,
        scenario="some",
        policy="SO",
        seconds=SECONDS,
        seed=1,
        out=tmp_path / "out",
        name="one",
    )
    told = ["5.0", "7.0", "12.0", "7.0", "off", "5.0", "off"]
    assert links.read_text().split() == told
    assert stress.read_text().split() == ["1", "2", "1"]
    drawn = Drawing(problem, "some", seed=1, windows=12).episodes()
    expected = [item for item in drawn if item.at_s < SECONDS]
    played = dwell.open_run(folder).played or ()
    assert [item.place for item in played] == [item.place for item in expected]
    assert all(item.episodes is None for item in played)
