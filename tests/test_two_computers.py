"""The quickstart of docs/howto/two-computers.md: its commands, executed on two computers."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "howto" / "two-computers.md"
ADDRESSES = {"robot": "10.0.0.11", "edge": "10.0.0.12"}
PATIENCE_S = 120.0

#: Stands for scp, as both computers have their files on this one.
SCP = """\
#!{python}
import subprocess, sys
assert sys.argv[1] == "-r"
places = [place.replace("edge:", "{edge}/", 1) for place in sys.argv[2:]]
assert places != sys.argv[2:]
subprocess.run(["cp", "-r", *places], check=True)
"""


@dataclass(frozen=True)
class Computer:
    """A network namespace, and a home folder."""

    enter: tuple[str, ...]
    home: Path
    environment: Mapping[str, str]

    def run(self, line: str, *, may_fail: bool = False) -> str:
        """Run a line of a shell; return what it has printed."""
        done = subprocess.run(
            [*self.enter, "sh", "-c", line],
            cwd=self.home,
            env=dict(self.environment),
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert may_fail or done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
        return done.stdout


def namespaces(stack: ExitStack, user: Sequence[str]) -> list[tuple[str, ...]]:
    """Return how two network namespaces with a cable between them are entered.

    Parameters
    ----------
    user : sequence of str
        Options of unshare for a user namespace to make them in.
    """
    inside = ("--user", "--preserve-credentials") if user else ()

    def hold(*command: str) -> tuple[str, ...]:
        process = stack.enter_context(
            subprocess.Popen([*command, "sleep", "infinity"], stderr=subprocess.PIPE, text=True)
        )
        stack.callback(process.kill)
        link = Path(f"/proc/{process.pid}/ns/net")
        deadline_s = time.monotonic() + PATIENCE_S
        while (link.parent.parent / "comm").read_text().strip() != "sleep":
            if process.poll() is not None or time.monotonic() > deadline_s:
                assert process.stderr is not None
                raise OSError(process.stderr.read().strip())
            time.sleep(0.01)
        return ("nsenter", "--target", str(process.pid), "--net", *inside)

    robot = hold("unshare", *user, "--net")
    edge = hold(*robot, "unshare", "--net") if user else hold("unshare", "--net")
    cable = f"ip link add cable type veth peer name cable netns {edge[2]}"
    for enter, lines in {
        robot: (cable, f"ip address add {ADDRESSES['robot']}/24 dev cable"),
        edge: (f"ip address add {ADDRESSES['edge']}/24 dev cable",),
    }.items():
        for line in (*lines, "ip link set cable up", "ip link set lo up"):
            done = subprocess.run(
                [*enter, *line.split()], capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise OSError(done.stderr.strip())
    return [robot, edge]


@pytest.fixture
def computers(tmp_path: Path) -> Iterator[dict[str, Computer]]:
    missing = [name for name in ("ip", "nsenter", "unshare") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"no network namespaces: {', '.join(missing)} is not installed")
    with ExitStack() as stack:
        reasons = []
        for how, user in {"root": (), "a user namespace": ("--user", "--map-root-user")}.items():
            try:
                entries = namespaces(stack, user)
                break
            except OSError as error:
                reasons.append(f"as {how}: {error}" if how == "root" else f"in {how}: {error}")
        else:
            pytest.skip(f"no network namespaces can be made, {'; '.join(reasons)}")
        tools = tmp_path / "tools"
        tools.mkdir()
        (tools / "scp").write_text(SCP.format(python=sys.executable, edge=tmp_path / "edge"))
        (tools / "scp").chmod(0o755)
        made = {}
        for name, enter in zip(ADDRESSES, entries, strict=True):
            home = tmp_path / name
            home.mkdir()
            environment = {
                "HOME": str(home),
                "PATH": os.pathsep.join((str(tools), str(Path(sys.executable).parent), os.defpath)),
                "PYTHONPATH": str(ROOT / "src"),
            }
            made[name] = Computer(enter, home, environment)
        yield made


def steps() -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the commands of the page, each with the computers that it is for."""
    places = {"both": tuple(ADDRESSES), "the robot": ("robot",), "the edge server": ("edge",)}
    page = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"^On ([^,:]+)[,:].*?\n\n```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == page.count("```sh")
    for place, text in blocks:
        for line in text.splitlines():
            yield places[place], line


def test_the_quickstart_has_twelve_commands() -> None:
    assert len(list(steps())) == 12


def assert_whole(line: str, computer: Computer) -> None:
    """Look at the cell as the page does until all processes work."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        status = json.loads(computer.run(f"{line} --json", may_fail=True))
        # A controller on a busy machine may answer the next look only.
        if status["health"] != "absent":
            ready = all(process["ready"] for process in status["processes"].values())
            if status["window"] and ready and not status["silent"]:
                return
        assert time.monotonic() < deadline_s, status
        # A look is a process that takes CPU from the cell as it begins.
        time.sleep(1.0)


def test_the_quickstart_works(computers: dict[str, Computer]) -> None:
    ended = []
    try:
        for names, line in steps():
            for name in names:
                told = computers[name].run(line)
                if "live down" in line:
                    ended.append(told)
            if "live status" in line:
                assert told.startswith("follower")
                assert_whole(line, computers["robot"])
        # No private key has left the computer where it was made.
        keys = {
            name: {path.read_bytes() for path in computer.home.rglob("*key*.pem")}
            for name, computer in computers.items()
        }
        assert len(keys["edge"]) == 2
        assert keys["edge"].isdisjoint(keys["robot"])
    finally:
        for computer in computers.values():
            computer.run("! test -f follower/cell.yaml || dwell live down follower/cell.yaml")
    assert [sorted(re.findall(r"\w+@\w+", told)) for told in ended] == [
        ["agent@R1", "agent@R2"],
        ["agent@E", "controller@E"],
    ]
