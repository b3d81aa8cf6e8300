"""A live cell with keys, from the command line: real processes, and who may do what with them."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import pytest

import dwell
from dwell.live.host.security import INSECURE, Security, environment
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import Order, Stamped, encode
from dwell.live.wire.wiring import Role, wire
from tests.cli.live_cell import EXAMPLE, RealCell, in_window, invoke
from tests.dash.served import serving, until_state
from tests.live.host.test_security import Intruder, tls
from tests.waiting import PATIENCE_S, wait_until

PIN = ("live", "pin", "SO")


class SecureCell(RealCell):
    """The example's cell; each command has the keyring of its own subject alone."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.keys = folder / "keys"
        code, told, error = invoke("keys", "init", self.file, "--out", self.keys)
        assert code == 0, error
        assert "dwell keys" not in error
        assert "ca here" in told
        code, _, error = invoke("keys", "issue", self.keys, "watcher", "--role", "observer")
        assert code == 0, error
        # As on hosts of their own.
        self.host = folder / "hosts"
        for name in ("R1", "E", "R2", "controller", "operator", "watcher"):
            shutil.copytree(self.keys / name, self.host / name)
        self.environment = environment(self.host / "operator", insecure=False)

    def agent(self, node: str, *more: str, cell: Path | None = None) -> None:
        super().agent(node, "--keys", str(self.host / node), *more, cell=cell)

    def controller(self, *more: str) -> None:
        super().controller("--keys", str(self.host / "controller"), *more)

    def as_(self, name: str, *words: str) -> tuple[int, str]:
        code, stdout, stderr = invoke(*words, "--cell", self.file, "--keys", self.host / name)
        return code, stdout + stderr

    def pid(self, who: str) -> int:
        mark = self.state(who.rpartition("@")[2].partition(".")[0]) / f"{who}.pid"
        return int(json.loads(mark.read_text())["pid"])

    @property
    def logs(self) -> str:
        found = [*self.folder.glob("*.log"), *self.folder.glob("state/*/*.log")]
        return "\n".join(path.read_text() for path in found)


# ------------------------------------------------------------------------ before the start


@pytest.fixture(scope="module")
def abroad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example's cell, with E on another computer."""
    folder = tmp_path_factory.mktemp("abroad")
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
    file = folder / "cell.yaml"
    text = file.read_text()
    assert "E: {address: 127.0.0.1" in text
    file.write_text(text.replace("E: {address: 127.0.0.1", "E: {address: 10.255.0.9"))
    code, _, error = invoke("keys", "init", file, "--out", folder / "keys", "--days", "20")
    assert code == 0, error
    return file


BEYOND = "live.hosts.E.address: 10.255.0.9 is beyond this computer, and without keys"


@pytest.mark.parametrize(
    "words",
    [
        ("agent", "--node", "R1", "--cell"),
        ("controller", "--cell"),
        ("live", "status", "--cell"),
        ("check", "--node", "R1"),
    ],
)
def test_without_keys_nothing_starts_that_leaves_this_computer(
    abroad: Path, words: tuple[str, ...]
) -> None:
    code, _, told = invoke(*words, abroad)
    assert code in (1, 2)
    assert BEYOND in told
    assert "--insecure" in told
    assert "Traceback" not in told


def test_check_looks_at_the_keys(abroad: Path) -> None:
    keys = abroad.parent / "keys"
    code, stdout, told = invoke("check", "--node", "R1", "--keys", keys / "R1", abroad)
    assert code == 0, told
    assert "R1 has all that it needs" in stdout
    assert "warning: the certificate of R1.1 ends on " in told
    code, _, told = invoke("check", "--node", "R1", "--keys", keys / "E", abroad)
    assert code == 2
    assert "agent@R1 takes those of node R1" in told
    code, _, told = invoke("check", "--node", "R1", "--insecure", abroad)
    assert code == 0
    assert "INSECURE: no keys; whoever reaches the ports at 10.255.0.9 can move" in told


def test_an_agent_without_keys_says_so_loudly(abroad: Path) -> None:
    """Where it may leave all the same; what it says goes to its log before anything else."""
    stopped = threading.Event()
    stopped.set()
    told: list[str] = []
    security = Security.of(dwell.load(abroad), Role("agent@R1", "R1", "agent"), {INSECURE: "1"})
    security.remind(told.append, stopped)
    assert [line.split(":")[0] for line in told] == ["INSECURE"]


# -------------------------------------------------------------------------- a whole cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecureCell]:
    made = SecureCell(tmp_path_factory.mktemp("secure"))
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        # As a shell gives it to them, whatever strangers can do with their ports.
        resource.setrlimit(resource.RLIMIT_NOFILE, (1_024, most))
        made.begin()
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        yield made
    finally:
        made.close()


