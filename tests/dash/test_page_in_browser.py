"""The page of a recorded run in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

import dwell
from tests.dash.browser import in_browser, opened, played, settled, wait_for
from tests.dash.recorded import small_run
from tests.dash.served import Served, serving

pytestmark = in_browser

EXAMPLES = Path(__file__).parents[2] / "examples"

#: Ends of the scales of latency, J and load, by cell.
SCALES = """window.page.cells.map((cell) => cell.charts.scales())"""
MARKUP = "<img src=x onerror=window.pwned=1><script>window.pwned=1</script>"


@pytest.fixture
def shown(browser: Browser, page: Served) -> Iterator[Page]:
    with opened(browser, page.address) as made:
        yield made


@pytest.fixture(scope="module")
def run(run_folder: Path) -> dwell.Run:
    return dwell.open_run(run_folder)


def missed_in_view(shown: Page) -> list[int]:
    text = shown.locator(".latency .said").inner_text()
    return [int(number.replace(",", "")) for number in re.findall(r"[\d,]+", text)[:2]]


def view(shown: Page) -> list[float]:
    found: list[float] = shown.evaluate("window.page.view")
    return found


def test_it_says_how_many_missed_and_draws_something(shown: Page, run: dwell.Run) -> None:
    assert missed_in_view(shown) == [run.cycles["missed"].sum(), run.cycles.height]
    reds = shown.evaluate("""() => {
        const canvas = document.querySelector('.latency canvas');
        const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        let red = 0;
        for (let i = 0; i < data.length; i += 4)
            if (data[i + 3] > 200 && data[i] > 150 && data[i + 1] < 80) red += 1;
        return red;
    }""")
    assert reds > 100


def test_it_opens_on_the_verdict_the_worst_window_and_the_whole_run(
    shown: Page, page: Served
) -> None:
    (told,) = page.get("/cells")["cells"]
    assert told["verdict"]["text"] in shown.locator(".verdict").inner_text()
    assert shown.evaluate("window.page.at") == told["worst"]["at"]
    assert view(shown) == [told["begin"], told["end"]]
    settled(shown)
    window = f"window {told['worst']['number']},"
    assert window in shown.locator(".against caption").inner_text()
    shown.get_by_role("button", name="Worst").click()
    settled(shown)
    begin, end = view(shown)
    assert end - begin == pytest.approx(0.6)
    assert begin < told["worst"]["at"] < end


def test_the_jobs_have_the_time_axis_of_the_strips(shown: Page) -> None:
    shown.get_by_role("button", name="Cycles").click()
    settled(shown)
    box = shown.locator(".latency .u-over").bounding_box()
    plot = shown.locator(".gantt .plot").bounding_box()
    assert box is not None
    assert plot is not None
    begin, end = view(shown)
    releases = shown.locator(".gantt .release").evaluate_all(
        "lines => lines.map((line) => Number(line.getAttribute('x1')))"
    )
    each = 0.02 / (end - begin) * box["width"]
    first = (-(-begin // 0.02) * 0.02 - begin) / (end - begin) * box["width"]
    expected = [box["x"] - plot["x"] + first + i * each for i in range(len(releases))]
    assert releases == pytest.approx(expected, abs=1.5)


def test_the_token_is_not_left_in_the_address(shown: Page, page: Served) -> None:
    assert page.token not in shown.url
    shown.reload()
    wait_for(shown, "window.page")
    assert shown.evaluate("document.cookie") == ""


def test_stages_stand_where_they_run(shown: Page, run: dwell.Run) -> None:
    problem = run.problem
    for row in range(50, run.cycles.height, 100):
        placement = str(run.cycles["placement"][row])
        shown.evaluate(f"window.page.moveTo({row * 0.02 + 0.001})")
        settled(shown)
        for task, node in problem.candidates[placement].items():
            assert shown.locator(f"[data-task={task}]").get_attribute("data-node") == node


def test_it_plays_steps_and_stops(shown: Page) -> None:
    at = played(shown)
    shown.get_by_role("button", name="One window on").click()
    assert shown.evaluate("window.page.at") == pytest.approx(at + 0.2)
    shown.get_by_role("button", name="One window back").click()
    assert shown.evaluate("window.page.at") == pytest.approx(at)


def test_dragging_zooms_to_the_cycles_and_each_job_stands_on_its_node(
    shown: Page, run: dwell.Run
) -> None:
    box = shown.locator(".latency .u-over").bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    shown.mouse.move(box["x"] + 100, y)
    shown.mouse.down()
    shown.mouse.move(box["x"] + 300, y, steps=4)
    shown.mouse.up()
    begin, end = view(shown)
    assert 0 < begin < end < 12
    shown.get_by_role("button", name="Cycles").click()
    settled(shown)
    begin, end = view(shown)
    cycles = missed_in_view(shown)[1]
    assert cycles <= 14
    jobs = run.jobs.filter(run.jobs["start_ns"].is_not_null())
    first = -(-begin // 0.02)
    numbers = [int(first) + i for i in range(cycles)]
    mine = jobs.filter(jobs["cycle"].is_in(numbers) & (jobs["start_ns"] < end * 1e9))
    assert shown.locator(".gantt .job").count() == mine.height
    labels = shown.locator(".gantt text.muted").all_text_contents()
    assert set(labels) == {"sense@R", "plan@R", "plan@E"}
    shown.get_by_role("button", name="All", exact=True).click()
    settled(shown)
    assert shown.locator(".gantt").is_hidden()


def test_an_event_leads_to_its_window(shown: Page, run: dwell.Run) -> None:
    moves = run.decisions.filter(run.decisions["migrated"])
    buttons = shown.locator(".events button", has_text="→")
    assert buttons.count() == moves.height
    buttons.first.click()
    settled(shown)
    last = moves.row(-1, named=True)
    assert f"window {last['window']}," in shown.locator(".against caption").inner_text()
    assert last["reason"] in shown.locator(".decided .last").inner_text()
    assert view(shown)[1] - view(shown)[0] == pytest.approx(0.6)


def test_all_of_it_is_reached_by_keys_alone(shown: Page) -> None:
    shown.keyboard.press("c")
    settled(shown)
    assert view(shown)[1] < 1
    shown.keyboard.press("0")
    assert view(shown)[1] > 10
    shown.keyboard.press("Home")
    shown.keyboard.press("ArrowRight")
    assert shown.evaluate("window.page.at") == pytest.approx(0.2)
    shown.keyboard.press("End")
    assert shown.evaluate("window.page.at") > 11
    shown.keyboard.press("+")
    shown.keyboard.press("-")
    names = set()
    for _ in range(30):
        shown.keyboard.press("Tab")
        names.add(
            shown.evaluate(
                "document.activeElement.getAttribute('aria-label') "
                "?? document.activeElement.textContent.trim().slice(0, 20)"
            )
        )
    assert {"Play", "One window back", "One window on", "Closer", "All"} <= names


def test_a_screen_reader_has_a_name_for_everything(shown: Page) -> None:
    nameless = shown.evaluate("""() => [
        ...document.querySelectorAll('button, input, select, [role=img]')
    ].filter((one) => !one.getAttribute('aria-label') && !one.textContent.trim())
        .filter((one) => !one.labels?.length).map((one) => one.outerHTML)""")
    assert nameless == []
    assert shown.locator("h1").count() == 1
    assert shown.locator("[role=status]").count() >= 2
    expect(shown.locator(".topology title").first).to_contain_text("plan on")


def test_nothing_slides_where_motion_is_not_wanted(browser: Browser, page: Served) -> None:
    for wanted, property_ in (("reduce", "none"), ("no-preference", "transform")):
        with opened(browser, page.address, reduced_motion=wanted) as shown:
            found = shown.locator(".stage").first.evaluate(
                "(one) => getComputedStyle(one).transitionProperty"
            )
            assert found == property_


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_small_screen_needs_no_scrolling_sideways(
    browser: Browser, page: Served, scheme: str
) -> None:
    size = {"width": 400, "height": 800}
    with opened(browser, page.address, viewport=size, color_scheme=scheme) as shown:
        settled(shown)
        assert shown.evaluate("document.documentElement.scrollWidth") <= 400


def test_both_copies_of_a_cycle_stand_where_they_run(browser: Browser, tmp_path: Path) -> None:
    problem = dwell.load(EXAMPLES / "replicas.yaml")
    run = dwell.simulate(problem, policy="NOW", seed=1, windows=2, jobs=True)
    run.save(tmp_path / "run")
    with (
        serving(tmp_path, tmp_path / "run") as served,
        opened(browser, served.address) as shown,
    ):
        settled(shown)
        assert shown.locator("[data-task=policy]").get_attribute("data-node") == "A"
        assert shown.locator("[data-second=policy]").get_attribute("data-node") == "B"
        assert shown.locator("[data-second=camera]").is_hidden()
        shown.get_by_role("button", name="Cycles").click()
        settled(shown)
        assert shown.locator(".gantt .job.second").count() > 0
        words = shown.locator(".gantt .job.second title").first.text_content()
        assert words is not None
        assert re.search("policy on B, .*second copy", words)


def test_two_runs_stand_on_one_time_line(browser: Browser, tmp_path: Path) -> None:
    for policy in ("dtp", "LOC"):
        small_run(tmp_path / policy, policy=policy)
    small_run(tmp_path / "other", seed=2)
    with (
        serving(tmp_path, tmp_path / "dtp", "--beside", tmp_path / "LOC") as served,
        opened(browser, served.address) as shown,
    ):
        assert "same realisation" in shown.locator("#about").inner_text()
        assert shown.locator(".cell").count() == 2
        shown.evaluate("window.page.moveTo(200)")
        settled(shown)
        assert "cycle 200" in shown.locator("#place").inner_text()
        facts = shown.locator(".facts").all_inner_texts()
        assert all("cycle 200" in fact for fact in facts)
        tops = [
            [shown.locator(f".{part}").nth(i).bounding_box() for i in (0, 1)]
            for part in ("latency", "ribbon", "costs", "used")
        ]
        assert all(one and other and one["y"] == other["y"] for one, other in tops)
        ends = shown.evaluate(SCALES)
        assert ends[0] == ends[1]
        assert "LOC less dtp" in shown.locator("#difference").inner_text()
        shown.set_viewport_size({"width": 400, "height": 800})
        settled(shown)
        assert shown.evaluate("document.documentElement.scrollWidth") <= 400
    with serving(tmp_path, tmp_path / "dtp", "--beside", tmp_path / "other") as served:
        assert "by seconds" in served.get("/cells")["line"]


def test_markup_in_a_record_is_only_text(browser: Browser, tmp_path: Path) -> None:
    small_run(tmp_path / "run")
    file = tmp_path / "run" / "run.json"
    meta = json.loads(file.read_text())
    meta |= {"policy": MARKUP, "scenario": MARKUP, "estimator": MARKUP}
    meta["problem"]["name"] = MARKUP
    file.write_text(json.dumps(meta))
    with (
        serving(tmp_path, tmp_path / "run") as served,
        opened(browser, served.address) as shown,
    ):
        assert shown.locator(".name").inner_text() == MARKUP
        assert MARKUP in shown.locator(".where-caption").inner_text()
        assert MARKUP in shown.title()
        assert shown.evaluate("window.pwned") is None
        assert shown.locator("main img, main script").count() == 0


def test_the_page_says_that_its_process_is_gone(browser: Browser, run_folder: Path) -> None:
    with (
        serving(run_folder.parent, run_folder) as served,
        _noisy(browser, served.address) as shown,
    ):
        served.process.terminate()
        served.process.wait()
        shown.locator("#connection.bad").wait_for()


@contextmanager
def _noisy(browser: Browser, address: str) -> Iterator[Page]:
    """Open an address; what the console says does not matter."""
    context = browser.new_context()
    shown = context.new_page()
    shown.goto(address)
    wait_for(shown, "window.page")
    yield shown
    context.close()
