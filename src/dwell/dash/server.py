"""Web application of the page: data of its cells, and commands of the user."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import re
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from dwell.dash.paged_cell import PagedCell, Plain
from dwell.errors import DwellError

if TYPE_CHECKING:
    from dwell.dash.recorded_fleet import RecordedFleet
    from dwell.dash.runs_folder import RunsFolder

_LOG = logging.getLogger(__name__)

STATIC = Path(__file__).with_name("static")
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
#: Period of reading the cells: while a page of a live cell is open, and otherwise.
TICK_S, IDLE_TICK_S = 0.1, 1.0
#: Largest number of open pages, and the longest time to send one event to a page.
MOST_READERS, READER_S = 32, 10.0
#: Time without events after which a comment is sent, to keep and check the connection.
QUIET_S = 15.0
MOST_BODY_BYTES = 4_096
#: Number of a cell in a request.
PLACE = re.compile(r"[0-9]{1,6}")
LEAST_BINS, MOST_BINS = 10, 1_500

#: Sends a command, by its name and argument; returns the controller's status.
Act: TypeAlias = Callable[[str, str], Mapping[str, Any]]

#: Commands, and the key of their argument in the body of the request.
ACTS = {"pin": "candidate", "unpin": None, "drain": "node", "undrain": "node"}


@dataclass(slots=True)
class Dash:
    """Cells on one page, or a fleet or a folder of runs with one page per cell or run.

    Parameters
    ----------
    cells : sequence of PagedCell
        Cells on one time line.
    fleet : RecordedFleet, optional
        Shown instead of `cells`.
    runs : RunsFolder, optional
        Listed instead of `cells`.
    line : str
        Unit of the time line of two runs, and its reason; empty for one run.
    act : callable, optional
        Sends commands to the first cell; without it the page is read-only.
    read_only : str
        Reason why the page is read-only.
    difference : callable, optional
        Computes V_D of the second cell minus V_D of the first between two places, in bins; its
        arguments are begin, end and the largest number of bins.
    metrics : callable, optional
        Returns the metrics of the first cell and their MIME type, by the header `Accept`.
    """

    cells: Sequence[PagedCell] = ()
    fleet: RecordedFleet | None = None
    runs: RunsFolder | None = None
    line: str = ""
    act: Act | None = None
    read_only: str = "this page is read-only; `dwell dash --control` allows commands"
    difference: Callable[[float, float, int], Plain] | None = None
    metrics: Callable[[str], tuple[bytes, str]] | None = None
    _news: asyncio.Condition = field(default_factory=asyncio.Condition, repr=False)
    _tick: tuple[int, bytes] = field(default=(0, b""), repr=False)
    _readers: int = field(default=0, repr=False)
    _over: bool = field(default=False, repr=False)

    def application(self) -> Starlette:
        """Return the ASGI application; `dwell.dash.gate` controls the access to it."""
        routes = [
            *(Route(path, partial(_file, "index.html")) for path in ("/", "/cell/{place:int}")),
            *(Route(f"/static/{name}", partial(_file, name)) for name in static_files()),
            Route("/cells", self._cells),
            Route("/runs", self._runs),
            Route("/lines", self._lines),
            Route("/view", self._view),
            Route("/state", self._state),
            Route("/difference", self._difference),
            Route("/jobs", self._jobs),
            Route("/events", self._events),
            Route("/metrics", self._metrics),
            Route("/healthz", _alive),
            Route("/readyz", self._ready),
            *(Route(f"/{what}", partial(self._act, what), methods=["POST"]) for what in ACTS),
        ]
        handlers = {HTTPException: _refused, DwellError: _failed}
        app = Starlette(routes=routes, lifespan=self._ticking, exception_handlers=handlers)
        app.router.redirect_slashes = False
        return app

    # ---------------------------------------------------------------------- data

    async def _cells(self, request: Request) -> Response:
        fleet = runs = None
        cells: Sequence[PagedCell]
        if self.runs is not None:
            cells = [await self._cell(request)] if "cell" in request.query_params else []
            runs = {"name": self.runs.name} if cells else self.runs.described()
        elif self.fleet is None:
            cells = self.cells
        elif "cell" in request.query_params:
            cells = [await self._cell(request)]
            fleet = {"name": self.fleet.name}
        else:
            cells = []
            fleet = await run_in_threadpool(self.fleet.described)
        control = self.act is not None
        return JSONResponse(
            {
                "cells": [await run_in_threadpool(cell.described) for cell in cells],
                "fleet": fleet,
                "runs": runs,
                "line": self.line,
                "difference": self.difference is not None,
                "control": control,
                "read_only": None if control else self.read_only,
            }
        )

    async def _runs(self, request: Request) -> Response:
        runs, since = self._folder(), _number(request, "since", 0.0)
        return JSONResponse(runs.rows(max(int(since), 0)))

    async def _lines(self, request: Request) -> Response:
        runs, named = self._folder(), request.query_params.get("cells", "").split(",")
        places = [int(name) for name in named if PLACE.fullmatch(name)]
        if len(places) != len(named) or max(places) >= runs.count:
            raise HTTPException(HTTPStatus.BAD_REQUEST, "cells must be numbers of runs")
        return JSONResponse(await run_in_threadpool(runs.lines, places))

    def _folder(self) -> RunsFolder:
        if self.runs is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, "this page lists no runs")
        return self.runs

    async def _view(self, request: Request) -> Response:
        shown, begin, end = await self._shown(request), *_places(request)
        return JSONResponse(await run_in_threadpool(shown.view, begin, end, _bins(request)))

    async def _difference(self, request: Request) -> Response:
        if self.difference is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, "this page does not compare two runs")
        begin, end = _places(request)
        return JSONResponse(await run_in_threadpool(self.difference, begin, end, _bins(request)))

    async def _state(self, request: Request) -> Response:
        shown = await self._shown(request)
        return JSONResponse(await run_in_threadpool(shown.state, _number(request, "at")))

    async def _jobs(self, request: Request) -> Response:
        cell, begin, end = await self._cell(request), *_places(request)
        return JSONResponse(await run_in_threadpool(cell.jobs, begin, end))

    async def _shown(self, request: Request) -> PagedCell | RecordedFleet:
        """Return the cell that a request names; the page's fleet if it names none."""
        if self.fleet is not None and "cell" not in request.query_params:
            return self.fleet
        return await self._cell(request)

    async def _cell(self, request: Request) -> PagedCell:
        name = request.query_params.get("cell", "0")
        place = int(name) if PLACE.fullmatch(name) else -1
        several = self.fleet or self.runs
        if several is not None and 0 <= place < several.count:
            return await run_in_threadpool(several.cell, place)
        if several is None and 0 <= place < len(self.cells):
            return self.cells[place]
        raise HTTPException(HTTPStatus.NOT_FOUND, f"no cell {name[:20]!r}")

    async def _ready(self, _: Request) -> Response:
        """Answer whether the live cells are healthy; the answer has no other data."""
        live = [cell for cell in self.cells if cell.live]
        states = [await run_in_threadpool(cell.state, 0.0) for cell in live]
        well = bool(states) and all(state.get("health") == "ok" for state in states)
        status = HTTPStatus.OK if well else HTTPStatus.SERVICE_UNAVAILABLE
        return PlainTextResponse("ready\n" if well else "not ready\n", status)

    async def _metrics(self, request: Request) -> Response:
        if self.metrics is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, "a recorded run has no metrics")
        accept = request.headers.get("accept", "")
        page, content_type = await run_in_threadpool(self.metrics, accept)
        return Response(page, headers={"content-type": content_type})

    # ------------------------------------------------------------------------- commands

    async def _act(self, what: str, request: Request) -> Response:
        if self.act is None:
            raise HTTPException(HTTPStatus.FORBIDDEN, self.read_only)
        key = ACTS[what]
        about = "" if key is None else await _about(request, key)
        status = await run_in_threadpool(self.act, what, about)
        shown = ("pinned", "drained", "placement", "moving_to")
        return JSONResponse({name: status.get(name) for name in shown})

    # ------------------------------------------------------------------------- events

    @asynccontextmanager
    async def _ticking(self, _: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(self._look_on())
        try:
            yield
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def _look_on(self) -> None:
        """Read the cells periodically; send their new states to all open pages, without waiting."""
        live = any(cell.live for cell in self.cells)
        clock = asyncio.get_running_loop().time
        looked_s = clock()
        while True:
            every_s = TICK_S if live and self._readers else IDLE_TICK_S
            await asyncio.sleep(max(looked_s + every_s - clock(), 0.0))
            looked_s = max(looked_s + every_s, clock() - every_s)
            try:
                news = await run_in_threadpool(self._new_states)
                data = f"data: {json.dumps(news, allow_nan=False)}\n\n".encode()
            except Exception:
                # The next reading may succeed; without events, a page shows that its data are old.
                _LOG.exception("the page's cells cannot be read")
                continue
            if news and self._readers:
                async with self._news:
                    self._tick = self._tick[0] + 1, data
                    self._news.notify_all()

    def _new_states(self) -> list[Plain]:
        """Return the state of each live cell, and the constant data of recorded cells that grew."""
        news = []
        for place, cell in enumerate(self.cells):
            grew = cell.refreshed()
            if cell.live:
                news.append({"cell": place, "grew": grew, "state": cell.state(0.0)})
            elif grew:
                news.append({"cell": place, "grew": True, "described": cell.described()})
        return news

    async def _events(self, _: Request) -> Response:
        if self._readers >= MOST_READERS:
            raise HTTPException(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_READERS} pages are open already"
            )
        return _EventStream(self)

    async def next_tick(self, number: int) -> tuple[int, bytes] | None:
        """Return the newest tick after `number`, or a comment after `QUIET_S`; None at the end."""
        async with self._news:
            with suppress(TimeoutError):
                await asyncio.wait_for(
                    self._news.wait_for(lambda: self._over or self._tick[0] > number), QUIET_S
                )
                return None if self._over else self._tick
        return number, b": quiet\n\n"

    async def close(self) -> None:
        """End all event streams."""
        async with self._news:
            self._over = True
            self._news.notify_all()

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[None]:
        """Count an event stream while it is open."""
        self._readers += 1
        try:
            yield
        finally:
            self._readers -= 1


