"""A live cell on the page: real processes, heard from outside, acted on and recorded."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from dwell.dash.observer import Observer
from dwell.dash.watched_cell import WatchedCell
from tests.cli.live_cell import MOODY, RealCell
from tests.dash.browser import chromium, in_browser, opened, wait_for
from tests.dash.served import Served, serving, state, until_state
from tests.record.test_mcap_file import metadata, read
from tests.waiting import wait_until

MARKUP = "<script>window.pwned=1</script><img src=x onerror=window.pwned=1>"


#: Bodies of a request that name no candidate.
NO_CANDIDATES: tuple[object, ...] = (None, [], "LOC", {}, {"candidate": 1}, {"node": "E"})


@pytest.fixture(scope="module")
def absent(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCell]:
    """Return a cell that nobody may have begun yet."""
    made = RealCell(tmp_path_factory.mktemp("live"))
    made.module.write_text(MOODY.replace('"no light"', repr(MARKUP)))
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def cell(absent: RealCell) -> RealCell:
    if not absent.processes:
        absent.begin()
    return absent


@pytest.fixture(scope="module")
def early(absent: RealCell) -> Iterator[Served]:
    """Return a page that may act, from before its cell begins."""
    with serving(absent.folder, absent.file, "--control") as served:
        yield served


@pytest.fixture
def acting(cell: RealCell, early: Served) -> Served:
    """Return a page that may act on its cell."""
    return early


def events(page: Served) -> set[str]:
    return {event["text"] for event in page.get("/view?begin=0&end=1e6")["events"]}


def test_a_cell_that_nobody_controls_is_absent(absent: RealCell, early: Served) -> None:
    found = state(early)
    assert found["health"] == "absent"
    assert "controller" in found["headline"]
    assert early.ask("/readyz").status == 503
    absent.begin()
    until_state(early, lambda found: found["health"] == "ok" and found.get("window"))


# ----------------------------------------------------------------------------- the observer


def test_an_observer_hears_every_cycle_once_and_every_job(cell: RealCell) -> None:
    with Observer(cell.problem) as observer:
        wait_until(
            lambda: (
                sum(one.latency_ns is not None for one in observer.cycles.since(0).items) >= 50
                and observer.windows.upto >= 2
            )
        )
        cycles = observer.cycles.since(0).items
        wait_until(
            lambda: observer.now().status.get("placement") == observer.now().placement == "LOC"
        )
        now = observer.now()
    numbers = [cycle.number for cycle in cycles]
    assert len(numbers) == len(set(numbers))
    assert sum(now.cycles.values()) >= len(cycles)
    done = [cycle for cycle in cycles if cycle.latency_ns is not None]
    assert len(done) >= 50
    tasks = set(cell.problem.pipeline.tasks)
    with_jobs = [one for one in done if {job["task"] for job in one.jobs} == tasks]
    assert len(with_jobs) >= len(done) - 5
    windows = observer.windows.since(0).items
    numbers = [window.number for window in windows]
    assert numbers == sorted(numbers)
    assert windows[-1].said["predicted"].keys() == cell.problem.candidates.keys()


def test_an_observer_says_nothing_but_questions(cell: RealCell) -> None:
    """It has no place among who is heard, and nobody is asked to hear it."""
    with Observer(cell.problem) as observer:
        wait_until(lambda: observer.cycles.upto >= 20)
        status = cell.until(lambda status: status["window"])
    assert not [who for who in status["processes"] if "visitor" in who]
    assert status["strangers"] == {}


def test_what_is_watched_is_ready_for_json(cell: RealCell) -> None:
    with Observer(cell.problem) as observer:
        watched = WatchedCell(observer)
        wait_until(lambda: observer.cycles.upto >= 60 and observer.windows.upto >= 2)
        whole = watched.described()
        view = watched.view(whole["begin"], whole["end"], 100)
        found = [whole, view, watched.state(0.0), watched.jobs(whole["begin"], whole["end"])]
        assert watched.refreshed()
    json.dumps(found, allow_nan=False)
    assert view["cycles"] == sum(view["bins"]["count"]) > 0
    assert view["windows"]["of"].keys() >= {"j LOC", "u R1", "cost"}
    assert found[3]["jobs"]


# --------------------------------------------------------------------------------- the page


def test_events_come_again_and_again(acting: Served) -> None:
    with acting.events() as reader:
        heard = b""
        while heard.count(b"data: ") < 5:
            part = reader.recv(65_536)
            assert part
            heard += part
    first = heard.partition(b"data: ")[2].partition(b"\n\n")[0]
    (news,) = json.loads(first)
    assert news["state"]["placement"] in {"LOC", "SO", "HYB"}
    assert {one["who"] for one in news["state"]["processes"]} >= {"stamper@R1", "planning@E"}


def test_a_reader_who_does_not_read_holds_nobody_up(acting: Served) -> None:
    slow = [acting.events(receives=2_048) for _ in range(8)]
    try:
        before = state(acting)["at"]
        test_events_come_again_and_again(acting)
        until_state(acting, lambda found: found["at"] > before)
    finally:
        for one in slow:
            one.close()


def test_it_is_ready_while_the_cell_is_well(acting: Served) -> None:
    wait_until(lambda: acting.ask("/readyz").status == 200)
    assert acting.ask("/readyz").body == b"ready\n"


@pytest.mark.parametrize(
    "changes",
    [
        {"Origin": None},
        {"Origin": "null"},
        {"Origin": "http://evil.example"},
        {"Origin": "http://127.0.0.1:1"},
        {"X_Dwell_Act": None, "X-Dwell-Act": None},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
    ],
    ids=str,
)
def test_what_acts_has_to_come_from_the_page(
    acting: Served, changes: Mapping[str, str | None]
) -> None:
    assert acting.act("pin", {"candidate": "SO"}, **changes).status == 403
    assert state(acting)["pinned"] is None


def test_what_acts_needs_the_token(acting: Served) -> None:
    assert acting.act("pin", {"candidate": "SO"}, Authorization=None).status == 401


@pytest.mark.parametrize(
    ("about", "status"),
    [
        *((wrong, 400) for wrong in NO_CANDIDATES),
        ({"candidate": "x" * 5_000}, 413),
        ({"candidate": "NONE"}, 409),
        ({"candidate": "x" * 500}, 409),
        ({"candidate": MARKUP}, 409),
    ],
    ids=lambda value: str(value)[:40],
)
def test_an_act_that_cannot_be_is_refused_with_why(
    acting: Served, about: object, status: int
) -> None:
    answer = acting.act("pin", about)
    assert answer.status == status
    assert answer.value["error"]


def test_acts_are_done_and_said(acting: Served) -> None:
    until_state(acting, lambda found: found["placement"] == "LOC")
    assert acting.act("pin", {"candidate": "HYB"}).value["pinned"] == "HYB"
    wait_until(lambda: "LOC → HYB: pinned" in events(acting))
    assert acting.act("drain", {"node": "E"}).status == 409
    assert acting.act("unpin", {}).value["pinned"] is None
    assert acting.act("drain", {"node": "E"}).value["drained"] == ["E"]
    wait_until(lambda: "HYB → LOC: E drained" in events(acting))
    assert acting.act("undrain", {"node": "E"}).value["drained"] == []
    assert {"pinned to HYB", "unpinned", "E drained", "E no longer drained"} <= events(acting)
    said = acting.said
    for line in ("pin HYB without keys: done", "unpin without keys: done", "undrain E"):
        assert line in said
    assert "drain E without keys: refused" in said
    assert acting.token not in said


@in_browser
def test_a_person_pins_it_in_a_browser(acting: Served) -> None:
    with chromium() as browser, opened(browser, acting.address) as shown:
        shown.on("dialog", lambda dialog: dialog.accept())
        shown.locator("[data-pin=SO]").click()
        wait_for(shown, "document.querySelector('[data-task=planning]').dataset.node === 'E'")
        wait_for(shown, "document.querySelector('tr.here th').textContent === 'SO'")
        shown.locator("[data-unpin]").click()
        wait_for(shown, "document.querySelector('[data-unpin]').disabled")
        acting.act("pin", {"candidate": "LOC"})
        wait_for(shown, "document.querySelector('[data-task=planning]').dataset.node === 'R2'")
        acting.act("unpin", {})
        wait_for(shown, "document.querySelector('.heard-said').textContent.includes('ready')")
        wait_for(shown, "document.querySelector('.stages').textContent.includes('camera@R1->')")
        assert shown.locator(".stages tbody").first.locator("tr").count() >= 4


@in_browser
def test_a_stage_that_raises_markup_is_only_text(cell: RealCell, acting: Served) -> None:
    cell.mood.write_text("raise")
    try:
        until_state(
            acting,
            lambda found: (
                found["health"] != "ok"
                and any(MARKUP in one.get("note", "") for one in found["processes"])
            ),
        )
        wait_until(lambda: acting.ask("/readyz").status == 503)
        with chromium() as browser, opened(browser, acting.address) as shown:
            wait_for(shown, "document.querySelector('.heard').textContent.includes('<script>')")
            wait_for(shown, "document.querySelector('.health').textContent.includes('<script>')")
            assert shown.evaluate("window.pwned") is None
            assert shown.locator("main img, main script").count() == 0
    finally:
        cell.mood.unlink()
    wait_until(lambda: acting.ask("/readyz").status == 200)


def test_without_control_it_only_looks(cell: RealCell) -> None:
    with serving(cell.folder, cell.file) as page:
        answer = page.act("pin", {"candidate": "SO"})
        assert answer.status == 403
        assert "--control" in answer.value["error"]
        assert page.get("/cells")["read_only"]


def test_a_live_cell_is_recorded_and_its_numbers_are_read(cell: RealCell, tmp_path: Path) -> None:
    file, token = tmp_path / "cell.mcap", tmp_path / "kept" / "dwell.token"
    token.parent.mkdir()
    with serving(tmp_path, cell.file, "--mcap", file, "--token", token) as page:
        assert token.stat().st_mode & 0o777 == 0o600
        assert token.read_text() == page.token

        def numbers() -> str:
            return page.ask("/metrics", page.bearer).body.decode()

        wait_until(lambda: re.search(r'cycles_total\{.*outcome="actuated"\} \d\d\.0', numbers()))
        wait_until(
            lambda: 'placement="LOC"' in numbers() and "dwell_utilisation_ratio{" in numbers()
        )
        # The first may be what the controller says of the last before the page came.
        wait_until(lambda: len(page.get("/view?begin=0&end=1e6")["windows"]["at"]) > 1)
        # Whoever watches may stand still: the cell goes on.
        page.process.send_signal(signal.SIGSTOP)
        try:
            number = cell.until(lambda status: status["window"])["window"]["number"]
            cell.until(lambda status: status["window"]["number"] >= number + 3)
        finally:
            page.process.send_signal(signal.SIGCONT)
    found = metadata(file)
    published, recorded, dropped = (int(found[n]) for n in ("published", "recorded", "dropped"))
    assert published == recorded + dropped
    assert f"{recorded} cycles and windows recorded + {dropped} dropped = {published}" in page.said
    topics: dict[str, list[int]] = {}
    for topic, at_ns, _ in read(file):
        topics.setdefault(topic, []).append(at_ns)
    assert topics.keys() == {"/cycles", "/windows", "/decisions", "/jobs"}
    assert len(topics["/cycles"]) + len(topics["/windows"]) == recorded
    # The same token the next time.
    with serving(tmp_path, cell.file, "--token", token) as page:
        assert page.token == token.read_text()
        assert page.ask("/metrics", page.bearer).status == 200
