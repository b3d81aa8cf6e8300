"""Watcher: a small process on the controller's host, through which others ask how the cell is.

Whoever makes the testbed is on none of its hosts, and no link leads there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from dwell.errors import DwellError, LiveError
from dwell.testbed.child import Child, Parent

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
        name, settings = f"watcher of {cell}", {"cell": str(cell)}
        super().__init__("dwell.testbed.watcher", name, settings, prefix=prefix)

    def status(self, patience_s: float) -> Mapping[str, Any]:
        """Return how the cell is.

        Raises
        ------
        LiveError
            If nobody answers.
        """
        answer = self.ask({"patience_s": patience_s}, patience_s + SLACK_S)
        return cast("Mapping[str, Any]", answer["status"])


def main() -> None:
    """Answer until the parent ends, or wants this to."""
    from dwell.cellfile import load
    from dwell.live.operator_client import OperatorClient
    from dwell.live.security import INSECURE
    from dwell.testbed.processes import without_keys

    parent = Parent()
    try:
        settings = parent.receive()
        try:
            # The testbed's hosts lead nowhere but to each other.
            environment = {**without_keys(), INSECURE: "1"}
            visitor = OperatorClient(load(cast("str", settings["cell"])), environment)
        except DwellError as error:
            parent.answer({"error": str(error)})
            return
        parent.answer({})
        with visitor:
            while True:
                patience_s = cast("float", parent.receive()["patience_s"])
                try:
                    parent.answer({"status": visitor.ask("status", patience_s=patience_s)})
                except LiveError as error:
                    parent.answer({"error": str(error)})
    except EOFError:
        pass


if __name__ == "__main__":
    main()
