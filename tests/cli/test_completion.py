"""Completion: what a line may become, and that the scripts put it there in real shells."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dwell.cli.commands import app
from dwell.cli.completion import LINE, Shell, learn_shells
from tests.cli.small_cell import ROOT, call

COMMAND = Path(sys.executable).with_name("dwell")
PATIENCE_S = 60.0


def offered(line: str) -> list[str]:
    """Return what a shell is told of a line up to the cursor."""
    learn_shells()
    words = f"dwell {line}"
    asked = {LINE: "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = CliRunner().invoke(app, env=asked, prog_name="dwell")
    assert done.exit_code == 0, done.output
    return done.stdout.split()


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in a folder with cells, a study, runs, and files that are none of these."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "examples" / "canonical.yaml", "hall.yaml")
    Path("broken.yaml").write_text("dwell: 1\nscenarios: {a: [}\n")
    Path("odd.yaml").write_text("dwell: 1\nscenarios: 7\ncandidates: [a]\n")
    Path("wide.yaml").write_text("dwell-study: 1\n")
    Path("notes.yaml").write_text("notes: 1\n")
    Path("hidden.txt").write_text("dwell: 1\n")
    Path("runs/first").mkdir(parents=True)
    Path("runs/first/run.json").write_text("{}")
    Path("runs/more").mkdir()
    # What processes have printed stands in another folder: this one is looked through for cells.
    state = tmp_path.with_name(f"{tmp_path.name}-state")
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    for log in ("dwell/hall/agent@R1.log", "other/hall/E/plan@E.log"):
        (state / log).parent.mkdir(parents=True, exist_ok=True)
        (state / log).touch()


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("ru", ["run"]),
        ("testbed do", ["doctor"]),
        ("run --sce", ["--scenario"]),
        ("run --seed 1 --se", ["--seconds", "--set"]),
        ("run --set period_ms=40 --se", ["--seed", "--seconds", "--set"]),
        ("run hall.yaml --scenario net", ["network-impairment", "network-impairment-mild"]),
        ("run --scenario edge hall.yaml --seed", ["--seed"]),
        ("run --scenario ", ["baseline"]),
        ("run broken.yaml --scenario ", ["baseline"]),
        ("run absent.yaml --scenario ", ["baseline"]),
        ("run runs --scenario ", ["baseline"]),
        ("run --policy d", ["dtp"]),
        ("run hall.yaml --policy L", ["LOC"]),
        ("run hall.yaml --policy cusum+corr", ["cusum+corrected"]),
        ("run hall.yaml --estimator sh", ["shadow"]),
        ("controller --cell hall.yaml --policy L", ["LOC"]),
        ("live pin --cell hall.yaml S", ["SO"]),
        ("live pin hall.yaml S", ["SO"]),
        ("live drain --cell hall.yaml R", ["R1", "R2"]),
        ("live drain hall.yaml R", ["R1", "R2"]),
        ("testbed campaign hall.yaml --policies dtp,at", ["dtp,atp", "dtp,atp-thresholds"]),
        ("testbed campaign hall.yaml --scenarios baseline,edge", ["baseline,edge-cpu-stress"]),
        ("live up hall.yaml --node R", ["R1", "R2"]),
        ("check hall.yaml --node R", ["R1", "R2"]),
        ("agent --cell hall.yaml --node R", ["R1", "R2"]),
        ("live log hall.yaml a", ["agent@R1"]),
        ("live log --cell hall.yaml a", ["agent@R1"]),
        ("live log --state $XDG_STATE_HOME/other hall.yaml p", ["plan@E"]),
        ("new mine --from ", ["canonical", "live"]),
        ("completion ", list(Shell)),
    ],
)
def test_a_line_is_offered_what_fits_there(line: str, wanted: list[str]) -> None:
    assert offered(os.path.expandvars(line)) == wanted


@pytest.mark.parametrize(
    "line",
    [
        "run ",
        "report ru",
        "run odd.yaml --scenario x",
        "live pin ",
        "live pin --cell odd.yaml ",
        "run --nothing ",
        "run hall.yaml --seed ",
        "study --qui",
    ],
)
def test_where_nothing_fits_the_shell_is_left_to_offer_paths(line: str) -> None:
    assert offered(line) == []


def test_every_option_of_every_command_is_offered_but_hidden_ones() -> None:
    told = offered("study --")
    assert {"--out", "--processes", "--json", "--help"} <= set(told)
    assert "--quick" not in told


@pytest.mark.parametrize("shell", Shell)
def test_the_command_prints_the_script(shell: Shell) -> None:
    done = CliRunner().invoke(app, ["completion", shell], prog_name="dwell")
    assert done.exit_code == 0
    assert f"{LINE}=complete_{shell}" in done.stdout


def test_another_shell_is_wrong_input() -> None:
    assert call("completion", "ksh").exit_code == 2


def test_an_answer_imports_neither_tables_nor_compilers() -> None:
    code = (
        "import os, sys; from dwell.cli import main\n"
        "try: main()\n"
        "finally: assert not {'numpy', 'polars', 'scipy', 'zenoh'} & sys.modules.keys()"
    )
    words = "dwell run hall.yaml --scenario net"
    asked = {LINE: "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "4"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=os.environ | asked
    )
    assert done.stdout.splitlines() == ["network-impairment", "network-impairment-mild"]


# ------------------------------------------------------------------------- in real shells

START = {
    Shell.BASH: ("bash", "--norc", "--noprofile", "-i"),
    Shell.ZSH: ("zsh", "-f", "-i"),
    Shell.FISH: ("fish", "--no-config", "-i"),
}
READ = {
    Shell.BASH: "source <(dwell completion bash)",
    Shell.ZSH: "autoload -Uz compinit; compinit -u -D; source <(dwell completion zsh)",
    Shell.FISH: "dwell completion fish | source",
}


class Terminal:
    """A shell on a terminal of its own, with the script read."""

    def __init__(self, shell: Shell) -> None:
        child, self._terminal = pty.fork()
        if child == 0:
            path = f"{COMMAND.parent}{os.pathsep}{os.environ['PATH']}"
            kept = {"PATH": path, "HOME": os.getcwd(), "TERM": "dumb", "COLUMNS": "200"}
            os.execvpe(START[shell][0], START[shell], kept)
        self._child = child
        self._told = ""
        self.type(f"{READ[shell]}; echo re''ady\r")
        self.until("ready")

    def type(self, text: str) -> None:
        os.write(self._terminal, text.encode())

    def until(self, text: str) -> None:
        """Wait until the terminal shows a text; what it showed before is forgotten."""
        deadline = time.monotonic() + PATIENCE_S
        while text not in self._told:
            wait_s = deadline - time.monotonic()
            if wait_s <= 0 or not select.select([self._terminal], [], [], wait_s)[0]:
                raise AssertionError(f"no {text!r} in {self._told!r}")
            self._told += os.read(self._terminal, 1 << 16).decode(errors="replace")
        self._told = self._told.partition(text)[2]

    def close(self) -> None:
        os.kill(self._child, 9)
        os.waitpid(self._child, 0)
        os.close(self._terminal)


@pytest.mark.skipif(not COMMAND.is_file(), reason="the command dwell is not installed")
@pytest.mark.parametrize("shell", Shell)
def test_a_real_shell_completes(shell: Shell) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    terminal = Terminal(shell)
    try:
        for typed, becomes in (
            ("dwell testbed doc\t", "dwell testbed doctor"),
            ("dwell run ha\t", "dwell run hall.yaml"),
            ("dwell run hall.yaml --scenario edge\t", "--scenario edge-cpu-stress"),
            ("dwell report run\tfir\t", "dwell report runs/first"),
            ("dwell run hall.yaml --out hid\t", "--out hidden.txt"),
            ("dwell run broken.yaml --scenario ed\tge", "--scenario edge"),
        ):
            # Ctrl-A and a word: the line is printed instead of being run.
            terminal.type(f"{typed}\x01echo to''ld \r")
            terminal.until("told dwell")
            terminal.until(becomes.removeprefix("dwell"))
    finally:
        terminal.close()
