"""Who may see a page, and who may act: attacks that a browser, or another user, may try."""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Mapping

import pytest

from dwell.dash.gate import HEADERS
from tests.dash.served import Served
from tests.waiting import PATIENCE_S, wait_until

DATA = "/cells", "/view?begin=0&end=1", "/state?at=0", "/jobs?begin=0&end=1", "/events"


def test_the_address_shows_the_page_and_brings_a_cookie(page: Served) -> None:
    answer = page.ask(page.address.removeprefix(f"http://{page.host}"))
    assert answer.status == 200
    assert answer.headers["content-type"].startswith("text/html")
    cookie = answer.headers["set-cookie"]
    assert {"HttpOnly", "SameSite=Strict"} <= set(cookie.split("; "))
    assert page.ask("/cells", {"Cookie": cookie.split(";")[0]}).status == 200
    assert len(page.token) >= 128 // 6


def test_the_page_names_no_other_host(page: Served) -> None:
    html = page.ask("/", page.bearer).body.decode()
    links = re.findall(r"""(?:src|href)=["']([^"']*)""", html)
    assert links
    assert not [link for link in links if not link.startswith(("/", "#")) or link[:2] == "//"]


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Cookie": "dwell-1=x"},
        {"Cookie": "\x01;;=;"},
        {"Authorization": "Bearer "},
        {"Authorization": "Bearer wrong"},
        {"Authorization": "Basic Og=="},
        {"Authorization": "Bearer \xff\xfe"},
    ],
    ids=str,
)
@pytest.mark.parametrize("path", [*DATA, "/", "/?token=", "/?token=wrong", "/static/page.js"])
def test_without_the_token_nothing_is_seen(
    page: Served, path: str, headers: Mapping[str, str]
) -> None:
    answer = page.ask(path, headers)
    assert answer.status == 401
    assert "token" in answer.value["error"]
    assert "set-cookie" not in answer.headers


def test_the_token_in_the_address_is_for_the_page_alone(page: Served) -> None:
    assert page.ask(f"/cells?token={page.token}").status == 401


def test_one_that_comes_twice_counts_for_nothing(page: Served) -> None:
    with socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S) as raw:
        hosts = f"Host: {page.host}\r\nHost: evil.example\r\n"
        raw.sendall(
            f"GET /cells HTTP/1.1\r\n{hosts}Authorization: Bearer {page.token}\r\n\r\n".encode()
        )
        assert raw.recv(64).split()[1] in {b"400", b"403"}


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:80", "127.0.0.1.evil.example", "localhost.evil.example"),
        *("127.0.0.2", "0.0.0.0", "[::]", "", "127.0.0.1:80:80", "127.0.0.1@evil.example"),
        *("2130706433", "user@localhost", "localhost:port"),
    ],
)
def test_a_name_that_was_rebound_is_not_answered(page: Served, host: str) -> None:
    for path in ("/", "/cells", "/healthz", "/readyz"):
        answer = page.ask(path, {**page.bearer, "Host": host})
        assert answer.status in {400, 403}, path
        assert page.token not in answer.body.decode()


@pytest.mark.parametrize("host", ["localhost:1234", "127.0.0.1:1", "[::1]:65535", "LocalHost"])
def test_any_port_of_this_computer_is_fine(page: Served, host: str) -> None:
    """A tunnel of ssh has another one."""
    assert page.ask("/cells", {**page.bearer, "Host": host}).status == 200


def test_every_answer_says_what_a_browser_may_do_with_it(page: Served) -> None:
    for path in ("/", "/cells", "/static/page.js", "/none", "/healthz"):
        for headers in ({}, page.bearer, {"Host": "evil.example"}):
            answer = page.ask(path, headers)
            for name, value in HEADERS.items():
                assert answer.headers[name] == value, (path, name)
            assert "server" not in answer.headers
    policy = dict(part.split(" ", 1) for part in HEADERS["content-security-policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == "'self'"


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE"])
def test_what_is_looked_at_takes_no_other_method(page: Served, method: str) -> None:
    headers = {**page.bearer, "Origin": f"http://{page.host}", "X-Dwell-Act": "pin"}
    for path in ("/", "/cells", "/view", "/events"):
        assert page.ask(path, headers, method=method).status == 405


@pytest.mark.parametrize(
    "path",
    [
        *("/static/../server.py", "/static/%2e%2e/server.py", "/static//etc/passwd"),
        *("/static/..%2fserver.py", "/../../etc/passwd", "/static/uplot/../../gate.py"),
        *("/static/", "/static", "/static/page.js/", "/static/page.js%00", "//etc/passwd"),
    ],
)
def test_no_path_leads_out_of_what_is_served(page: Served, path: str) -> None:
    assert page.ask(path, page.bearer).status in {400, 404}


@pytest.mark.parametrize("what", ["pin", "unpin", "drain", "undrain"])
def test_a_page_that_only_looks_does_nothing(page: Served, what: str) -> None:
    answer = page.act(what, {"candidate": "LOC", "node": "E"})
    assert answer.status == 403
    assert "--control" in answer.value["error"] or "recorded" in answer.value["error"]
    assert page.ask(f"/{what}", page.bearer).status == 405


@pytest.mark.parametrize(
    "query",
    [
        *("/view", "/view?begin=1&end=1", "/view?begin=nan&end=2", "/view?begin=0&end=inf"),
        *("/view?begin=x&end=2", "/state?at=", "/state?at=1e999", "/jobs?begin=2&end=1"),
    ],
)
def test_a_question_that_is_none_is_told_so(page: Served, query: str) -> None:
    answer = page.ask(query, page.bearer)
    assert answer.status == 400
    assert answer.value["error"]


@pytest.mark.parametrize("cell", ["1", "-1", "x", "٣", "1" * 5000])
def test_a_cell_that_is_not_there_is_told_so(page: Served, cell: str) -> None:
    from urllib.parse import quote

    assert page.ask(f"/state?at=0&cell={quote(cell)}", page.bearer).status == 404


def test_long_headers_end_their_connection_alone(page: Served) -> None:
    with contextlib.suppress(ConnectionError):
        assert page.ask("/cells", {"Cookie": "x" * 200_000}).status in {400, 401, 431}
    assert page.ask("/cells", page.bearer).status == 200


def test_200_connections_that_say_nothing_keep_nobody_out(page: Served) -> None:
    crowd = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(200)]
    try:
        for one in crowd[::2]:
            one.sendall(b"GET /cells HTTP/1.1\r\nHost: 127")
        assert page.ask("/cells", page.bearer).status == 200
        # They are let go.
        for one in crowd:
            one.settimeout(PATIENCE_S)
            assert one.recv(1) == b""
    finally:
        for one in crowd:
            one.close()
    assert page.ask("/healthz").status == 200


def test_readers_beyond_the_most_are_refused_and_others_go_on(page: Served) -> None:
    crowd = [page.events() for _ in range(40)]
    try:
        assert {one.recv(64).split()[1] for one in crowd} == {b"200", b"503"}
        assert page.ask("/cells", page.bearer).status == 200
    finally:
        for one in crowd:
            one.close()
    wait_until(lambda: _is_read(page))


def _is_read(page: Served) -> bool:
    with page.events() as one:
        return one.recv(64).split()[1] == b"200"


def test_the_process_lives_and_a_recorded_run_is_no_cell_that_is_well(page: Served) -> None:
    assert page.ask("/healthz").status == 200
    assert page.ask("/readyz").status == 503
