"""The page of a fleet: what it serves and refuses, and how it is in a real browser."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest
from playwright.sync_api import Browser, Page

from dwell.record import FleetRun, open_fleet
from dwell.record.fleet_run import LOAD, UNFINISHED
from dwell.record.run import FLEET
from tests.dash.browser import READY as CELL_READY
from tests.dash.browser import in_browser, opened, played, settled, wait_for
from tests.dash.served import Served, serving
from tests.dash.test_serving import LIVE, ran

MARKUP = "<img src=x onerror=window.pwned=1><script>window.pwned=1</script>"
TAG = "<img src=x onerror=window.pwned=1>"
READY = "document.querySelector('.small .last')?.textContent"


@pytest.fixture(scope="module")
def served(fleet_folder: Path) -> Iterator[Served]:
    """Return a page of that fleet."""
    with serving(fleet_folder.parent, fleet_folder, without=LIVE) as made:
        yield made


@pytest.fixture(scope="module")
def runs(fleet_folder: Path) -> FleetRun:
    return open_fleet(fleet_folder)


@pytest.fixture
def shown(browser: Browser, served: Served) -> Iterator[Page]:
    with opened(browser, served.address, ready=READY) as made:
        yield made


def wait_for_page(shown: Page, address: str, ready: str = CELL_READY) -> None:
    """Wait until another page has come, and is drawn."""
    shown.wait_for_url(address)
    wait_for(shown, ready)


# ------------------------------------------------------------------------------ what is served


def test_a_fleet_is_asked_for_as_a_whole_and_its_cells_by_number(
    served: Served, runs: FleetRun
) -> None:
    found = served.get("/cells")
    assert found["cells"] == []
    assert len(found["fleet"]["cells"]) == 3
    assert len(served.get("/view?begin=0&end=9")["cells"]) == 3
    assert len(served.get("/state?at=3")["cells"]) == 3
    for place, run in enumerate(runs.cells.values()):
        (cell,) = served.get(f"/cells?cell={place}")["cells"]
        assert cell["cycles"] == run.cycles.height
        view = served.get(f"/view?cell={place}&begin=0&end=100")
        assert view["missed"] == run.cycles["missed"].sum()
        assert served.get(f"/jobs?cell={place}&begin=1&end=1.1")["jobs"]
        assert served.ask(f"/cell/{place}", served.bearer).status == 200


def test_other_cells_than_there_are_and_other_paths_are_refused(served: Served) -> None:
    for name in ("3", "-1", "1e0", "..%2fsmall-01", "\u0661", "9" * 40, ""):
        quoted = name.encode("utf-8").hex("%") if not name.isascii() else name
        path = f"/cells?cell=%{quoted}" if not name.isascii() else f"/cells?cell={name}"
        assert served.ask(path, served.bearer).status == 404, name
    assert served.ask("/jobs?begin=0&end=1", served.bearer).status == 200
    for path in ("/cell/", "/cell/x", "/cell/../small-01/run.json", "/small-01/run.json"):
        assert served.ask(path, served.bearer).status == 404, path


def test_the_pages_of_cells_are_guarded_like_the_first(served: Served) -> None:
    assert served.ask("/cell/0").status == 401
    assert served.ask(f"/cell/0?token={served.token}").status == 401
    assert served.ask("/cell/0", {**served.bearer, "Host": "evil.example"}).status == 403
    answer = served.ask("/cell/0", served.bearer)
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert served.act("pin", {"candidate": "LOC"}).status == 403


# ----------------------------------------------------------------------------------- bad input


def test_what_makes_no_sense_of_a_fleet_is_refused_by_name(
    fleet_folder: Path, tmp_path: Path
) -> None:
    for words, expected in (
        (("--beside", fleet_folder / "small-01"), "--beside: "),
        (("--control",), "--control: recorded runs cannot be acted on"),
        (("--mcap", tmp_path / "x.mcap"), "CELL --mcap"),
    ):
        code, said = ran(fleet_folder, *words)
        assert code == 2, words
        assert expected in " ".join(said.split()), words
    code, said = ran(fleet_folder / "small-01", "--beside", fleet_folder)
    assert (code, "a fleet; name the folder of one of its cells" in said) == (2, True)


def test_without_fleet_json_its_runs_are_listed(fleet_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(fleet_folder, tmp_path / "pack")
    (folder / FLEET).unlink()
    with serving(tmp_path, folder) as served:
        listed = served.get("/cells")["runs"]["runs"]
        assert listed == ["small-01", "small-02", "small-03"]
    (folder / FLEET).write_text("{")
    code, said = ran(folder)
    assert (code, "fleet.json: cannot be read" in said) == (2, True)


def test_an_interrupted_fleet_shows_what_is_whole_and_says_so(
    fleet_folder: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(fleet_folder, tmp_path / "pack")
    (folder / FLEET).rename(folder / UNFINISHED)
    shutil.rmtree(folder / "small-03")
    (folder / LOAD).unlink()
    with serving(tmp_path, folder) as served:
        fleet = served.get("/cells")["fleet"]
        assert {cell["name"] for cell in fleet["cells"]} == {"small-01", "small-02"}
        assert "2 of 3 runs are whole" in fleet["notes"][0]
        assert "interrupted" in fleet["notes"][0]
        assert any("small-03" in note for note in fleet["notes"])
        assert fleet["shared"] == []
        assert len(served.get("/view?begin=0&end=9")["cells"]) == 2


def test_a_cell_whose_run_is_damaged_takes_no_other_along(
    fleet_folder: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(fleet_folder, tmp_path / "pack")
    (folder / "small-01" / "decisions.parquet").write_bytes(b"PAR1")
    (folder / "small-02" / "cycles.parquet").write_bytes(b"PAR1")
    with serving(tmp_path, folder) as served:
        fleet = served.get("/cells")["fleet"]
        assert "2 of 3 runs are whole" in fleet["notes"][0]
        assert any("decisions.parquet" in note for note in fleet["notes"])
        assert {cell["name"] for cell in fleet["cells"]} == {"small-02", "small-03"}
        # Its cycles are not read before it is opened.
        answer = served.ask("/cells?cell=1", served.bearer)
        assert answer.status == 409
        assert "cycles.parquet" in answer.value["error"]


# ------------------------------------------------------------------------------ in a browser


@in_browser
def test_small_multiples_say_how_every_cell_is(shown: Page, served: Served) -> None:
    fleet = served.get("/cells")["fleet"]
    names = [cell["name"] for cell in fleet["cells"]]
    assert shown.locator(".small h4 a").all_inner_texts() == names
    assert shown.locator(".fleet .name").first.inner_text() == "pack"
    assert names[0] in shown.locator(".verdict").first.inner_text()
    assert all(cell["verdict"] in ("kept", "missed", "open") for cell in fleet["cells"])
    rates = shown.locator(".small .rate").all_inner_texts()
    assert [rate.split(": ")[1] for rate in rates] == [cell["verdict"] for cell in fleet["cells"]]
    shown.evaluate("window.page.moveTo(4.003)")
    settled(shown)
    state = served.get("/state?at=4.003")
    for cell, text in zip(
        state["cells"], shown.locator(".small .health").all_inner_texts(), strict=True
    ):
        assert cell["health"] in text
    numbers = shown.locator(".who td.num").all_inner_texts()
    assert sum(map(int, numbers)) == 3
    assert "E" in shown.locator(".used .legend").inner_text()
    assert "round" in shown.locator(".phi .legend").inner_text()
    drawn = "[...document.querySelectorAll('.small .over')].map((one) => one.getAttribute('d'))"
    assert any(shown.evaluate(drawn))


@in_browser
def test_a_click_opens_a_cell_at_the_same_place_and_leads_back(shown: Page, runs: FleetRun) -> None:
    shown.evaluate("window.page.moveTo(3)")
    name = shown.locator(".small h4 a").first.inner_text()
    shown.locator(".small").first.click()
    wait_for_page(shown, "**/cell/*")
    settled(shown)
    assert shown.evaluate("window.page.at") == 3
    assert shown.locator(".source").inner_text() == name
    assert f"of {runs.cells[name].cycles.height} cycles" in shown.locator(".facts").inner_text()
    shown.keyboard.press("c")
    settled(shown)
    assert shown.locator(".gantt .job").count() > 0
    shown.locator("#back-to-fleet a").click()
    wait_for_page(shown, "**/", READY)
    assert shown.locator(".small").count() == 3
    assert shown.evaluate("window.page.at") == 3


@in_browser
def test_a_fleet_plays_steps_and_zooms(shown: Page) -> None:
    at = played(shown)
    shown.get_by_role("button", name="One window on").click()
    assert shown.evaluate("window.page.at") == pytest.approx(at + 0.2)
    shown.keyboard.press("+")
    begin, end = shown.evaluate("window.page.view")
    assert end - begin == pytest.approx(4, abs=0.1)
    assert shown.get_by_role("button", name="Cycles").is_hidden()
    shown.keyboard.press("0")
    shown.locator(".events button", has_text="→").first.click()
    begin, end = shown.evaluate("window.page.view")
    assert end - begin == pytest.approx(0.6)


@in_browser
def test_a_cell_is_reached_by_keys_and_has_a_name_for_screen_readers(shown: Page) -> None:
    settled(shown)
    nameless = shown.evaluate("""() => [
        ...document.querySelectorAll('a, button, input, select, [role=img]')
    ].filter((one) => !one.getAttribute('aria-label') && !one.textContent.trim())
        .filter((one) => !one.labels?.length).map((one) => one.outerHTML)""")
    assert nameless == []
    title = shown.locator(".small svg title").first.text_content() or ""
    assert "over the deadline" in title
    assert "placed" in title
    name = shown.locator(".small h4 a").first.inner_text()
    while shown.evaluate("document.activeElement.textContent") != name:
        shown.keyboard.press("Tab")
    shown.keyboard.press("Enter")
    wait_for_page(shown, "**/cell/*")
    assert shown.locator(".source").inner_text() == name


@in_browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_small_screen_needs_no_scrolling_sideways(
    browser: Browser, served: Served, scheme: str
) -> None:
    size = {"width": 400, "height": 800}
    with opened(browser, served.address, ready=READY, viewport=size, color_scheme=scheme) as shown:
        settled(shown)
        assert shown.evaluate("document.documentElement.scrollWidth") <= 400


@in_browser
def test_markup_in_the_names_of_a_fleet_is_only_text(
    browser: Browser, fleet_folder: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(fleet_folder, tmp_path / "pack")
    shutil.rmtree(folder / "small-03")
    for name in ("01", "02"):
        (folder / f"small-{name}").rename(folder / f"{TAG}-{name}")
    described = json.loads((folder / FLEET).read_text())
    described["cells"] = [f"{TAG}-{name}" for name in ("01", "02", "03")]
    described["phases"] = dict.fromkeys(described["cells"], 0.0)
    described["fleet"]["name"] = MARKUP
    for entry in described["fleet"]["cells"]:
        entry["cell"]["name"] = TAG
    (folder / FLEET).write_text(json.dumps(described))
    with (
        serving(tmp_path, folder) as served,
        opened(browser, served.address, ready=READY) as shown,
    ):
        assert shown.locator(".fleet .name").first.inner_text() == MARKUP
        assert MARKUP in shown.title()
        assert f"{TAG}-03" in shown.locator(".notes").inner_text()
        assert shown.locator(".small h4 a").first.inner_text().startswith(TAG)
        shown.locator(".small h4 a").first.click()
        wait_for_page(shown, "**/cell/*")
        assert shown.locator(".source").inner_text().startswith(TAG)
        assert MARKUP in shown.locator("#back-to-fleet").inner_text()
        assert shown.evaluate("window.pwned") is None
        assert shown.locator("main img, main script").count() == 0


@in_browser
def test_a_violation_rate_has_two_decimals_and_a_lowered_index(shown: Page, runs: FleetRun) -> None:
    texts = [text.inner_html() for text in shown.query_selector_all(".small .rate")]
    rates = [text.partition(":")[0] for text in texts]
    windows = runs.windows.filter(~runs.windows["warmup"])
    means = windows.group_by("cell").agg(pl.col("violation_rate").mean())["violation_rate"]
    assert rates == [f"V<sub>D</sub> {100 * rate:.2f} %" for rate in sorted(means, reverse=True)]
