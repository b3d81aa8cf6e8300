"""Server of a page: port, address, browser and shutdown."""

from __future__ import annotations

import asyncio
import errno
import html
import logging
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from dwell.dash.gate import Gate, new_token
from dwell.dash.server import Dash
from dwell.errors import DwellError

LOOPBACK = "127.0.0.1"
#: Largest number of connections, and the longest wait for the first request of a connection.
MOST_CONNECTIONS, REQUEST_S = 512, 10.0
#: Longest wait for open requests at shutdown.
GRACE_S = 1


def serve(
    dash: Dash, port: int, *, browser: bool, say: Callable[[str], None], token: str | None = None
) -> None:
    """Serve a page until SIGINT or SIGTERM.

    The only line on stdout is the address with the token.

    Parameters
    ----------
    port : int
        Port, or 0 for any free port.
    browser : bool
        Whether to open the page in a browser.
    say : callable
        Prints a line for people.
    token : str, optional
        Token of the page; default: a new token.

    Raises
    ------
    DwellError
        If the port is not available.
    KeyboardInterrupt
        After SIGINT.
    """
    with _listening(port) as listener:
        gate = Gate(dash.application(), listener.getsockname()[1], token or new_token())
        address = f"http://{LOOPBACK}:{gate.port}/?token={gate.token}"
        with _opened(address, say) if browser else nullcontext():
            caught = asyncio.run(_served(gate, dash, listener, lambda: print(address, flush=True)))
    if caught == signal.SIGINT:
        raise KeyboardInterrupt


@contextmanager
def _listening(port: int) -> Iterator[socket.socket]:
    try:
        listener = socket.create_server((LOOPBACK, port), backlog=MOST_CONNECTIONS)
    except OSError as error:
        why = "is taken" if error.errno == errno.EADDRINUSE else f"fails ({error.strerror})"
        raise DwellError(f"port {port} of {LOOPBACK} {why}; --port 0 takes a free port") from None
    with listener:
        yield listener


class _Protocol(H11Protocol):
    """HTTP protocol that closes a connection without a request after `REQUEST_S`."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.loop.call_later(REQUEST_S, self._close_if_silent)

    def _close_if_silent(self) -> None:
        if self.cycle is None:
            self.transport.close()


class _Server(uvicorn.Server):
    """A server that leaves signals to its caller."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def _served(
    gate: Gate, dash: Dash, listener: socket.socket, ready: Callable[[], None]
) -> int | None:
    """Serve until a signal and return it; call `ready` once the signal handlers are installed."""
    logging.getLogger("uvicorn").setLevel(logging.ERROR)
    server = _Server(
        uvicorn.Config(
            gate,
            http=_Protocol,
            ws="none",
            log_config=None,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            limit_concurrency=MOST_CONNECTIONS,
            timeout_graceful_shutdown=GRACE_S,
        )
    )
    caught: list[int] = []
    closing: list[asyncio.Task[None]] = []

    def end(number: int) -> None:
        caught.append(number)
        closing.append(loop.create_task(dash.close()))
        server.should_exit = True

    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, end, number)
    ready()
    await server.serve([listener])
    return caught[0] if caught else None


@contextmanager
def _opened(address: str, say: Callable[[str], None]) -> Iterator[None]:
    """Open an address in a browser, through a temporary file.

    Other users can read the arguments of a process, and the address contains the token. The browser
    therefore opens a file that only this user can read; the file redirects to the address.
    """
    if sys.platform == "linux" and not (os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}):
        say("no display here: open the address in a browser; from elsewhere, through `ssh -L`")
        yield
        return
    folder = Path(tempfile.mkdtemp(prefix="dwell-dash-"))
    try:
        page = folder / "open.html"
        escaped = html.escape(address)
        descriptor = os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(
                '<!doctype html><meta charset="utf-8"><title>Dwell</title>'
                '<meta name="referrer" content="no-referrer">'
                f'<meta http-equiv="refresh" content="0; url={escaped}">'
                f'<a href="{escaped}">Open the page</a>\n'
            )
        # A thread: `webbrowser.open` may block, and the server must run before the page loads.
        threading.Thread(target=_show, args=(page.as_uri(), say), daemon=True).start()
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _show(address: str, say: Callable[[str], None]) -> None:
    with suppress(webbrowser.Error, OSError):
        if webbrowser.open(address):
            return
    say("no browser could be started: open the address in one")
