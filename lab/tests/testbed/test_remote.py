"""Commands on another host: their variables, their end, and what they started."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import psutil

from dwell_lab.testbed.remote import SHELL_ID, RemoteProcess, script_of
from tests.waiting import wait_until

SHELL = ("sh", "-c")


def test_a_command_ends_when_it_is_told_to(tmp_path: Path) -> None:
    code = "import signal, sys; signal.signal(15, lambda *_: sys.exit(7)); print('up', flush=True)"
    code += "; signal.pause(); signal.pause()"
    script = script_of([sys.executable, "-c", code], str(tmp_path), {"DWELL_X": "it's"})
    with RemoteProcess([*SHELL, script], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        process.terminate()
        assert process.wait(10) == 7
        process.terminate()


def test_a_command_has_its_variables_and_its_code(tmp_path: Path) -> None:
    code = "import os, sys; print(os.environ['DWELL_X'], sys.argv[1], os.getppid(), os.getcwd())"
    script = script_of(
        [sys.executable, "-c", f"{code}; sys.exit(3)", SHELL_ID], str(tmp_path), {"DWELL_X": "it's"}
    )
    with RemoteProcess([*SHELL, script], stdout=subprocess.PIPE) as process:
        assert process.wait(60) == 3
        assert process.stdout is not None
        value, owner, shell, folder = process.stdout.read().decode().split()
    assert value == "it's"
    assert owner == shell
    assert Path(folder) == tmp_path


CALLER = """
import sys
from dwell_lab.testbed.remote import RemoteProcess
RemoteProcess(sys.argv[1:]).wait()
"""


def test_what_it_started_ends_with_it_where_its_caller_is_killed(tmp_path: Path) -> None:
    line = "sleep 1000 & echo $! > child; sleep 1000"
    script = script_of(["sh", "-c", line], str(tmp_path), {"DWELL_X": "1"}, whole=True)
    process = subprocess.Popen([sys.executable, "-c", CALLER, *SHELL, script])
    child = tmp_path / "child"
    wait_until(lambda: child.is_file() and child.read_text().strip() != "")
    pid = int(child.read_text())
    process.kill()
    process.wait()
    wait_until(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == "zombie")