class _EventStream(Response):
    """Server-sent events to one page: only the newest; a page that does not read is dropped."""

    def __init__(self, dash: Dash) -> None:
        super().__init__()
        self._dash = dash

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        gone = asyncio.create_task(_gone(receive))
        async with self._dash.reading():
            told = asyncio.create_task(self._tell(send))
            _, waiting = await asyncio.wait({gone, told}, return_when=asyncio.FIRST_COMPLETED)
            for task in waiting:
                task.cancel()
            for task in (gone, told):
                with suppress(asyncio.CancelledError, TimeoutError):
                    await task

    async def _tell(self, send: Send) -> None:
        headers = [(b"content-type", b"text/event-stream")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        tick: tuple[int, bytes] | None = (0, b"retry: 1000\n\n")
        while tick is not None:
            message = {"type": "http.response.body", "body": tick[1], "more_body": True}
            await asyncio.wait_for(send(message), READER_S)
            tick = await self._dash.next_tick(tick[0])
        await send({"type": "http.response.body", "body": b""})


async def _gone(receive: Receive) -> None:
    """Wait until the client disconnects."""
    while (await receive())["type"] != "http.disconnect":
        pass


@cache
def static_files() -> Mapping[str, bytes]:
    """Return the contents of all served files by path; requests read no other file."""
    files = (path for path in STATIC.rglob("*") if path.suffix in TYPES)
    return {path.relative_to(STATIC).as_posix(): path.read_bytes() for path in files}


async def _file(name: str, _: Request) -> Response:
    return Response(static_files()[name], media_type=TYPES[Path(name).suffix])


async def _alive(_: Request) -> Response:
    return PlainTextResponse("alive\n")


async def _refused(_: Request, error: Exception) -> Response:
    refusal = cast("HTTPException", error)
    return JSONResponse({"error": refusal.detail}, refusal.status_code, refusal.headers)


async def _failed(_: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, HTTPStatus.CONFLICT)


async def _about(request: Request, key: str) -> str:
    """Return the argument of a command from the request's body."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BODY_BYTES:
            raise HTTPException(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MOST_BODY_BYTES} bytes are read"
            )
    try:
        about = json.loads(body)[key]
    except (ValueError, KeyError, TypeError, RecursionError):
        about = None
    if not isinstance(about, str):
        raise HTTPException(HTTPStatus.BAD_REQUEST, f'the body must be {{"{key}": NAME}}')
    return about


def _places(request: Request) -> tuple[float, float]:
    begin, end = _number(request, "begin"), _number(request, "end")
    if not begin < end:
        raise HTTPException(HTTPStatus.BAD_REQUEST, f"begin {begin:g} is not before end {end:g}")
    return begin, end


def _bins(request: Request) -> int:
    return min(max(round(_number(request, "bins", 600.0)), LEAST_BINS), MOST_BINS)


def _number(request: Request, name: str, usual: float | None = None) -> float:
    text = request.query_params.get(name)
    if text is None and usual is not None:
        return usual
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise HTTPException(HTTPStatus.BAD_REQUEST, f"{name} must be a number, not {text!r}")
    return value
