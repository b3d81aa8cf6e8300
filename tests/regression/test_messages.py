"""Every message on a fault, as it was written down."""

from __future__ import annotations

from tests.regression.messages import FILE, messages


def test_every_fault_is_said_as_it_was_written_down() -> None:
    """`python -m tests.regression messages` writes it again."""
    assert messages().splitlines() == FILE.read_text(encoding="utf-8").splitlines()
