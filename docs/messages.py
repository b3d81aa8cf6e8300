"""The page of messages, from the channels of a live cell: `python -m docs.messages` writes it."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path

import dwell
from dwell.live.wire.channels import CHANNELS

ROOT = Path(__file__).parents[1]
PAGE = Path(__file__).with_name("reference") / "messages.md"
CELL = ROOT / "examples" / "live" / "cell.yaml"
TEXT = """# Which messages does a live cell send?

One kind per channel. The [live protocol](../live-protocol.md) has the rules,
[security](security.md) the rights. Senders are those of the example cell, by their certificates;
operators and observers also send `ask` and `look`. `python -m docs.messages` writes this page.

| channel | content | senders | receivers | signed | sent twice |
|---|---|---|---|---|---|
{rows}
"""


def rows() -> Iterator[str]:
    """Yield a row for each channel."""
    problem = dwell.load(CELL)
    for word, channel in CHANNELS.items():
        content = (inspect.getdoc(channel.payload) or "").partition("\n")[0]
        known = channel.payload.__module__.startswith("dwell.")
        senders = sorted({who for _, some in channel.senders(problem) for who in some})
        cells = (
            f"`{word}`",
            content if known else "no content",
            ", ".join(senders),
            ", ".join(channel.receivers),
            "yes" if channel.signer else "",
            "yes" if channel.twice else "",
        )
        yield f"| {' | '.join(cells)} |"


def page() -> str:
    """Return the page."""
    return TEXT.format(rows="\n".join(rows()))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
