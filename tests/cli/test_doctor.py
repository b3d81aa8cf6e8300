"""`dwell doctor`: what it finds, what it mends, and what it ends with."""

from __future__ import annotations

import json
import os
import pty
import re
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from dwell.kernels import library
from dwell.kernels.library_file import NAME
from dwell.live.trust.authority import Authority
from tests.cli.small_cell import ROOT, call

LIVE = ROOT / "examples" / "live" / "cell.yaml"
PARTS = [
    "extras",
    "kernel",
    "CPU",
    "clocks",
    "ports",
    "certificates",
    "testbed",
    "runs here",
]


def doctor(*words: object, code: int = 0) -> list[dict[str, Any]]:
    done = call("doctor", *map(str, words), "--json")
    assert done.exit_code == code, done.output
    told = json.loads(done.stdout)
    assert told["ok"] == (code == 0)
    found: list[dict[str, Any]] = told["findings"]
    return found


def of(part: str, found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [one for one in found if one["part"] == part]


def test_every_part_is_looked_at_and_what_is_not_well_says_what_mends_it() -> None:
    found = doctor()
    assert list(dict.fromkeys(one["part"] for one in found)) == PARTS
    assert not [one for one in found if one["ok"] and one["remedy"]]
    assert not [one for one in found if not (one["ok"] or one["remedy"])]
    extras = {one["name"]: one["found"] for one in of("extras", found) if one["ok"]}
    assert re.search(r"polars \d", extras["sim"])
    assert re.search(r"eclipse-zenoh \d", extras["live"])
    (kernel,) = of("kernel", found)
    assert kernel["found"] == f"of the sources {library.digest()[:12]}, by {library.compiler()}"
    assert "7450 to 7499" in of("ports", found)[0]["found"]


def test_lines_fit_a_terminal() -> None:
    shown, terminal = pty.openpty()
    words = [sys.executable, "-m", "dwell", "doctor"]
    kept = {**os.environ, "COLUMNS": "80"}
    with subprocess.Popen(words, stdout=terminal, env=kept) as process:
        os.close(terminal)
        text = b""
        while piece := _read(shown):
            text += piece
    os.close(shown)
    assert process.returncode == 0
    assert b"\r\nruns here\r\n" in text
    assert max(map(len, text.decode().splitlines())) <= 80


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 1 << 16)
    except OSError:  # the other end is closed
        return b""


def test_an_extra_that_cannot_be_imported_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "distributed.py").write_text("raise ImportError('no such symbol')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.partition(".")[0] == "distributed"]:
        monkeypatch.delitem(sys.modules, name)
    found = doctor(code=1)
    (dask,) = [one for one in of("extras", found) if not one["ok"]]
    assert dask["name"] == "dask"
    assert "no such symbol" in dask["found"]
    assert dask["remedy"] == "pip install --force-reinstall 'dwell-placement[dask]'"
    assert not [o for o in of("runs here", found) if o["ok"] and o["name"].endswith("--dask")]


def test_a_kernel_that_is_missing_is_a_note_and_a_damaged_one_is_broken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(library, "files", lambda _: tmp_path)
    monkeypatch.setattr(library, "__file__", str(tmp_path / "library.py"))
    library.library.cache_clear()
    try:
        found = doctor()
        (lacking,) = of("kernel", found)
        assert not lacking["ok"]
        assert lacking["found"].endswith(" is missing")
        assert lacking["remedy"] == library.INSTALL_AGAIN
        simulating = of("runs here", found)[0]
        assert simulating["found"] == "not without compiled kernel"
        assert simulating["remedy"] == library.INSTALL_AGAIN
        (tmp_path / NAME).touch()
        (damaged,) = of("kernel", doctor(code=1))
        assert damaged["found"].endswith(" is no library")
    finally:
        library.library.cache_clear()


def free_server() -> socket.socket:
    """Listen where there is room for a node's ports, and no system gives ports by itself."""
    for port in range(20_000, 30_000, 100):
        with suppress(OSError):
            return socket.create_server(("127.0.0.1", port))
    raise AssertionError("no free port")


def test_a_port_that_is_taken_is_told_with_its_process(tmp_path: Path) -> None:
    with free_server() as server:
        taken = server.getsockname()[1]
        text = LIVE.read_text(encoding="utf-8")
        assert "port: 7550" in text
        file = tmp_path / "cell.yaml"
        file.write_text(text.replace("port: 7550", f"port: {taken}"), encoding="utf-8")
        (found,) = of("ports", doctor(file))
    assert not found["ok"]
    assert f"{taken} by" in found["found"]
    assert f"(process {os.getpid()})" in found["found"]


def test_a_certificate_is_told_with_its_end_and_a_damaged_one_is_broken(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys", "light-follower", days=365)
    authority.issue("R1", "node", days=365)
    soon = authority.issue("R2", "node", days=20)
    well, ending = of("certificates", doctor(LIVE, "--keys", tmp_path / "keys"))
    assert well["ok"]
    assert re.search(r"R1\.1 in .* holds until \d{4}-\d\d-\d\d$", well["found"])
    assert not ending["ok"]
    assert re.search(r"in (19|20) days", ending["found"])
    assert ending["remedy"].startswith("dwell keys issue")
    (soon / "key.pem").chmod(0o644)
    (broken,) = of("certificates", doctor("--keys", soon, code=1))
    assert "chmod 600" in broken["found"]


def test_a_cell_that_is_not_there_is_wrong_input(tmp_path: Path) -> None:
    done = call("doctor", tmp_path / "absent.yaml")
    assert done.exit_code == 2
    assert len(done.output.splitlines()) == 1
