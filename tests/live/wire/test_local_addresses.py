"""Which addresses and ports are this computer's, and which of them are free."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dwell.cellfile import load
from dwell.dash.observer import Observer
from dwell.live.wire.local_addresses import is_here, running_elsewhere, taken_ports, why_not_listen
from tests.cells.light import QUOTAS, document, write_cell
from tests.cli.small_cell import call

#: For documentation (RFC 5737) and for names that are none (RFC 2606).
ELSEWHERE, NOWHERE = "192.0.2.7", "no.such.host.invalid"


@pytest.mark.parametrize("address", ["127.0.0.1", "localhost", "127.3.2.1"])
def test_loopback_is_here(address: str) -> None:
    assert is_here(address)
    assert why_not_listen(address, 0) == ""


def test_why_nobody_can_listen_somewhere_is_said() -> None:
    assert not is_here(ELSEWHERE)
    assert "is no address of this computer" in why_not_listen(ELSEWHERE, 7450)
    assert not is_here(NOWHERE)
    assert "cannot be resolved" in why_not_listen(NOWHERE, 7450)


def test_a_port_that_somebody_has_is_taken_and_by_whom() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert f"port {port} of 127.0.0.1 is taken" in why_not_listen("127.0.0.1", port)
        assert taken_ports([port]).endswith(f"(process {os.getpid()})")
    assert taken_ports([port]) == ""


def cell_at(folder: Path, port: int) -> Path:
    """Write a cell whose nodes have ports from this one on."""
    hosts = {node: {"address": "127.0.0.1", "port": port + 40 * i} for i, node in enumerate(QUOTAS)}
    live = document()["live"] | {"hosts": hosts}
    return write_cell(folder, name=f"cell-{os.getpid()}", live=live)


def test_a_cell_that_runs_here_with_other_addresses_is_named(tmp_path: Path) -> None:
    own, running = cell_at(tmp_path / "own", 31_000), cell_at(tmp_path / "out", 31_200)
    code = "import sys; print(flush=True); sys.stdin.read()"
    there = f"It runs here with other ports: name {running}."
    for file, told in ((running, there), (own, "")):
        command: list[str | Path] = [sys.executable, "-c", code, "controller", "--cell", file]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            assert running_elsewhere(load(own)) == told
            if told:
                assert told in call("live", "status", "--cell", own).stderr
                with Observer(load(own)) as observer:
                    assert told in observer.now().status["headline"]
            process.communicate()
