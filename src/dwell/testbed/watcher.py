"""Watcher: a small process on the controller's host, through which others ask how the cell is.

Whoever makes the testbed is on none of its hosts, and no link leads there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from dwell.errors import DwellError, LiveError
from dwell.testbed.child import Child, Parent, Started

#: Beyond the patience of a question, for the process itself.
SLACK_S = 5.0


class Watcher(Started):
    """Asks a cell's controller, as its parent sees it; a context manager.

    Parameters
    ----------
    cell : Path
        Cell file.
    prefix : sequence of str
        Words of a command that runs what follows on the controller's host.
    """

    def __init__(self, cell: Path, prefix: Sequence[str] = ()) -> None:
        self._cell = cell
        self._child = Child("dwell.testbed.watcher", f"watcher of {cell}", prefix=prefix)

    def start(self) -> None:
        """Start it.

        Raises
        ------
        LiveError
            If it does not start, or the cell file cannot be read.
        """
        self._child.start({"cell": str(self._cell)})

    def stop(self) -> None:
        """End it; safe to call twice."""
        self._child.stop()

    def status(self, patience_s: float) -> Mapping[str, Any]:
        """Return how the cell is.

        Raises
        ------
        LiveError
            If nobody answers.
        """
        return self.ask("status", patience_s=patience_s)

    def ask(self, what: str, about: str = "", *, patience_s: float = 3.0) -> Mapping[str, Any]:
        """Ask as `OperatorClient.ask` does.

        Raises
        ------
        LiveError
            If it is refused, or nobody answers.
        """
        request = {"what": what, "about": about, "patience_s": patience_s}
        answer = self._child.ask(request, patience_s + SLACK_S)
        return cast("Mapping[str, Any]", answer["status"])


def main() -> None:
    """Answer until the parent ends, or wants this to."""
    import dwell
    from dwell.live.operator_client import OperatorClient
    from dwell.live.security import INSECURE
    from dwell.testbed.processes import without_keys

    parent = Parent()
    try:
        settings = parent.receive()
        try:
            # The testbed's hosts lead nowhere but to each other.
            environment = {**without_keys(), INSECURE: "1"}
            visitor = OperatorClient(dwell.load(cast("str", settings["cell"])), environment)
        except DwellError as error:
            parent.answer({"error": str(error)})
            return
        parent.answer({})
        with visitor:
            while True:
                asked = cast("dict[str, Any]", parent.receive())
                try:
                    status = visitor.ask(
                        asked["what"], asked["about"], patience_s=asked["patience_s"]
                    )
                    parent.answer({"status": status})
                except LiveError as error:
                    parent.answer({"error": str(error)})
    except EOFError:
        pass


if __name__ == "__main__":
    main()
