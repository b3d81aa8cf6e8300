"""`dwell dash CELL --mcap FILE` beside a real cell."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.live_cell import RealCell
from tests.dash.served import serving, until
from tests.record.test_mcap_file import metadata, read


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCell]:
    cell = RealCell(tmp_path_factory.mktemp("live"))
    try:
        cell.begin()
        yield cell
    finally:
        cell.close()


def test_a_live_cell_is_recorded_and_its_numbers_are_read(cell: RealCell, tmp_path: Path) -> None:
    file, token = tmp_path / "cell.mcap", tmp_path / "kept" / "dwell.token"
    token.parent.mkdir()
    with serving(tmp_path, cell.file, "--mcap", file, "--token", token) as page:
        assert token.stat().st_mode & 0o777 == 0o600
        assert token.read_text() == page.token

        def numbers() -> str:
            return page.ask("/metrics", page.bearer).body.decode()

        until(lambda: re.search(r'cycles_total\{.*outcome="actuated"\} \d\d\.0', numbers()))
        until(lambda: 'placement="LOC"' in numbers() and "dwell_utilisation_ratio{" in numbers())
        # Whoever watches may stand still: the cell goes on.
        page.process.send_signal(signal.SIGSTOP)
        try:
            number = cell.until(lambda status: status["window"])["window"]["number"]
            cell.until(lambda status: status["window"]["number"] >= number + 3)
        finally:
            page.process.send_signal(signal.SIGCONT)
    found = metadata(file)
    published, recorded, dropped = (int(found[n]) for n in ("published", "recorded", "dropped"))
    assert published == recorded + dropped
    assert f"{recorded} cycles and windows recorded + {dropped} dropped = {published}" in page.said
    topics: dict[str, list[int]] = {}
    for topic, at_ns, _ in read(file):
        topics.setdefault(topic, []).append(at_ns)
    assert topics.keys() == {"/cycles", "/windows", "/decisions", "/jobs"}
    assert len(topics["/cycles"]) + len(topics["/windows"]) == recorded
    # The same token the next time.
    with serving(tmp_path, cell.file, "--token", token) as page:
        assert page.token == token.read_text()
        assert page.ask("/metrics", page.bearer).status == 200
