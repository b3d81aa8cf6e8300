"""What was lost of a live run's journal, for who opens it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from dwell.report.formatting import listed

__all__ = ["recovery"]


def recovery(told: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on what is not in a run because something was killed or damaged.

    Parameters
    ----------
    told : mapping
        What its meta say under ``recovered``.
    """
    opened = int(told.get("opened", 1))
    if opened > 1:
        yield f"The controller was started {opened} times while the run went on."
    lost = [
        text
        for name, text in (
            ("torn_bytes", "{} bytes at the journal's end were torn by a kill"),
            ("damaged_bytes", "{} bytes within the journal were damaged"),
        )
        if told.get(name)
        for text in [text.format(told[name])]
    ]
    if lost:
        yield f"{listed(lost)}; what they said is not here."
    if told.get("missing_windows"):
        yield f"Windows missing from the run: {told['missing_windows']}."
    if told and not told.get("sealed", True):
        yield (
            "The run was not closed: it goes on, or its controller was killed. This is what its "
            "journal holds; what came after its last window is not here."
        )
