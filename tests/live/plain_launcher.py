"""A supervisor whose processes are any commands, and are not forked from a server."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from dwell.live.host.launcher import ForkServer
from dwell.live.host.supervision import Supervisor


class PlainLauncher(ForkServer):
    """Runs commands as they are."""

    def __init__(self) -> None:
        super().__init__([])

    def ready(self) -> bool:
        """Return that it can start processes."""
        return True

    def start(self, command: Sequence[str], log: BinaryIO) -> subprocess.Popen[bytes]:
        """Run a command."""
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=self.environment,
            process_group=0,
        )


def supervise(folder: Path, say: Callable[[str], None], **options: Any) -> Supervisor:
    """Return a supervisor of commands."""
    return Supervisor(folder, say, PlainLauncher(), **options)
