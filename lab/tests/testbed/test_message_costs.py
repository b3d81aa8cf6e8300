"""Message costs: what links take beyond what is asked of them."""

from __future__ import annotations

from pathlib import Path

from lab.tests.testbed.calibrated import calibrate
from tests.cells.known_cost import (
    CELL,
)


def test_links_that_nobody_emulates_have_their_own_delays(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    lan = tmp_path / "lan.yaml"
    lan.write_text(CELL.replace("delay_ms: {lognormal: {mean: 0.7, cv: 0.3}}", "delay_ms: 0"))
    said: list[str] = []
    found = calibrate(lan, folders[:2], tmp_path / "out.yaml", emulated=False, say=said.append)
    # Under a quota a message also waits for its sender's and its receiver's next period.
    assert 0.9 < found.report["links"]["R1->E"]["mean_ms"] < 3.5
    assert any(line.startswith("R1->E:") for line in said)
