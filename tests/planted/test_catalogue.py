"""Every fault of the catalogue can be planted: a rearrangement keeps it so (see README.md)."""

from __future__ import annotations

import re
from collections import Counter

import pytest

from tests.planted.catalogue import ROOT, Fault, catalogue, section_of, sections

#: Sections that promise nothing a test could find broken: words, figures that were measured, and
#: what the real processes of `make faults` and `make soak` show alone; and those whose test plants
#: faults of its own.
WITHOUT = {
    "docs/guard.md": set[str](),
    "docs/reference/faults.md": {"What holds"},
    "docs/concepts.md": {"Concepts", "Words"},
    "docs/background/statistics.md": {
        "Which statistics does Dwell compute?",
        "References",
    },
}
#: The rules of a live cell are a numbered list of their page.
RULES = re.compile(r"^\d+\. \*\*(.+?)\*\*", re.MULTILINE)

CATALOGUE = catalogue()
FAULTS = [(page, fault) for page, faults in CATALOGUE.items() for fault in faults]


def test_every_fault_has_a_name_of_its_own() -> None:
    assert [name for name, n in Counter(f.fault for _, f in FAULTS).items() if n > 1] == []


@pytest.mark.parametrize(("page", "fault"), FAULTS, ids=[fault.fault for _, fault in FAULTS])
def test_its_text_stands_once_in_its_file_and_its_promise_on_its_page(
    page: str, fault: Fault
) -> None:
    assert fault.flaw() == ""
    assert section_of(fault, page), f"{page} does not say {fault.promise!r}"


@pytest.mark.parametrize("test", sorted({test for _, fault in FAULTS for test in fault.tests}))
def test_the_tests_that_find_it_exist(test: str) -> None:
    file, _, name = test.partition("::")
    text = (ROOT / file).read_text(encoding="utf-8")
    assert not name or f"def {name}(" in text


@pytest.mark.parametrize("page", WITHOUT)
def test_every_section_of_a_page_has_a_fault(page: str) -> None:
    having = {section_of(fault, page) for fault in CATALOGUE[page]}
    assert sections(page).keys() - having == WITHOUT[page]


def test_every_rule_of_a_live_cell_has_a_fault() -> None:
    page = "docs/live-protocol.md"
    rules = RULES.findall((ROOT / page).read_text(encoding="utf-8"))
    assert len(rules) == 13
    assert set(rules) - {section_of(fault, page) for fault in CATALOGUE[page]} == set()
