"""What an agent starts: ``python -m dwell.cli.process --cell FILE --who NAME --state FOLDER``."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path

from dwell.errors import DwellError

__all__ = ["command", "main"]


def command(cell: Path, who: str, state: Path) -> list[str]:
    """Return the command of a process of a cell."""
    files = ["--cell", str(cell), "--state", str(state)]
    return [sys.executable, "-m", "dwell.cli.process", "--who", who, *files]


def main(arguments: list[str] | None = None) -> int:
    """Run the process until it is told to end; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", type=Path, required=True)
    parser.add_argument("--who", required=True)
    parser.add_argument("--state", type=Path, required=True)
    asked = parser.parse_args(arguments)
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    # The user's stages lie beside their cell file.
    sys.path.insert(0, str(asked.cell.resolve().parent))
    try:
        from dwell.io import load
        from dwell.live.leash import end_with_owner
        from dwell.live.process import run_process

        end_with_owner(stopped)
        run_process(load(asked.cell), asked.who, asked.state, stopped)
    except DwellError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
