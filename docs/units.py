"""The page of systemd units, as `dwell live units` makes them: `python -m docs.units` writes it."""

from __future__ import annotations

from pathlib import Path

from dwell import load
from dwell.live.commands.units import unit_texts

ROOT = Path(__file__).parents[1]
PAGE = Path(__file__).with_name("reference") / "units.md"
CELL = ROOT / "examples" / "live" / "cell.yaml"
TEXT = """# What do the systemd units of a live cell contain?

`dwell live units CELL --node NODE` writes the units of a node. These are of the example cell, for
the user `robot`; the controller's unit is for its node only. `python -m docs.units` writes this
page.
"""


def page() -> str:
    """Return the page."""
    problem = load(CELL)
    texts: dict[str, str] = {}
    for node in ("R1", problem.controller_node):
        made = unit_texts(
            problem,
            node,
            Path("/etc/dwell/cell.yaml"),
            user="robot",
            keys=Path("/etc/dwell/keys"),
            program=("/opt/dwell/bin/dwell",),
        )
        texts |= {name: text for name, text in made.items() if node == "R1" or "agent" not in name}
    parts = [f"`/etc/systemd/system/{name}`:\n\n```ini\n{texts[name]}```\n" for name in texts]
    return "\n".join([TEXT, *parts])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
