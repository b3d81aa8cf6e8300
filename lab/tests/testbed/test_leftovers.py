"""Names: one living testbed each, and what a dead one left is cleared away, nothing else."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.local.cgroups import find_cgroups
from dwell_lab.testbed.groups import Groups, Share, group_name
from dwell_lab.testbed.hosts import Hosts, namespace_name, namespace_path
from dwell_lab.testbed.leftovers import Claim
from lab.tests.testbed.machine import no_groups, no_hosts, own_name

needs_both = pytest.mark.skipif(bool(no_hosts() or no_groups()), reason=no_hosts() or no_groups())

PATIENCE_S = 60.0
NODES = ("A", "B")
OWNER = """
import subprocess, sys, time
from pathlib import Path
from dwell.live.local.burner import stress
from dwell_lab.testbed.groups import Groups, Share
from dwell_lab.testbed.hosts import Hosts
from dwell_lab.testbed.leftovers import Claim
name, folder = sys.argv[1], Path(sys.argv[2])
nodes = ("A", "B")
with (
    Claim(name, nodes, folder=folder),
    Hosts(name, nodes, [nodes]) as hosts,
    Groups(name, {node: Share() for node in nodes}) as groups,
    stress(groups.inside("A", [])) as busy,
):
    busy.set(1)
    words = groups.inside("B", hosts.inside("B", ["setsid", "sleep", "600"]))
    sleeper = subprocess.Popen(words)
    alone = subprocess.Popen(hosts.inside("A", ["sleep", "600"]))
    while Path(f"/proc/{alone.pid}/comm").read_text() != "sleep\\n" or not groups.pids("B"):
        time.sleep(0.01)
    print(sleeper.pid, alone.pid, flush=True)
    time.sleep(600)
"""


@pytest.fixture
def name() -> str:
    return own_name()


@contextmanager
def living(name: str, folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """A testbed in a process of its own, with the processes that outlive it."""
    words = [sys.executable, "-c", OWNER, name, str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as owner:
        try:
            assert owner.stdout is not None
            yield owner, [int(pid) for pid in owner.stdout.readline().split()]
        finally:
            owner.kill()


def made(name: str) -> list[Path]:
    """All that a testbed of this name has in the system."""
    spaces = [namespace_path(namespace_name(name, node)) for node in NODES]
    groups = find_cgroups().groups(group_name(name))
    return [path for path in (*spaces, *groups) if path.exists()]


def runs(pid: int) -> bool:
    """Whether a process runs; one that has ended may wait for init to notice."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@needs_both
def test_what_a_killed_testbed_left_is_gone_with_the_next_of_its_name(
    tmp_path: Path, name: str
) -> None:
    with living(name, tmp_path) as (owner, pids):
        assert len(pids) == 2
        owner.send_signal(signal.SIGKILL)
        owner.wait(PATIENCE_S)
    everything = made(name)
    assert everything
    assert all(map(runs, pids))
    other = own_name()
    with Groups(other, {"A": Share()}), Hosts(other, NODES, []), living(name + "-x", tmp_path):
        with Claim(name, NODES, folder=tmp_path):
            assert not made(name)
            assert not any(map(runs, pids))
            assert len(made(other)) == len(made(name + "-x")) == len(everything)
        with Claim(name, NODES, folder=tmp_path):
            pass
        assert len(made(other)) == len(made(name + "-x")) == len(everything)
    with Claim(name + "-x", NODES, folder=tmp_path):
        pass
    assert not made(name + "-x")
    assert not list(tmp_path.iterdir())


@needs_both
def test_a_living_testbeds_name_is_not_given_away_and_nothing_is_touched(
    tmp_path: Path, name: str
) -> None:
    with living(name, tmp_path) as (owner, pids):
        before, files = made(name), sorted(tmp_path.iterdir())
        contents = [file.read_bytes() for file in files]
        with (
            pytest.raises(LiveError, match=rf"{name}' runs already \(process {owner.pid}\)"),
            Claim(name, ["Z"], folder=tmp_path),
        ):
            pass
        assert made(name) == before
        assert all(map(runs, pids))
        assert sorted(tmp_path.iterdir()) == files
        assert [file.read_bytes() for file in files] == contents
    with Claim(name, NODES, folder=tmp_path):
        assert not made(name)


@needs_both
def test_what_no_testbed_of_the_name_left_is_in_the_way_and_stays(
    tmp_path: Path, name: str
) -> None:
    with Hosts(name, NODES, []), Groups(name, {"A": Share()}):
        before = made(name)
        with (
            pytest.raises(LiveError, match="taken") as caught,
            Claim(name, NODES, folder=tmp_path),
        ):
            pass
        assert f"ip netns delete {namespace_name(name, 'A')}" in str(caught.value)
        assert made(name) == before
    assert not list(tmp_path.iterdir())


def test_a_name_is_free_again_at_the_end_and_after_an_error(tmp_path: Path, name: str) -> None:
    def fail() -> None:
        with Claim(name, NODES, folder=tmp_path):
            record = json.loads((tmp_path / f"{name}.json").read_text())
            assert record["namespaces"] == [namespace_name(name, node) for node in NODES]
            raise KeyError

    for _ in range(2):
        with pytest.raises(KeyError):
            fail()
        assert not list(tmp_path.iterdir())


def test_two_claims_in_one_process_are_two(tmp_path: Path, name: str) -> None:
    with (
        Claim(name, NODES, folder=tmp_path),
        pytest.raises(LiveError, match="runs already"),
        Claim(name, NODES, folder=tmp_path),
    ):
        pass


def test_a_lock_is_not_handed_to_processes_that_live_on(tmp_path: Path, name: str) -> None:
    with Claim(name, NODES, folder=tmp_path):
        sleeper = subprocess.Popen(["sleep", "600"], close_fds=False)
    try:
        with Claim(name, NODES, folder=tmp_path):
            pass
    finally:
        sleeper.kill()
        sleeper.wait()


def test_a_record_that_is_none_is_an_error(tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.json").write_text("{")
    with pytest.raises(LiveError, match="not a testbed's record"), Claim(name, [], folder=tmp_path):
        pass
    assert (tmp_path / f"{name}.json").exists()


@pytest.mark.parametrize("wrong", ["", "a/b", "../x", "-x", "a b", "x" * 41])
def test_a_name_that_is_none_is_an_error(wrong: str) -> None:
    with pytest.raises(LiveError, match="cannot be named"):
        Claim(wrong, NODES)


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(LiveError, match=r"Not a directory|File exists"),
        Claim(name, NODES, folder=tmp_path / "file"),
    ):
        pass
