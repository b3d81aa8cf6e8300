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
#: Content of channels whose type of message serves several channels, or has no fields.
CONTENT = {
    "in": "Input of a worker: a stamp, or the output of a task.",
    "sink": "Command for an actuator.",
    "done": "End of a cycle at a sink.",
    "ended": "End of a job before a sink, in a cycle or a shadow.",
    "missed": "Request of the stamper to the relay for beats that it misses.",
    "frame": "Request of the first source for a cycle, under `release: frames`.",
    "value": "Newest value of a sampled flow, from an old node of its target.",
    "ask": "Request of an operator to the controller.",
    "look": "Request of an operator or observer for the status.",
    "carried": "Second copies for the stamper.",
    "gathered": "Second copies for the controller.",
}
TEXT = """# Which messages does a live cell send?

One kind per channel. The [live protocol](../live-protocol.md) has the rules,
[security](security.md) the rights. Senders are the members of the example cell that a certificate
lets send. `python -m docs.messages` writes this page.

| channel | content | senders | receivers | signed | sent twice |
|---|---|---|---|---|---|
{rows}
"""


def rows() -> Iterator[str]:
    """Yield a row for each channel."""
    problem = dwell.load(CELL)
    for word, channel in CHANNELS.items():
        content = CONTENT.get(word) or inspect.getdoc(channel.payload) or ""
        senders = sorted({who for _, some in channel.senders(problem) for who in some})
        cells = (
            f"`{word}`",
            content.partition("\n")[0],
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
