"""Log: floods are left out, and nothing that a terminal could mistake is written."""

from __future__ import annotations

import json
import subprocess
import sys
from datetime import datetime

from dwell.live.log import Log
from tests.cli.small_cell import environment

#: Two threads that print, and one that fails.
PRINTS = """
import sys, threading
from dwell.live.log import log_as_json, say
log_as_json("agent@R1")
def run(name):
    for number in range(100):
        say(f"warning: {name} {number}")
threads = [threading.Thread(target=run, args=(name,)) for name in "ab"]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
say("\\x1b[2Jdrawn")
raise ValueError("the end")
"""


def test_a_log_leaves_out_floods() -> None:
    lines: list[str] = []
    now_s = 0.0
    log = Log(lines.append, every_s=1.0, clock=lambda: now_s)
    for number in range(30):
        log(f"line {number}")
        now_s += 0.125
    assert [line.split(" (")[0] for line in lines] == ["line 0", "line 8", "line 16", "line 24"]
    assert lines[1] == "line 8 (and 7 lines before it)"


def test_a_log_in_json_has_a_document_on_every_line() -> None:
    """Whoever prints: threads at the same time, and Python where an exception ends the process."""
    done = subprocess.run(
        [sys.executable, "-c", PRINTS], capture_output=True, check=False, env=environment()
    )
    documents = [json.loads(line) for line in done.stderr.splitlines()]
    assert {document["process"] for document in documents} == {"agent@R1"}
    assert all(datetime.fromisoformat(document["time"]).tzinfo for document in documents)
    warnings = [one["message"] for one in documents if one["level"] == "warning"]
    assert sorted(warnings) == sorted(f"{name} {number}" for name in "ab" for number in range(100))
    rest = [one["message"] for one in documents if one["level"] != "warning"]
    assert rest[0] == "\\x1b[2Jdrawn"
    assert rest[-1] == "ValueError: the end"
