"""Write down again what a rearrangement must not change: `python -m tests.regression WHAT...`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from tests.regression import commands, exact, messages, old_runs, paper, runs


def _write_commands() -> None:
    commands.FILE.write_text(commands.surface(), encoding="utf-8")
    commands.HELPS.write_text(commands.helps(), encoding="utf-8")


def _write_messages() -> None:
    messages.FILE.write_text(messages.messages(), encoding="utf-8")


def _write_runs() -> None:
    for example in (*runs.EXAMPLES, *runs.DEFAULTS):
        print(f"{example}: {runs.write(example)} runs")


def _write_paper(folder: str, file: Path) -> None:
    print(f"{paper.write(Path(folder) / 'runs', file)} means")


KINDS: dict[str, Callable[[], None]] = {
    "commands": _write_commands,
    "messages": _write_messages,
    "runs": _write_runs,
    "old-runs": old_runs.write,
}

USAGE = f"""\
usage: python -m tests.regression {{{",".join(KINDS)}}}...
       python -m tests.regression paper|paper-full FOLDER     of `make paper`
       python -m tests.regression exact FILE                  to compare two versions"""

if __name__ == "__main__":
    words = sys.argv[1:]
    if len(words) == 2 and words[0] in ("paper", "paper-full"):
        _write_paper(words[1], paper.QUICK if words[0] == "paper" else paper.FULL)
    elif len(words) == 2 and words[0] == "exact":
        print(exact.write(Path(words[1])))
    elif words and KINDS.keys() >= set(words):
        for kind in words:
            KINDS[kind]()
    else:
        sys.exit(USAGE)
