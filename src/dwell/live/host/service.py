"""Service: reports of an agent or a controller to systemd, and a bound on its log's size."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import MutableMapping
from contextlib import suppress
from pathlib import Path

from dwell.live.host.supervision import LOG_BYTES, shorten_log

#: Variables that systemd sets for a service; the first is systemd's socket (sd_notify(3)).
VARIABLES = "NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC"
#: Period of the watchdog's messages and of the checks of the log.
STEP_S = 1.0


class Service:
    """Reports of an agent or a controller to systemd.

    Removes the variables of systemd from `environment`, so the processes that inherit it do not
    report to systemd. `dwell live up` writes the stderr of the process to ``WHO.log``.
    """

    def __init__(
        self, who: str, environment: MutableMapping[str, str], *, log_bytes: int = LOG_BYTES
    ) -> None:
        address, *_ = [environment.pop(name, "") for name in VARIABLES]
        # An abstract socket begins with a zero byte.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._who, self._log_bytes = who, log_bytes
        self._next_s = 0.0

    def ready(self) -> None:
        """Report that the sessions are open."""
        self._report("READY=1")

    def step(self) -> None:
        """Report once per second that the main loop runs, and shorten the log if it is long."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + STEP_S
        self._report("WATCHDOG=1")
        with suppress(OSError):
            log = Path(os.readlink("/proc/self/fd/2"))
            if log.name == f"{self._who}.log":
                shorten_log(log, self._log_bytes)

    def stopping(self) -> None:
        """Report that the process begins a clean end."""
        self._report("STOPPING=1")

    def _report(self, state: str) -> None:
        if self._address:
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
                systemd.connect(self._address)
                systemd.send(state.encode())
