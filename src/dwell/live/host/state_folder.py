"""State folder of a computer: one folder per cell, and in it one folder per node."""

from __future__ import annotations

import os
from pathlib import Path


def state_root(given: Path | None = None) -> Path:
    """Return the folder with one folder per cell [default: ``~/.local/state/dwell``]."""
    if given is not None:
        return given.resolve()
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "dwell"


def logs(root: Path) -> dict[str, dict[str, Path]]:
    """Return the logs of the processes in a state folder, by process and cell."""
    found: dict[str, dict[str, Path]] = {}
    for pattern in ("*/*.log", "*/*/*.log"):
        for path in sorted(root.glob(pattern)):
            cell = path.relative_to(root).parts[0]
            found.setdefault(path.stem, {})[cell] = path
    return found
