"""An agent's supervisor with real processes that die in every way."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from dwell.errors import LiveError
from dwell.live.host import supervision
from dwell.live.host.state_files import InFlight
from dwell.live.host.supervision import SupervisedProcess, Supervisor, claim
from dwell_lab.chaos.disk import SmallDisk, may_mount
from tests.live.plain_launcher import supervise
from tests.processes import lives
from tests.waiting import PATIENCE_S, wait_until


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def supervisor(tmp_path: Path, said: list[str]) -> Iterator[Supervisor]:
    made = supervise(tmp_path, said.append)
    yield made
    made.stop()


def until(supervisor: Supervisor, done: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end, "it has not happened"
        supervisor.step()
        time.sleep(0.005)


def keep(supervisor: Supervisor, who: str, code: str) -> SupervisedProcess:
    return supervisor.keep(who, [sys.executable, "-c", code])


def test_a_killed_process_is_started_again(supervisor: Supervisor, said: list[str]) -> None:
    child = keep(supervisor, "worker@E", "import time; time.sleep(1000)")
    until(supervisor, lambda: child.starts == 1)
    first = child.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    until(supervisor, lambda: child.starts == 2)
    assert child.pid != first
    assert said == ["worker@E was killed by SIGKILL"]


def test_an_agent_is_woken_when_a_process_of_its_node_ends(
    supervisor: Supervisor, tmp_path: Path, said: list[str]
) -> None:
    child = keep(supervisor, "worker@E", "import time; time.sleep(1000)")
    assert supervisor.pending
    until(supervisor, lambda: child.starts == 1)
    second = supervise(tmp_path, said.append)
    adopted = keep(second, "worker@E", "raise SystemExit")
    assert not supervisor.pending
    assert not second.pending
    woken = [threading.Event(), threading.Event()]
    supervisor.ends.wake, second.ends.wake = woken[0].set, woken[1].set
    assert child.pid is not None
    assert adopted.pid == child.pid
    os.kill(child.pid, signal.SIGKILL)
    assert all(event.wait(PATIENCE_S) for event in woken)
    assert supervisor.pending
    assert second.pending
    until(supervisor, lambda: child.starts == 2)
    assert not supervisor.pending


def test_a_process_that_cannot_be_watched_is_looked_at(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(pid: int) -> int:
        raise OSError(errno.EMFILE, "no free descriptor")

    monkeypatch.setattr(os, "pidfd_open", fail)
    child = keep(supervisor, "worker@E", "import time; time.sleep(1000)")
    until(supervisor, lambda: child.starts == 1)
    assert supervisor.pending


def test_a_state_folder_that_is_removed_is_made_again(
    supervisor: Supervisor, tmp_path: Path, said: list[str]
) -> None:
    child = keep(supervisor, "worker@E", "import time; time.sleep(1000)")
    until(supervisor, lambda: child.starts == 1)
    first = child.pid
    shutil.rmtree(tmp_path)
    for _ in range(3):
        supervisor.step()
        supervisor.tend()
    assert (child.pid, child.starts) == (first, 1)
    assert child.file("pid").exists()
    assert said == [supervisor.notes()] == [f"{tmp_path}: was removed, and is made again"]
    assert first is not None
    os.kill(first, signal.SIGKILL)
    until(supervisor, lambda: child.starts == 2)


def test_a_crash_loop_backs_off_and_is_reported(supervisor: Supervisor, said: list[str]) -> None:
    child = keep(supervisor, "worker@E", "raise SystemExit('no camera here')")
    until(supervisor, lambda: child.failures >= 4)
    waits = [child.next_s - time.monotonic()]
    assert waits[0] > 4 * supervision.FIRST_WAIT_S
    assert "ended with exit code 1: no camera here" in supervisor.notes()
    assert said[-1].startswith("worker@E ended with exit code 1: no camera here; start 5 in 0.4 s")


def test_a_message_that_kills_twice_is_put_aside_with_its_bytes(
    supervisor: Supervisor, tmp_path: Path, said: list[str]
) -> None:
    # It dies of what the one before it died of, as long as that is handed to it.
    code = (
        "import os, signal, sys, time\n"
        "from pathlib import Path\n"
        "from dwell.live.host.state_files import InFlight\n"
        f"folder = Path({str(tmp_path)!r})\n"
        "again = folder / 'worker@E.again'\n"
        "first = not (folder / 'started').exists()\n"
        "(folder / 'started').touch()\n"
        "if first or again.exists():\n"
        "    content = again.read_bytes() if again.exists() else b'poison'\n"
        "    InFlight(folder / 'worker@E.inflight').begin(content)\n"
        "    os.kill(os.getpid(), signal.SIGSEGV)\n"
        "time.sleep(1000)\n"
    )
    child = keep(supervisor, "worker@E", code)
    until(supervisor, lambda: child.starts == 3)
    (kept,) = (tmp_path / "quarantine").iterdir()
    assert kept.read_bytes() == b"poison"
    assert any("has killed it twice" in line for line in said)
    assert InFlight.read(child.file("inflight")) is None
    supervisor.step()
    assert child.pid is not None
    assert psutil.pid_exists(child.pid)


@pytest.fixture
def small_group(tmp_path: Path) -> Iterator[Path]:
    """A control group with 64 MB of memory; its folder."""
    for parent, limit in (
        (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes"),
        (Path("/sys/fs/cgroup"), "memory.max"),
    ):
        folder = parent / f"dwell-test-{os.getpid()}"
        try:
            folder.mkdir()
        except OSError:
            continue
        try:
            (folder / limit).write_text(str(64 << 20))
            yield folder
            return
        except OSError:
            continue
        finally:
            for _ in range(100):
                with suppress(OSError):
                    folder.rmdir()
                    break
                time.sleep(0.02)
    pytest.skip("nobody but root limits a group's memory")


def test_what_the_kernel_kills_for_memory_is_told_from_what_somebody_kills(
    supervisor: Supervisor, said: list[str], small_group: Path
) -> None:
    code = (
        "import os, time\n"
        "from pathlib import Path\n"
        f"Path({str(small_group / 'cgroup.procs')!r}).write_text(str(os.getpid()))\n"
        "kept = []\n"
        "while True:\n"
        "    kept.append(b'x' * (1 << 20))\n"
        "    time.sleep(0.005)\n"
    )
    hungry = keep(supervisor, "hungry@E", code)
    other = keep(supervisor, "other@E", "import time; time.sleep(1000)")
    until(supervisor, lambda: hungry.starts == 2)
    assert "hungry@E was killed by the kernel, which had no memory left" in said[0]
    # Also once, and from then on for a while.
    assert "hungry@E was killed by the kernel, which had no memory left" in supervisor.notes()
    hungry.next_s = float("inf")
    assert hungry.pid is not None
    os.kill(hungry.pid, signal.SIGKILL)
    supervisor.step()
    supervisor.tend()
    assert other.pid is not None
    os.kill(other.pid, signal.SIGKILL)
    until(supervisor, lambda: other.starts == 2)
    assert said[-1] == "other@E was killed by SIGKILL"
    assert "other@E" not in supervisor.notes()


def test_a_process_that_may_not_have_more_memory_says_so(
    supervisor: Supervisor, said: list[str]
) -> None:
    code = (
        "import resource, threading, time\n"
        "from dwell.live.failures import start_thread\n"
        "resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))\n"
        "start_thread('beats', lambda: bytearray(4 << 30))\n"
        "time.sleep(1000)\n"
    )
    child = keep(supervisor, "hungry@E", code)
    until(supervisor, lambda: child.starts == 2)
    assert said[0].startswith("hungry@E ended with exit code 1 for want of memory")
    assert "thread 'beats' failed: MemoryError" in said[0]
    assert "for want of memory" in supervisor.notes()


def test_processes_outlive_their_agent_and_the_next_one_adopts_them(
    tmp_path: Path, said: list[str]
) -> None:
    first = supervise(tmp_path, said.append)
    child = keep(first, "stamper@R1", "import time; time.sleep(1000)")
    until(first, lambda: child.starts == 1)
    pid = child.pid
    assert pid is not None
    # The first agent is gone; nobody has told its children.
    second = supervise(tmp_path, said.append)
    adopted = keep(second, "stamper@R1", "raise SystemExit")
    second.step()
    assert (adopted.pid, adopted.starts) == (pid, 0)
    assert all(seconds >= 0 for seconds in second.cpu_seconds().values())
    os.kill(pid, signal.SIGKILL)
    assert child.process is not None
    child.process.wait()
    until(second, lambda: adopted.starts >= 1)
    second.stop()


def test_a_mark_of_another_process_is_not_believed(tmp_path: Path, said: list[str]) -> None:
    (tmp_path / "stamper@R1.pid").write_text(
        f'{{"pid": {os.getpid()}, "started": 12.5, "session": 1}}'
    )
    supervisor = supervise(tmp_path, said.append)
    child = keep(supervisor, "stamper@R1", "import time; time.sleep(1000)")
    assert child.process is None
    until(supervisor, lambda: child.starts == 1)
    supervisor.stop()


def test_what_does_not_listen_is_killed(tmp_path: Path, said: list[str]) -> None:
    supervisor = supervise(tmp_path, said.append)
    ready = tmp_path / "ready"
    deaf = (
        "import signal, time\n"
        "from pathlib import Path\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        f"Path({str(ready)!r}).touch()\n"
        "time.sleep(1000)\n"
    )
    children = [
        keep(supervisor, "a@E", deaf),
        keep(supervisor, "b@E", "import time; time.sleep(99)"),
    ]
    until(supervisor, ready.exists)
    frozen = children[1].pid
    assert frozen is not None
    os.kill(frozen, signal.SIGSTOP)
    pids = [child.pid for child in children]
    supervisor.stop(patience_s=0.5)
    for pid in pids:
        assert pid is not None
        assert not lives(pid)


@pytest.mark.skipif(not may_mount(), reason="nobody but root mounts a disk")
def test_an_agent_outlives_a_full_disk(tmp_path: Path) -> None:
    said: list[str] = []
    with SmallDisk(tmp_path / "disk") as disk:
        supervisor = supervise(disk.folder, said.append)
        disk.fill()
        child = supervisor.keep("worker@E", [sys.executable, "-c", "import time; time.sleep(60)"])
        try:
            supervisor.step()
            supervisor.tend()
            assert "No space left" in "; ".join(said)
            assert not child.file("pid").exists()
            disk.clear()
            child.next_s = 0.0
            supervisor.step()
            supervisor.tend()
            assert json.loads(child.file("pid").read_text())["pid"] == child.pid
        finally:
            supervisor.stop()


LEAK = (
    "import time\nkept = []\nwhile True:\n    kept.append(bytearray(1 << 20)); time.sleep(0.01)\n"
)

SPEAK = "while True: print('x' * 1000, flush=True)"


def test_memory_that_grows_is_reported(tmp_path: Path) -> None:
    said: list[str] = []
    supervisor = supervise(tmp_path, said.append, warm_s=0.2, growth_bytes=8 << 20)
    supervisor.keep("perception@E", [sys.executable, "-c", LEAK])
    try:
        supervisor.step()

        def grown() -> bool:
            supervisor.tend()
            return bool(supervisor.notes())

        wait_until(grown)
    finally:
        supervisor.stop()
    assert supervisor.notes().startswith("perception@E: its memory has grown from ")
    assert supervisor.notes() in said
    # It grows no more.
    (child,) = supervisor.children
    child.peak_s -= supervision.TOLD_S
    assert supervisor.notes() == ""


def test_memory_that_grows_on_is_told_on(tmp_path: Path) -> None:
    supervisor = supervise(tmp_path, print, warm_s=0.2, growth_bytes=8 << 20)
    child = supervisor.keep("perception@E", [sys.executable, "-c", LEAK])
    try:
        supervisor.step()

        def grown() -> bool:
            supervisor.tend()
            return bool(supervisor.notes())

        wait_until(grown)
        child.peak_s -= supervision.TOLD_S
        assert supervisor.notes() == ""
        wait_until(grown)
    finally:
        supervisor.stop()


def test_a_log_does_not_grow_for_ever(tmp_path: Path) -> None:
    supervisor = supervise(tmp_path, print, log_bytes=100_000)
    child = supervisor.keep("perception@E", [sys.executable, "-c", SPEAK])
    older = tmp_path / "perception@E.log.1"
    try:
        supervisor.step()

        def began_anew() -> bool:
            supervisor.tend()
            return older.exists()

        wait_until(began_anew)
        wait_until(lambda: child.file("log").stat().st_size > 0)
    finally:
        supervisor.stop()
    assert older.stat().st_size > 100_000
    # What is appended after the cut follows no hole.
    assert child.file("log").read_bytes()[:1] != b"\0"


# ------------------------------------------------------------------- what it leaves behind

#: Forks a helper in its group and one in a session of its own, which say who they are.
WITH_HELPERS = """
import os, subprocess, sys, time
from pathlib import Path
folder = Path({folder!r})
if not (folder / "helpers").exists():
    sleeps = [sys.executable, "-c", "import time; time.sleep(60)"]
    forked = os.fork()
    if not forked:
        time.sleep(60)
        os._exit(0)
    apart = subprocess.Popen(sleeps, start_new_session=True)
    near = subprocess.Popen(sleeps)
    (folder / "helpers.new").write_text(f"{{forked}} {{near.pid}} {{apart.pid}}")
    (folder / "helpers.new").rename(folder / "helpers")
