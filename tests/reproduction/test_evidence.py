"""Pages of evidence name their origin."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from reproduction.evidence.measured_on import measured_on

PAGES = sorted(Path("reproduction/evidence").glob("*.md"))
ORIGIN = re.compile(
    r"(Last m|M)easured on \d{4}-\d\d-\d\d \(.+, commit [0-9a-f]{7,12}\)\.", re.DOTALL
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_names_day_machine_and_commit_of_its_measurements(page: Path) -> None:
    title, beginning, _ = page.read_text(encoding="utf-8").split("\n\n", 2)
    assert title.startswith("# ")
    assert ORIGIN.match(beginning)


def test_written_origin_is_of_that_form() -> None:
    assert ORIGIN.fullmatch(measured_on())