def test_a_cell_with_keys_actuates_and_moves(cell: SecureCell) -> None:
    assert cell.as_("operator", *PIN)[0] == 0
    before = cell.until(in_window("SO"))["window"]["number"]
    status = cell.until(
        lambda status: in_window("SO")(status) and status["window"]["number"] >= before + 2
    )
    assert not status["complaints"]
    assert "turn" in cell.log("R2", "sink.control@R2")


def test_an_observer_looks_and_no_more(cell: SecureCell) -> None:
    cell.show(
        lambda stdout: stdout.splitlines()[0].partition(";")[0] == "light-follower: SO",
        *("--keys", cell.host / "watcher"),
    )
    code, told = cell.as_("watcher", "live", "pin", "LOC")
    assert code == 2
    assert "keys of an observer, who may look and no more" in told
    status = cell.until(lambda status: status["pinned"])
    assert status["pinned"] == "SO"


def test_nodes_visit_nobody_and_without_keys_nobody_does(cell: SecureCell) -> None:
    code, told = cell.as_("R1", "live", "status")
    assert code == 2
    assert "visiting takes those of an operator" in told
    code, _, told = invoke("live", "status", "--cell", cell.file)
    assert code == 1
    assert "no controller of cell 'light-follower' answers" in told


def test_an_agent_with_another_nodes_keys_does_not_start(cell: SecureCell) -> None:
    words = ("agent", "--node", "R1", "--cell", cell.file, "--state", cell.state("none"))
    code, _, told = invoke(*words, "--keys", cell.host / "E")
    assert code == 2
    assert "keys of E, a subject with the role node; agent@R1 takes those of node R1" in told
    assert "Traceback" not in told


def test_orders_of_others_move_nothing(cell: SecureCell) -> None:
    """A robot's certificate does not get through; the controller's does, but nothing is signed."""
    status = cell.until(lambda status: status["placement"] == "SO")
    stamper = wire(cell.problem).entry("stamper@R1").listen["control"]
    order = encode(Order(1 << 60, "me", status["run"], status["term"], "LOC"))
    key = Keys(cell.problem.name).of(channels.ORDER)
    for name, gets_through in (("R2", False), ("controller", True)):
        with Intruder(stamper.port, tls(cell.host / name)) as intruder:
            limit_s = time.monotonic() + PATIENCE_S
            while not intruder.peers["control"] and time.monotonic() < limit_s:
                time.sleep(0.02)
            assert intruder.peers["control"] == 1
            for _ in range(20):
                # In the place of a signature stands none.
                intruder.put(key, bytes(64) + order)
                time.sleep(0.02)
        assert ("order: not signed by controller" in cell.log("R1", "stamper@R1")) == gets_through
    # A move of the guard is none of the order's.
    after = cell.until(in_window("SO"))
    assert after["moves"]["ordered"] == status["moves"]["ordered"]


def test_false_stamps_with_the_stampers_keys_end_no_decisions(cell: SecureCell) -> None:
    before = cell.until(lambda status: status["window"])
    entry = wire(cell.problem).entry(f"controller@{cell.problem.controller_node}")
    stamp = Stamped(before["run"], 0, before["term"], before["placement"], time.monotonic_ns())
    false = (
        msgspec.structs.replace(stamp, cycle=1 << 40),
        msgspec.structs.replace(stamp, cycle=1 << 40, term=before["term"] + (1 << 20)),
        msgspec.structs.replace(stamp, cycle=1 << 40, run=before["run"] + 1),
    )
    with Intruder(entry.listen["control"].port, tls(cell.host / "R1")) as intruder:
        for number, message in enumerate(false, before["disbelieved"] + 1):
            limit_s = time.monotonic() + PATIENCE_S
            heard = 0
            while heard < number and time.monotonic() < limit_s:
                intruder.put(Keys(cell.problem.name).of(channels.STAMPED), encode(message))
                time.sleep(0.2)
                heard = cell.until(lambda _: True)["disbelieved"]
            assert heard >= number
    after = cell.until(lambda now: now["window"]["number"] >= before["window"]["number"] + 3)
    assert after["run"] == before["run"]
    assert after["moves"]["ordered"] == before["moves"]["ordered"]
    assert cell.as_("operator", "live", "pin", "LOC")[0] == 0
    cell.until(lambda status: status["placement"] == "LOC")
    assert "are believed (damaged, or made up)" in cell.logs


