"""A page served by a process of its own, and requests to it as bytes."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

from tests.cli.small_cell import environment
from tests.waiting import PATIENCE_S, wait_until

ROOT = Path(__file__).parents[2]


class Answer(NamedTuple):
    """What came back."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def value(self) -> Any:
        return json.loads(self.body)


class Served:
    """A page that is served.

    Parameters
    ----------
    address : str
        As it was printed.
    err : Path
        What it says on stderr.
    """

    def __init__(self, process: subprocess.Popen[bytes], address: str, err: Path) -> None:
        self.process, self.address, self._err = process, address, err
        parts = urlsplit(address)
        assert parts.port is not None
        self.port, self.host = parts.port, parts.netloc
        (self.token,) = parse_qs(parts.query)["token"]
        self.bearer = {"Authorization": f"Bearer {self.token}"}

    @property
    def said(self) -> str:
        """What it has said on stderr."""
        return self._err.read_text(encoding="utf-8")

    def ask(
        self,
        path: str,
        headers: Mapping[str, str] | None = None,
        *,
        method: str = "GET",
        body: bytes = b"",
    ) -> Answer:
        """Ask for a path with exactly these headers, beside `Host` where it is not among them."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        given = {"Host": self.host, **(headers or {})}
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in given.items():
                connection.putheader(name, value)
            if body or method == "POST":
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body or None)
            answer = connection.getresponse()
            lowered = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(answer.status, lowered, answer.read())
        finally:
            connection.close()

    def get(self, path: str) -> Any:
        """Return what a path says, as JSON."""
        answer = self.ask(path, self.bearer)
        assert answer.status == 200, answer
        return answer.value

    def events(self, *, receives: int | None = None) -> socket.socket:
        """Ask for events, with a small buffer if wanted, and read nothing of them."""
        reader = socket.socket()
        reader.settimeout(PATIENCE_S)
        if receives is not None:
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receives)
        reader.connect(("127.0.0.1", self.port))
        head = f"Host: {self.host}\r\nAuthorization: Bearer {self.token}"
        reader.sendall(f"GET /events HTTP/1.1\r\n{head}\r\n\r\n".encode())
        return reader

    def act(self, what: str, about: object, **changes: str | None) -> Answer:
        """Act as the page does; a header that is None is left out."""
        headers = {**self.bearer, "Origin": f"http://{self.host}", "X-Dwell-Act": what, **changes}
        sent = {name.replace("_", "-"): value for name, value in headers.items() if value}
        return self.ask(f"/{what}", sent, method="POST", body=json.dumps(about).encode())


#: Runs a command where some modules, its first word, are not installed.
LACKING = """
import sys
sys.modules.update(dict.fromkeys(sys.argv.pop(1).split(",")))
from dwell.cli import main
main(sys.argv[1:])
"""


def dash(*arguments: str | Path, without: Sequence[str] = ()) -> list[str]:
    """Return the words of a command `dwell dash`, where some modules are not installed."""
    words = ["dash", *map(str, arguments), "--port", "0", "--no-browser"]
    return [sys.executable, "-c", LACKING, ",".join(("none", *without)), *words]


@contextmanager
def serving(folder: Path, *arguments: str | Path, without: Sequence[str] = ()) -> Iterator[Served]:
    """Serve a page with `dwell dash`, at a free port; it has to end when it is told to."""
    with started(folder, dash(*arguments, without=without)) as served:
        yield served


@contextmanager
def started(folder: Path, words: Sequence[str]) -> Iterator[Served]:
    """Start a process that serves a page; it has to end when it is told to."""
    err = folder / "dash.err"
    with err.open("wb") as log:
        process = subprocess.Popen(
            words, cwd=ROOT, stdout=subprocess.PIPE, stderr=log, env=environment()
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline().decode()
        assert line.startswith("http://127.0.0.1:"), err.read_text(encoding="utf-8")
        yield Served(process, line.strip(), err)
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0


def state(page: Served) -> Mapping[str, Any]:
    """Return what the page says of its cell."""
    found: Mapping[str, Any] = page.get("/state?at=0")
    return found


def until_state(page: Served, holds: Callable[[Mapping[str, Any]], object]) -> None:
    """Wait until something holds of the cell."""
    wait_until(lambda: holds(state(page)))
