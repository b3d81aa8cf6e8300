"""A process that does what its parent asks it to, and dies with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from dwell.errors import LiveError
from dwell.live.local.child import Child, Started
from tests.waiting import wait_until

ECHO = """
import os, sys
sys.path.insert(0, {src!r})
from dwell.live.local.child import Parent
from dwell.errors import LiveError
def answer(request):
    if request == "die":
        os._exit(3)
    if request == "fail":
        raise LiveError("no")
    return request
def begin(settings):
    if settings == "wrong":
        raise LiveError("it is wrong")
    return answer
Parent().serve(begin)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return a module whose process answers with what it was asked."""
    (tmp_path / "echoing.py").write_text(ECHO.format(src=str(Path("src").resolve())))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "echoing"


@pytest.fixture
def child(module: str) -> Iterator[Child]:
    made = Child(module, "the echo", {"a": 1})
    yield made
    made.stop()


def test_it_answers_until_it_is_stopped(child: Child) -> None:
    child.start()
    assert child.answered is None
    assert child.ask({"b": [2, "é"]}) == {"b": [2, "é"]}
    with pytest.raises(LiveError, match="the echo: no"):
        child.ask("fail")
    with pytest.raises(LiveError, match="has been started before"):
        child.start()
    pid = child.pid
    child.stop()
    assert not psutil.pid_exists(pid)
    child.stop()
    with pytest.raises(LiveError, match="the echo does not run"):
        child.ask({})


def test_settings_that_are_refused_end_it(module: str) -> None:
    child = Child(module, "the echo", "wrong")
    with pytest.raises(LiveError, match="the echo: it is wrong"):
        child.start()
    assert not psutil.pid_exists(child.pid)


def test_one_that_has_ended_is_told(child: Child) -> None:
    with pytest.raises(LiveError, match="has not been started"):
        _ = child.pid
    child.start()
    with pytest.raises(LiveError, match=r"the echo \(process \d+\) has ended"):
        child.ask("die")


def test_one_that_hangs_is_told_and_ended(child: Child) -> None:
    child.start()
    os.kill(child.pid, signal.SIGSTOP)
    with pytest.raises(LiveError, match=r"has not answered within 0\.1 s"):
        child.ask({}, timeout_s=0.1)
    pid = child.pid
    child.stop()
    assert not psutil.pid_exists(pid)


def test_it_ends_where_its_parent_is_killed(module: str) -> None:
    code = (
        "import time; from dwell.live.local.child import Child\n"
        f"child = Child({module!r}, 'echo', {{}}); child.start(); print(child.pid, flush=True)\n"
        "time.sleep(1000)"
    )
    words = [sys.executable, "-c", code]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert psutil.pid_exists(pid)
        parent.kill()
    wait_until(lambda: not psutil.pid_exists(pid))


def test_what_is_started_is_stopped_whatever_happens_meanwhile() -> None:
    steps: list[str] = []

    class Lamp(Started):
        def _start(self) -> None:
            self._stack.callback(steps.append, "off")
            steps.append("on")

    def work() -> None:
        with Lamp():
            steps.append("work")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert steps == ["on", "work", "off"]