def test_an_observer_sees_the_page_and_may_not_act(cell: SecureCell) -> None:
    keys = cell.host / "watcher"
    code, stdout, stderr = invoke(
        *("dash", cell.file, "--control", "--keys", keys, "--port", "0", "--no-browser")
    )
    assert (code, stdout) == (2, "")
    assert "observer" in stderr
    with serving(cell.folder, cell.file, "--keys", keys) as page:
        until_state(page, lambda found: found["health"] == "ok")
        wait_until(lambda: page.get("/view?begin=0&end=1e6")["cycles"] > 20)
        assert page.act("pin", {"candidate": "SO"}).status == 403


def test_an_operator_acts_on_the_page_by_name(cell: SecureCell) -> None:
    with serving(cell.folder, cell.file, "--control", "--keys", cell.host / "operator") as page:
        assert page.get("/cells")["cells"][0]["certificate"].startswith("operator.")
        assert page.act("pin", {"candidate": "SO"}).status == 200
        until_state(page, lambda found: found["placement"] == "SO")
        assert page.act("unpin", {}).status == 200
        assert "pin SO by operator." in page.said
        # As the test before has left it.
        assert page.act("pin", {"candidate": "LOC"}).status == 200
        until_state(page, lambda found: found["placement"] == "LOC")


def test_bare_connections_end_nothing_and_keep_nobody_out_once_they_have_gone(
    cell: SecureCell,
) -> None:
    before = cell.until(lambda status: status["window"] and not status["silent"])
    entries = [wire(cell.problem).entry(who) for who in ("agent@E", "stamper@R1", "perception@E")]
    pids = {who: cell.pid(who) for who in ("stamper@R1", "perception@E")}
    with ExitStack() as stack:
        for entry in entries:
            port = entry.listen["control"].port
            for _ in range(1_500):
                bare = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
                stack.enter_context(bare)
        # No descriptor is left, and a process dies.
        victim = cell.pid("planning@E.shadow")
        os.kill(victim, signal.SIGKILL)
        cell.until(lambda status: status["window"]["number"] > before["window"]["number"])
    for entry in entries:
        with Intruder(entry.listen["control"].port, tls(cell.host / "operator")) as visitor:
            limit_s = time.monotonic() + PATIENCE_S
            while not visitor.peers["control"] and time.monotonic() < limit_s:
                time.sleep(0.02)
            assert visitor.peers["control"] == 1, entry.role.who
    after = cell.until(
        lambda status: status["headline"] is None and cell.pid("planning@E.shadow") != victim
    )
    assert after["run"] == before["run"]
    assert pids == {who: cell.pid(who) for who in pids}
    assert all(process.poll() is None for process in cell.processes.values())


def test_certificates_are_renewed_while_the_cell_runs(cell: SecureCell) -> None:
    """A host with a new certificate gets its files first, the others theirs one by one."""
    assert cell.as_("operator", *PIN)[0] == 0
    before = cell.until(lambda status: status["health"] == "ok" and status["placement"] == "SO")
    processes = dict(cell.processes)
    pids = {who: cell.pid(who) for who in ("stamper@R1", "camera@R1", "sink.control@R2")}
    requested = ("R1", "controller")
    assert invoke("keys", "request", *requested, "--out", cell.host)[0] == 0
    requests = [cell.host / f"{name}.csr" for name in requested]
    code, _, error = invoke("keys", "sign", *requests, "--authority", cell.keys, "--days", "700")
    assert code == 0, error
    for name in ("R1", "R2", "controller", "operator", "E"):
        shutil.copytree(cell.keys / name, cell.host / name, dirs_exist_ok=True)

    def renewed(status: dict[str, Any]) -> bool:
        certificates = status["certificates"]
        return all(certificates[name]["days"] > 600 for name in requested)

    after = cell.until(renewed)
    assert all(cell.pid(who) != pid for who, pid in pids.items())
    assert cell.processes == processes
    assert all(process.poll() is None for process in processes.values())
    assert after["certificates"]["E"] == before["certificates"]["E"] | {
        "days": after["certificates"]["E"]["days"]
    }
    found = cell.until(lambda status: status["health"] == "ok")
    # Neither the run nor what operators wanted is forgotten.
    assert (found["run"], found["pinned"]) == (before["run"], "SO")
    cell.until(lambda status: status["window"]["number"] > found["window"]["number"])


def test_the_run_is_a_run_and_no_log_has_a_secret(cell: SecureCell) -> None:
    assert cell.end("controller") == 0
    (folder,) = (cell.folder / "runs").iterdir()
    assert dwell.open_run(folder).windows.height > 2
    logs = cell.logs
    assert "PRIVATE KEY" not in logs
    for path in cell.host.glob("*/key*.pem"):
        secret = path.read_text().splitlines()[1]
        assert secret[-20:] not in logs
    assert "Traceback" not in logs
