"""Watcher: a small process on the controller's host that requests the status of the cell.

The process that creates the testbed runs outside its hosts, and has no link to them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dwell.live.local.child import Child, Parent

#: Additional timeout for the watcher's own answer.
SLACK_S = 5.0


class Watcher(Child):
    """Context manager that runs a watcher as a child process.

    Parameters
    ----------
    cell : Path
        Cell file.
    prefix : sequence of str
        Command prefix that runs the process on the controller's host.
    """

    def __init__(self, cell: Path, prefix: Sequence[str] = ()) -> None:
        super().__init__("dwell_lab.testbed.watcher", f"watcher of {cell}", cell, prefix=prefix)

    def status(self, patience_s: float) -> Mapping[str, Any]:
        """Return the status of the cell; raise a LiveError without an answer."""
        status: Mapping[str, Any] = self.ask(patience_s, patience_s + SLACK_S)
        return status


def main() -> None:
    """Answer until the parent ends, or requests the end."""
    from dwell.cellfile import load
    from dwell.live.host.operator_client import OperatorClient
    from dwell.live.host.security import INSECURE
    from dwell.live.local.processes import without_keys

    with ExitStack() as stack:

        def begin(cell: Path) -> Callable[[float], Mapping[str, Any]]:
            # The testbed's hosts can reach only each other.
            client = OperatorClient(load(cell), {**without_keys(), INSECURE: "1"})
            stack.enter_context(client)
            return lambda patience_s: client.ask("status", patience_s=patience_s)

        Parent().serve(begin)


if __name__ == "__main__":
    main()
