"""The list of the runs in a folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from dwell.dash.recorded_cell import RecordedCell
from dwell.dash.runs_folder import MOST_RUNS, RunsFolder
from dwell.errors import RunError
from tests.dash.browser import in_browser, opened, settled, wait_for
from tests.dash.recorded import WrittenRun, small_run
from tests.dash.served import Served, serving
from tests.waiting import wait_until

LONG = "a-name-of-forty-characters-for-this-run-計算機計算機"
DRAWN = "document.querySelector('.runs .source')?.textContent.includes('broken')"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, fleet_folder: Path) -> Path:
    """Return a folder with runs, a broken run, a running one and a fleet."""
    folder = tmp_path_factory.mktemp("several")
    run = small_run(folder / "dtp", windows=30)
    small_run(folder / "loc", policy="LOC", windows=30)
    small_run(folder / "group" / LONG, seed=2, windows=30)
    (folder / "small.yaml").unlink()
    shutil.copytree(folder / "dtp", folder / "broken")
    (folder / "broken" / "windows.parquet").write_bytes(b"PAR1")
    shutil.copytree(fleet_folder, folder / "fleet")
    written = WrittenRun(folder / "written", run)
    written.go_on(20)
    written.close()
    return folder


def rows_of(folder: RunsFolder) -> dict[str, dict[str, object]]:
    folder.start()
    wait_until(lambda: folder.rows(0)["upto"] >= folder.count)
    names = folder.described()["runs"]
    return {names[row["place"]]: row for row in folder.rows(0)["rows"]}


def test_a_row_has_the_numbers_of_the_page_of_its_run(runs: Path) -> None:
    found = rows_of(RunsFolder(runs))
    assert set(found) == {"broken", "dtp", "fleet", f"group/{LONG}", "loc", "written"}
    for name in ("dtp", "loc", f"group/{LONG}"):
        told = RecordedCell(runs / name).described()
        assert found[name]["verdict"] == told["verdict"]["word"]
        assert found[name]["rate"] == told["verdict"]["rate"]
        assert found[name]["moves"] == told["moves"]["migrations"] + told["moves"]["guard_moves"]
        assert found[name]["policy"] == told["about"]["policy"]
    json.dumps(found, allow_nan=False)


def test_broken_and_unclosed_runs_and_fleets_are_named(runs: Path) -> None:
    found = rows_of(RunsFolder(runs))
    states = {name: found[name]["state"] for name in ("broken", "fleet", "written", "dtp")}
    assert states == {
        "broken": "broken",
        "fleet": "fleet",
        "written": "unfinished",
        "dtp": "done",
    }
    assert str(found["broken"]["note"]).startswith("windows.parquet: cannot be read")
    assert str(runs / "fleet") in str(found["fleet"]["note"])


def test_a_running_run_is_named_and_read_again(tmp_path: Path) -> None:
    run = small_run(tmp_path / "whole", windows=40)
    written = WrittenRun(tmp_path / "running", run)
    written.go_on(15)
    folder = RunsFolder(tmp_path)
    row = rows_of(folder)["running"]
    assert (row["state"], row["windows"], row["verdict"]) == ("running", 15, None)
    written.go_on(10)
    wait_until(lambda: folder.rows(folder.count)["rows"])
    assert folder.rows(folder.count)["rows"][0]["windows"] == 25
    written.close()
    wait_until(lambda: folder.rows(0)["rows"][-1]["state"] == "unfinished")


def test_ten_thousand_runs_are_listed_at_once(tmp_path: Path) -> None:
    for number in range(MOST_RUNS + 3):
        run = tmp_path / f"run-{number:05}"
        run.mkdir()
        (run / "run.json").touch()
    told = RunsFolder(tmp_path).described()
    assert (len(told["runs"]), told["more"]) == (MOST_RUNS, 3)


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="contains no run"):
        RunsFolder(tmp_path)


def test_lines_have_v_d_of_the_windows(runs: Path) -> None:
    folder = RunsFolder(runs)
    place = folder.described()["runs"].index("loc")
    (line,) = folder.lines([place])
    rates = RecordedCell(runs / "loc").contents.windows.rates
    assert line["rates"] == pytest.approx(100 * rates, abs=1e-3)


@pytest.fixture(scope="module")
def served(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(tmp_path_factory.mktemp("err"), runs) as page:
        yield page


@pytest.mark.parametrize("cells", ["", "x", "6", "-1", "0,9", "0,,1"])
def test_lines_of_other_runs_are_refused(served: Served, cells: str) -> None:
    assert served.ask(f"/lines?cells={cells}", served.bearer).status == 400


@pytest.fixture
def shown(browser: Browser, served: Served) -> Iterator[Page]:
    with opened(browser, served.address, ready=DRAWN) as made:
        wait_for(made, "!document.querySelector('.runs .source').textContent.includes('read')")
        yield made


def names(shown: Page) -> list[str]:
    return shown.locator("tbody th").all_inner_texts()


@in_browser
def test_columns_sort_by_keyboard_and_the_filter_narrows(shown: Page) -> None:
    assert names(shown) == ["broken", "dtp", "fleet", f"group/{LONG}", "loc", "written"]
    heading = shown.locator("th[data-key=rate]")
    heading.get_by_role("button").focus()
    for order, sign in (("ascending", 1), ("descending", -1)):
        shown.keyboard.press("Enter")
        assert heading.get_attribute("aria-sort") == order
        rates = shown.locator("tbody td:nth-child(4)").all_inner_texts()
        known = [float(rate.split()[0]) for rate in rates if rate != "–"]
        assert known == sorted(known, key=lambda rate: sign * rate)
        assert rates[-2:] == ["–", "–"]
    shown.get_by_label("Filter").fill("broken")
    assert names(shown) == ["broken"]


@in_browser
def test_several_runs_are_in_one_plot(shown: Page) -> None:
    for name in ("dtp", "loc"):
        shown.get_by_label(f"{name} in the plot", exact=True).check()
    settled(shown)
    assert shown.locator(".plotted .legend li").count() == 2
    label = shown.locator(".plotted [role=img]").get_attribute("aria-label")
    assert label is not None
    assert "dtp" in label
    assert "loc" in label
    assert shown.get_by_label("broken in the plot", exact=True).is_disabled()


@in_browser
def test_a_name_leads_to_its_run_and_back(shown: Page) -> None:
    shown.get_by_role("link", name="loc", exact=True).click()
    shown.wait_for_url("**/cell/*")
    wait_for(shown, "document.querySelector('.verdict .judged')?.textContent")
    assert shown.locator(".source").inner_text() == "loc"
    shown.locator("#back-to-fleet a").click()
    wait_for(shown, DRAWN)


@in_browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_list_fits_a_small_screen(browser: Browser, served: Served, scheme: str) -> None:
    size = {"width": 400, "height": 800}
    with opened(browser, served.address, ready=DRAWN, viewport=size, color_scheme=scheme) as shown:
        assert shown.evaluate("document.documentElement.scrollWidth") <= 400
