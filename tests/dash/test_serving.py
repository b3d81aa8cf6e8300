"""What `dwell dash` says where something is missing, taken, damaged, or not finished."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

import dwell
from dwell.record import seal_run
from dwell.record.journal import JOURNAL
from tests.cli.small_cell import CANONICAL, environment
from tests.dash.recorded import WrittenRun
from tests.dash.served import dash, serving
from tests.waiting import PATIENCE_S, wait_until

LIVE = ("msgspec", "zenoh", "cryptography", "psutil")
TABLES = ("polars", "scipy")


def ran(*arguments: str | Path, without: Sequence[str] = ()) -> tuple[int, str]:
    """Run a command that refuses; returns its exit code and what it said."""
    done = subprocess.run(
        dash(*arguments, without=without),
        capture_output=True,
        text=True,
        env=environment(),
        check=False,
        # A command that serves in place of refusing would never end.
        timeout=PATIENCE_S,
    )
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    return done.returncode, done.stderr


def test_a_run_needs_no_live_runtime(run_folder: Path) -> None:
    with serving(run_folder.parent, run_folder, without=LIVE) as page:
        assert page.get("/view?begin=0&end=100")["cycles"] == 600


@pytest.mark.parametrize(
    ("lacking", "extra"), [(("starlette",), "dash"), (("uvicorn",), "dash"), (TABLES, "sim")]
)
def test_what_a_run_lacks_is_told_with_the_line_that_installs_it(
    run_folder: Path, lacking: Sequence[str], extra: str
) -> None:
    code, said = ran(run_folder, without=lacking)
    assert code == 1
    assert f"pip install 'dwell-placement[{extra}]'" in said


@pytest.mark.parametrize("lacking", ["msgspec", "zenoh"])
def test_what_a_cell_lacks_is_told_likewise(tmp_path: Path, lacking: str) -> None:
    file = shutil.copy(CANONICAL.parent / "live" / "cell.yaml", tmp_path)
    code, said = ran(file, without=[lacking])
    assert code == 1
    assert "pip install 'dwell-placement[live]'" in said


def test_a_port_that_is_taken_is_told(run_folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        words = [word if word != "0" else port for word in dash(run_folder)]
        done = subprocess.run(words, capture_output=True, text=True, env=environment(), check=False)
    assert done.returncode == 1
    assert f"port {port} of 127.0.0.1 is taken" in done.stderr
    assert "--port 0" in done.stderr


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_a_signal_right_after_the_address_ends_it_in_order(
    run_folder: Path, sent: signal.Signals, code: int
) -> None:
    process = subprocess.Popen(
        dash(run_folder), stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment()
    )
    assert process.stdout is not None
    assert process.stdout.readline()
    process.send_signal(sent)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (code, b"")


# ------------------------------------------------------------------------------ the browser

#: Stands in for a browser: notes what it is started with, and the mode of the file.
BROWSER = """#!/bin/sh
printf '%s\\n' "$@" > {folder}/words
file=$(printf '%s' "$1" | sed 's|file://||')
stat -c %a "$file" > {folder}/mode
cp "$file" {folder}/opened
touch {folder}/done
"""


@contextmanager
def browsing(folder: Path, run: Path, **more: str) -> Iterator[subprocess.Popen[str]]:
    """Serve a run with a browser of our own."""
    words = [word for word in dash(run) if word != "--no-browser"]
    plain = {
        name: value
        for name, value in environment().items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    }
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**plain, "TMPDIR": str(folder), **more},
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=60)


def test_the_browser_is_given_a_file_that_others_cannot_read(
    tmp_path: Path, run_folder: Path
) -> None:
    script = tmp_path / "browser"
    script.write_text(BROWSER.format(folder=tmp_path))
    script.chmod(0o755)
    with browsing(tmp_path, run_folder, DISPLAY=":99", BROWSER=f"{script} %s") as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        token = address.partition("token=")[2]
        wait_until((tmp_path / "done").exists)
        words = (tmp_path / "words").read_text()
        assert token
        assert token not in words
        assert address in (tmp_path / "opened").read_text()
        assert (tmp_path / "mode").read_text().strip() == "600"
        (folder,) = tmp_path.glob("dwell-dash-*")
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        line = Path(f"/proc/{process.pid}/cmdline").read_text()
        assert token not in line
    assert not list(tmp_path.glob("dwell-dash-*"))


def test_without_a_display_it_is_served_all_the_same(tmp_path: Path, run_folder: Path) -> None:
    with browsing(tmp_path, run_folder) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        assert "no display" in process.stderr.readline()


# ---------------------------------------------------------------------------- what is shown


def test_what_is_no_run_is_told_so(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    code, said = ran(tmp_path / "empty")
    assert (code, "no run and no fleet" in said) == (2, True)
    code, said = ran(tmp_path / "none")
    assert (code, "no such file" in said) == (2, True)
    code, said = ran()
    assert (code, "cell.yaml" in said) == (2, True)


def test_a_damaged_run_is_told_with_its_file(tmp_path: Path, run_folder: Path) -> None:
    for name in ("cycles.parquet", "decisions.parquet", "run.json"):
        damaged = shutil.copytree(run_folder, tmp_path / name)
        (damaged / name).write_bytes((damaged / name).read_bytes()[:100])
        code, said = ran(damaged)
        assert code == 2, name
        assert name in said
    (damaged / "run.json").write_text("{}")
    assert "schema_version" in ran(damaged)[1]
    missing = shutil.copytree(run_folder, tmp_path / "missing")
    (missing / "windows.parquet").unlink()
    assert "without windows" in ran(missing)[1]


def test_damaged_jobs_take_nothing_else_along(tmp_path: Path, run_folder: Path) -> None:
    damaged = shutil.copytree(run_folder, tmp_path / "run")
    (damaged / "jobs.parquet").write_bytes(b"PAR1")
    with serving(tmp_path, damaged) as page:
        assert page.get("/view?begin=0&end=100")["cycles"] == 600
        answer = page.ask("/jobs?begin=0&end=1", page.bearer)
        assert answer.status == 409
        assert "jobs.parquet" in answer.value["error"]


def test_a_run_that_is_written_is_shown_as_far_as_it_has_come(
    tmp_path: Path, run_folder: Path
) -> None:
    written = WrittenRun(tmp_path / "run", dwell.open_run(run_folder))
    code, said = ran(tmp_path / "run")
    assert code == 2
    assert "no cycles yet" in said
    written.go_on(20)
    with serving(tmp_path, tmp_path / "run") as page:
        (cell,) = page.get("/cells")["cells"]
        assert (cell["cycles"], cell["growing"]) == (200, True)
        assert "goes on" in cell["notes"][0]
        with page.events() as reader:
            written.go_on(20)
            heard = b""
            while b"data: " not in heard:
                heard += reader.recv(65_536)
        wait_until(lambda: page.get("/cells")["cells"][0]["cycles"] == 400)
        # Half a frame at its end is not read.
        with (tmp_path / "run" / JOURNAL).open("ab") as journal:
            journal.write(b"\x00\x01")
        assert page.get("/view?begin=0&end=100")["cycles"] == 400
    written.close()
    journal_file = tmp_path / "run" / JOURNAL
    os.truncate(journal_file, journal_file.stat().st_size - 100)
    with serving(tmp_path, tmp_path / "run") as page:
        (cell,) = page.get("/cells")["cells"]
        assert 0 < cell["cycles"] <= 400
        assert any("were torn by a kill" in note for note in cell["notes"])
        seal_run(tmp_path / "run")
        with page.events() as reader:
            while b"data: " not in reader.recv(65_536):
                pass
        assert not page.get("/cells")["cells"][0]["growing"]


def test_readers_are_let_go_at_the_end(tmp_path: Path, run_folder: Path) -> None:
    with serving(tmp_path, run_folder) as page:
        reader = page.events()
        assert b"200 OK" in reader.recv(1_024)
    while reader.recv(1_024):
        pass
    reader.close()
    assert page.said == ""