time.sleep(60)
"""


@pytest.fixture
def helpers(tmp_path: Path) -> Iterator[Callable[[], list[int]]]:
    """Process ids of two helpers in a process's group, and of one with a session of its own."""
    file = tmp_path / "helpers"

    def read() -> list[int]:
        wait_until(file.exists)
        return [int(pid) for pid in file.read_text().split()]

    yield read
    for pid in read():
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_what_a_dead_process_leaves_is_ended_before_it_is_started_again(
    supervisor: Supervisor, tmp_path: Path, helpers: Callable[[], list[int]]
) -> None:
    child = keep(supervisor, "worker@E", WITH_HELPERS.format(folder=str(tmp_path)))
    supervisor.step()
    *near, apart = helpers()
    assert child.pid is not None
    assert [os.getpgid(pid) for pid in near] == [child.pid, child.pid]
    os.kill(child.pid, signal.SIGKILL)
    left_at_start: list[int] = []

    def started_again() -> bool:
        if child.starts == 2 and not left_at_start:
            left_at_start.extend(pid for pid in near if lives(pid))
        return child.starts == 2

    until(supervisor, started_again)
    assert not left_at_start
    assert lives(apart)


def test_the_next_agent_ends_what_a_worker_has_left_that_died_without_one(
    tmp_path: Path, helpers: Callable[[], list[int]], said: list[str]
) -> None:
    first = supervise(tmp_path, said.append)
    child = keep(first, "worker@E", WITH_HELPERS.format(folder=str(tmp_path)))
    first.step()
    *near, apart = helpers()
    # The agent's death alone ends nothing.
    assert all(lives(pid) for pid in (*near, apart))
    assert child.process is not None
    os.kill(child.process.pid, signal.SIGKILL)
    child.process.wait()
    second = supervise(tmp_path, said.append)
    again = keep(second, "worker@E", "import time; time.sleep(60)")
    try:
        until(second, lambda: again.starts == 1)
        assert not any(lives(pid) for pid in near)
        assert lives(apart)
    finally:
        second.stop()


