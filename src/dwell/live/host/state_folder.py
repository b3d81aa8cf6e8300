"""The state folder: what a computer keeps of its cells, a folder each, with one for each node."""

from __future__ import annotations

import os
from pathlib import Path


def state_root(given: Path | None = None) -> Path:
    """Return the folder that has one for each cell; by default below ``~/.local/state``."""
    if given is not None:
        return given.resolve()
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "dwell"


def logs(root: Path) -> dict[str, dict[str, Path]]:
    """Return the logs of processes below a state folder, by process and cell."""
    found: dict[str, dict[str, Path]] = {}
    for pattern in ("*/*.log", "*/*/*.log"):
        for path in sorted(root.glob(pattern)):
            cell = path.relative_to(root).parts[0]
            found.setdefault(path.stem, {})[cell] = path
    return found
