"""Services: what systemd gets at its socket, and logs that stay short."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.live.host.hosting import Hosted, take_turns
from dwell.live.host.service import Service
from tests.cli.small_cell import environment
from tests.live.memory_transport import Network

PATIENCE_S = 60.0


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    """A socket where systemd would listen."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(PATIENCE_S)
        yield listener


def test_reports_go_to_the_socket_that_the_environment_names(
    systemd: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": "1", "HOME": "/"}
    service = Service("agent@R1", given)
    # Processes that are started with it do not report.
    assert given == {"HOME": "/"}
    monkeypatch.setattr("dwell.live.host.service.STEP_S", 1e9)
    service.ready()
    service.step()
    service.step()
    service.stopping()
    reports = [systemd.recv(100) for _ in range(3)]
    assert reports == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_an_abstract_socket_is_found() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        name = f"dwell-test-{os.getpid()}"
        listener.bind(f"\0{name}")
        listener.settimeout(PATIENCE_S)
        Service("agent@R1", {"NOTIFY_SOCKET": f"@{name}"}).ready()
        assert listener.recv(100) == b"READY=1"


@pytest.mark.parametrize("given", [{}, {"NOTIFY_SOCKET": "/nowhere/notify"}])
def test_without_systemd_nothing_is_reported(given: dict[str, str]) -> None:
    service = Service("agent@R1", given)
    service.ready()
    service.step()


class Hanging:
    """A role whose second call does not return until it is let."""

    def __init__(self) -> None:
        self.calls, self.hangs, self.goes_on = 0, threading.Event(), threading.Event()

    def subscriptions(self) -> tuple[str, ...]:
        return ()

    def receive(self, sample: object, now_ns: int) -> None:
        raise AssertionError

    def wake(self, now_ns: int) -> int:
        self.calls += 1
        if self.calls == 2:
            self.hangs.set()
            self.goes_on.wait(PATIENCE_S)
        return now_ns


def test_a_loop_that_hangs_gives_no_sign_of_life(
    systemd: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dwell.live.host.service.STEP_S", 0.0)
    role, service = Hanging(), Service("agent@R1", {"NOTIFY_SOCKET": systemd.getsockname()})
    hosted = Hosted(role, Network().transport("agent@R1", "R1"))
    turns = threading.Thread(target=take_turns, args=([hosted], [service.step]), daemon=True)
    turns.start()
    assert role.hangs.wait(PATIENCE_S)
    assert [systemd.recv(100) for _ in range(2)] == [b"WATCHDOG=1"] * 2
    systemd.settimeout(0.3)
    with pytest.raises(TimeoutError):
        systemd.recv(100)
    role.goes_on.set()
    systemd.settimeout(PATIENCE_S)
    assert systemd.recv(100) == b"WATCHDOG=1"
    hosted.stop()
    turns.join(PATIENCE_S)


#: Prints more than its log may have, and looks after it.
PRINTS = """
import sys
from dwell.live.host.service import Service
service = Service(sys.argv[1], {}, log_bytes=1_000)
for number in range(200):
    print("line", number, file=sys.stderr, flush=True)
service.step()
print("the last line", file=sys.stderr, flush=True)
"""


@pytest.mark.parametrize(("name", "rotates"), [("agent@R1.log", True), ("mine.txt", False)])
def test_its_own_log_is_begun_again_where_it_is_too_long(
    tmp_path: Path, name: str, rotates: bool
) -> None:
    """A file that has another name is the user's."""
    path = tmp_path / name
    with path.open("ab") as log:
        words = [sys.executable, "-c", PRINTS, "agent@R1"]
        subprocess.run(words, stderr=log, check=True, env=environment())
    older = path.with_suffix(".log.1")
    assert older.exists() is rotates
    if rotates:
        assert path.read_text() == "the last line\n"
        assert older.read_text().startswith("line 0\n")
    else:
        assert len(path.read_text().splitlines()) == 201
