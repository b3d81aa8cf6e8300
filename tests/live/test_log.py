"""Log: floods are left out, and nothing that a terminal could mistake is written."""

from __future__ import annotations

from dwell.live.log import Log


def test_a_log_leaves_out_floods() -> None:
    lines: list[str] = []
    now_s = 0.0
    log = Log(lines.append, every_s=1.0, clock=lambda: now_s)
    for number in range(30):
        log(f"line {number}")
        now_s += 0.125
    assert [line.split(" (")[0] for line in lines] == ["line 0", "line 8", "line 16", "line 24"]
    assert lines[1] == "line 8 (and 7 lines before it)"