def test_helpers_end_with_their_process_at_an_orderly_end(
    tmp_path: Path, helpers: Callable[[], list[int]], said: list[str]
) -> None:
    supervisor = supervise(tmp_path, said.append)
    keep(supervisor, "worker@E", WITH_HELPERS.format(folder=str(tmp_path)))
    supervisor.step()
    *near, apart = helpers()
    supervisor.stop()
    assert not any(lives(pid) for pid in near)
    assert lives(apart)


def test_the_last_words_are_those_of_the_life_that_has_ended(
    supervisor: Supervisor, said: list[str], tmp_path: Path
) -> None:
    once = tmp_path / "once"
    child = keep(
        supervisor,
        "worker@E",
        f"import pathlib, time; once = pathlib.Path({str(once)!r})\n"
        "if not once.exists(): once.touch(); raise SystemExit('no camera here')\n"
        "time.sleep(60)",
    )
    until(supervisor, lambda: child.failures >= 1)
    until(supervisor, lambda: child.pid is not None and child.starts == 2)
    assert child.pid is not None
    os.kill(child.pid, signal.SIGKILL)
    until(supervisor, lambda: len(said) >= 2)
    assert "was killed by SIGKILL" in said[1]
    assert "camera" not in said[1]


def test_a_process_that_dies_at_ten_starts_makes_its_agent_not_ready(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "LONGEST_WAIT_S", 0.05)
    child = keep(supervisor, "worker@E", "raise SystemExit('cannot open its session')")
    until(supervisor, lambda: child.failures == supervision.MOST_TRIES - 1)
    assert not supervisor.stuck()
    until(supervisor, lambda: child.failures >= supervision.MOST_TRIES)
    assert supervisor.stuck()
    assert supervisor.notes().startswith("worker@E ended with exit code 1: cannot open its session")
    child.command = [sys.executable, "-c", "import time; time.sleep(60)"]
    starts = child.starts
    until(supervisor, lambda: child.starts > starts and child.pid is not None)
    # Once it has lived for a while.
    child.started_s -= supervision.HEALTHY_S
    assert not supervisor.stuck()
    assert supervisor.notes() == ""


