"""Watcher: a small process on the controller's host, through which others ask how the cell is.

Whoever makes the testbed is on none of its hosts, and no link leads there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dwell.live.local.child import Child, Parent

#: Beyond the patience of a question, for the process itself.
SLACK_S = 5.0


class Watcher(Child):
    """Asks a cell's controller, as its parent sees it; a context manager.

    Parameters
    ----------
    cell : Path
        Cell file.
    prefix : sequence of str
        Words of a command that runs what follows on the controller's host.
    """

    def __init__(self, cell: Path, prefix: Sequence[str] = ()) -> None:
        super().__init__("dwell_lab.testbed.watcher", f"watcher of {cell}", cell, prefix=prefix)

    def status(self, patience_s: float) -> Mapping[str, Any]:
        """Return how the cell is.

        Raises
        ------
        LiveError
            If nobody answers.
        """
        status: Mapping[str, Any] = self.ask(patience_s, patience_s + SLACK_S)
        return status


def main() -> None:
    """Answer until the parent ends, or wants this to."""
    from dwell.cellfile import load
    from dwell.live.host.operator_client import OperatorClient
    from dwell.live.host.security import INSECURE
    from dwell.live.local.processes import without_keys

    with ExitStack() as stack:

        def begin(cell: Path) -> Callable[[float], Mapping[str, Any]]:
            # The testbed's hosts lead nowhere but to each other.
            client = OperatorClient(load(cell), {**without_keys(), INSECURE: "1"})
            stack.enter_context(client)
            return lambda patience_s: client.ask("status", patience_s=patience_s)

        Parent().serve(begin)


if __name__ == "__main__":
    main()
