"""`dwell live units`: what systemd is given, and what it says to that."""

from __future__ import annotations

import re
import shlex
import shutil
import socket
import subprocess
from pathlib import Path

import pytest

import dwell
from dwell.live.commands.units import escaped_name, unit_texts, verify
from dwell.live.wire.wiring import wire
from tests.cli.live_cell import RealCell
from tests.cli.small_cell import ROOT, SMALL, assert_refused, call
from tests.waiting import PATIENCE_S

CELL = ROOT / "examples" / "live" / "cell.yaml"
PROBLEM = dwell.load(CELL)
HAS_SYSTEMD = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)
#: Names of the units, which systemd writes with escapes.
CONTROLLER_UNIT = "dwell-controller@light\\x2dfollower.service"


def agent_unit(node: str) -> str:
    return f"dwell-agent@light\\x2dfollower-{node}.service"


def values(text: str, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", text, re.MULTILINE)


def test_a_node_has_an_agent_and_where_it_decides_a_controller(tmp_path: Path) -> None:
    for node, names in {
        "R1": [agent_unit("R1")],
        "E": [agent_unit("E"), CONTROLLER_UNIT],
    }.items():
        out = tmp_path / node
        done = call("live", "units", CELL, "--node", node, "--out", out, "--user", "robot")
        assert done.exit_code == 0
        assert sorted(path.name for path in out.iterdir()) == names
        enabled = done.stdout.splitlines()[-1]
        stems = [name.removesuffix(".service") for name in names]
        assert shlex.split(enabled) == ["sudo", "systemctl", "enable", "--now", *stems]
        for name in names:
            text = (out / name).read_text()
            assert values(text, "User") == ["robot"]
            assert values(text, "Restart") == ["always"]
            (most,) = values(text, "LimitNOFILE")
            assert int(most) > 1_024
            assert str(CELL) in values(text, "ExecStart")[0]


@HAS_SYSTEMD
def test_systemd_takes_units_whose_paths_have_odd_signs(tmp_path: Path) -> None:
    folder = tmp_path / 'a "b" $c %d \\e'
    shutil.copytree(CELL.parent, folder)
    keys = tmp_path / "my keys"
    words = ("--node", "E", "--out", tmp_path / "units", "--keys", keys)
    done = call("live", "units", folder / "cell.yaml", *words)
    assert (done.exit_code, done.stderr) == (0, "")
    agent = tmp_path / "units" / agent_unit("E")
    text = agent.read_text()
    assert values(text, "Environment") == [f'"DWELL_KEYS={keys}"']
    quoted = str(folder / "cell.yaml").replace("\\", "\\\\").replace('"', '\\"')
    quoted = quoted.replace("$", "$$").replace("%", "%%")
    assert f' --cell "{quoted}" ' in text
    # It does look at them.
    agent.write_text(text.replace(f'"{quoted}"', f'"{quoted}'))
    assert verify([agent])


def test_units_of_several_cells_and_nodes_have_names_of_their_own(tmp_path: Path) -> None:
    file, names = tmp_path / "cell.yaml", list[str]()
    for cell, node in (("a", "b-c"), ("a-b", "c"), ("a", "b.c"), ("a", "b c"), ("c", "E")):
        renamed = SMALL.replace("name: small", f"name: {cell}")
        file.write_text(re.sub(r"\bR\b", node if node != "E" else "R", renamed))
        names += unit_texts(dwell.load(file), node, file, user="robot")
    assert len(names) == len(set(names)) == 5 + 1
    assert names[-2:] == ["dwell-agent@c-E.service", "dwell-controller@c.service"]


@pytest.mark.skipif(shutil.which("systemd-escape") is None, reason="systemd is not installed")
@pytest.mark.parametrize("name", ["plain", "a-b", ".hidden", "a b", "zwölf:1+2", "x_y.z"])
def test_names_are_escaped_as_by_systemd(name: str) -> None:
    done = subprocess.run(
        ["systemd-escape", "--", name], capture_output=True, text=True, check=True
    )
    assert escaped_name(name) == done.stdout.strip()


def test_an_unknown_node_is_refused(tmp_path: Path) -> None:
    refused = call("live", "units", CELL, "--node", "R9", "--out", tmp_path / "units")
    assert_refused(refused, "no node 'R9' in cell 'light-follower'; there are R1, E, R2")
    assert not (tmp_path / "units").exists()


def test_agents_and_controllers_report_to_systemd(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", systemd.getsockname())
        cell = RealCell(tmp_path)
        try:
            for who, name in (("agent@R1", "agent-R1"), ("controller@E", "controller")):
                if name == "controller":
                    cell.controller()
                else:
                    cell.agent("R1")
                assert systemd.recv(100) == b"READY=1"
                end = wire(cell.problem).entry(who).listen["control"]
                socket.create_connection((end.address, end.port), PATIENCE_S).close()
                assert systemd.recv(100) == b"WATCHDOG=1"
                assert cell.end(name) == 0
                while (report := systemd.recv(100)) == b"WATCHDOG=1":
                    pass
                assert report == b"STOPPING=1"
        finally:
            cell.close()