def test_what_was_put_aside_is_told_for_a_while(supervisor: Supervisor, tmp_path: Path) -> None:
    child = keep(supervisor, "worker@E", "import time; time.sleep(60)")
    until(supervisor, lambda: child.pid is not None)
    for _ in range(supervision.POISONOUS):
        InFlight(child.file("inflight")).begin(b"poison")
        starts, pid = child.starts, child.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        until(supervisor, lambda starts=starts: child.starts > starts)  # type: ignore[misc]
    child.started_s -= supervision.HEALTHY_S
    assert "has killed it twice" in supervisor.notes()
    child.told_s -= supervision.TOLD_S
    assert supervisor.notes() == ""


def test_a_process_marks_itself_and_is_there_once(tmp_path: Path, said: list[str]) -> None:
    # Its agent has died between the fork and the mark.
    code = (
        "import time; from pathlib import Path; from dwell.live.host.supervision import claim\n"
        f"claim(Path({str(tmp_path)!r}), 'worker@E.shadow'); time.sleep(60)\n"
    )
    first = subprocess.Popen([sys.executable, "-c", code], process_group=0)
    try:
        wait_until((tmp_path / "worker@E.shadow.pid").exists)
        with pytest.raises(LiveError, match=f"runs already \\(process {first.pid}\\)"):
            claim(tmp_path, "worker@E.shadow")
        supervisor = supervise(tmp_path, said.append)
        assert keep(supervisor, "worker@E.shadow", "raise SystemExit").pid == first.pid
    finally:
        first.kill()
        first.wait()


