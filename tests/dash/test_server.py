"""The page's application, called as a server calls it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dwell.dash import server
from dwell.dash.recorded_cell import RecordedCell
from dwell.dash.server import Dash

SCOPE = {"type": "http", "method": "GET", "headers": [], "query_string": b"", "root_path": ""}


async def never() -> Mapping[str, Any]:
    await asyncio.Event().wait()
    raise AssertionError


def test_a_reader_who_takes_nothing_is_let_go(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "READER_S", 0.05)
    app = Dash([RecordedCell(run_folder)]).application()
    taken: list[Mapping[str, Any]] = []

    async def take_the_head_alone(message: Mapping[str, Any]) -> None:
        taken.append(message)
        if message["type"] == "http.response.body":
            await asyncio.Event().wait()

    async def ask() -> None:
        await asyncio.wait_for(
            app({**SCOPE, "path": "/events"}, never, take_the_head_alone),  # type: ignore[arg-type]
            timeout=60,
        )

    asyncio.run(ask())
    assert [message["type"] for message in taken] == ["http.response.start", "http.response.body"]


class _Failing(RecordedCell):
    """A cell that fails at its first looks."""

    live = True
    looks = 0

    def refreshed(self) -> bool:
        self.looks += 1
        if self.looks < 3:
            raise ValueError("not yet")
        return True


def test_a_look_that_fails_does_not_end_the_looking(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server, "TICK_S", 0.01)
    monkeypatch.setattr(server, "IDLE_TICK_S", 0.01)
    dash = Dash([_Failing(run_folder)])
    app = dash.application()

    async def listen() -> bytes:
        async with app.router.lifespan_context(app), dash.reading():
            tick = await dash.next_tick(0)
            assert tick is not None
            return tick[1]

    heard = asyncio.run(asyncio.wait_for(listen(), 60))
    (news,) = json.loads(heard.removeprefix(b"data: "))
    assert news["grew"] is True
    assert "not yet" in caplog.text