# ---------------------------------------------------------------------- one after another

#: Ends in order, and is ready after a while.
READY = """
import signal, sys, time
from pathlib import Path
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
time.sleep(0.05)
Path(sys.argv[1]).touch()
time.sleep(1000)
"""


def keep_ready(supervisor: Supervisor, who: str, code: str = READY) -> SupervisedProcess:
    mark = supervisor.folder / f"{who}.ready"
    return supervisor.keep(who, [sys.executable, "-c", code, str(mark)])


def test_processes_are_restarted_one_after_another_and_the_first_last(
    supervisor: Supervisor,
) -> None:
    children = [keep_ready(supervisor, who) for who in ("stamper@E", "plan@E", "act@E")]
    until(supervisor, lambda: all(child.file("ready").exists() for child in children))
    before = [child.pid for child in children]
    supervisor.restart_in_turn()
    order: list[str] = []
    while supervisor.restarting or not order:
        supervisor.step()
        away = [child.who for child in children if not child.file("ready").exists()]
        assert len(away) <= 1
        order += [who for who in away if who not in order]
        time.sleep(0.005)
    assert order == ["act@E", "plan@E", "stamper@E"]
    assert all(child.pid != pid for child, pid in zip(children, before, strict=True))
    assert [child.starts for child in children] == [2, 2, 2]
    # An end that was asked for is no trouble.
    assert (supervisor.notes(), supervisor.stuck()) == ("", False)


def test_a_process_that_does_not_end_or_is_never_ready_delays_the_next_for_a_while_only(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "STOP_S", 0.2)
    monkeypatch.setattr(supervision, "TURN_S", 1.0)
    deaf = READY.replace("lambda *_: sys.exit(0)", "signal.SIG_IGN")
    never = READY.replace("Path(sys.argv[1]).touch()", "pass")
    codes = {"last@E": READY, "never@E": never, "deaf@E": deaf}
    children = [keep_ready(supervisor, who, code) for who, code in codes.items()]
    until(supervisor, lambda: all(child.starts for child in children))
    until(supervisor, lambda: children[0].file("ready").exists())
    supervisor.restart_in_turn()
    until(supervisor, lambda: not supervisor.restarting)
    assert [child.starts for child in children] == [2, 2, 2]
