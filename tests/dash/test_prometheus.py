"""A Prometheus that scrapes the page of a cell as the examples configure it."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest
import yaml

from dwell.dash.metrics import CellMetrics
from tests.dash.served import ROOT, Served, started
from tests.dash.stand_in import StandIn
from tests.waiting import PATIENCE_S, wait_until

EXAMPLES = ROOT / "examples/monitoring"
TOKEN = "a-token-of-the-tests-that-nobody-guesses"
OPENMETRICS = "application/openmetrics-text;version=1.0.0,text/plain;version=0.0.4;q=0.5"


def tool(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"no {name} here; it is in Debian's package prometheus")
    return found


@pytest.fixture(scope="module")
def live_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Return the page of a live cell."""
    folder = tmp_path_factory.mktemp("page")
    with started(folder, [sys.executable, "-m", "tests.dash.stand_in", TOKEN]) as served:
        assert served.token == TOKEN
        yield served


def test_metrics_are_for_those_who_have_the_token(live_page: Served, page: Served) -> None:
    assert live_page.ask("/metrics").status == 401
    assert live_page.ask("/metrics", {"Authorization": "Bearer wrong"}).status == 401
    cookie = {"Cookie": f"dwell-{live_page.port}={TOKEN}"}
    for known in (live_page.bearer, cookie):
        answer = live_page.ask("/metrics", known)
        assert answer.status == 200
        assert b"dwell_cycle_latency_seconds_count" in answer.body
    # The page of a recorded run has none.
    assert page.ask("/metrics", page.bearer).status == 404


@pytest.mark.parametrize(
    ("accept", "content_type"),
    [
        (None, "text/plain; version=0.0.4; charset=utf-8"),
        ("text/plain", "text/plain; version=0.0.4; charset=utf-8"),
        (OPENMETRICS, "application/openmetrics-text; version=1.0.0; charset=utf-8"),
    ],
)
def test_who_asks_says_in_which_format(
    accept: str | None, content_type: str, live_page: Served
) -> None:
    given = {} if accept is None else {"Accept": accept}
    answer = live_page.ask("/metrics", {**live_page.bearer, **given})
    assert answer.headers["content-type"].startswith(content_type)
    assert answer.body.endswith(b"# EOF\n") == (accept == OPENMETRICS)


@contextmanager
def scraping(folder: Path, page: Served, token: str) -> Iterator[Prometheus]:
    """Run a Prometheus with the configuration of the examples."""
    text = (EXAMPLES / "prometheus.yml").read_text(encoding="utf-8")
    for old, new in (("5s", "1s"), ("127.0.0.1:8780", page.host)):
        assert old in text
        text = text.replace(old, new)
    (folder / "prometheus.yml").write_text(text, encoding="utf-8")
    shutil.copy(EXAMPLES / "rules.yml", folder)
    (folder / "dwell.token").write_text(token, encoding="utf-8")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = {
        "config.file": folder / "prometheus.yml",
        "storage.tsdb.path": folder / "data",
        "web.listen-address": f"127.0.0.1:{port}",
        "enable-feature": "exemplar-storage",
    }
    words = [tool("prometheus"), *(f"--{name}={value}" for name, value in options.items())]
    with (folder / "prometheus.log").open("wb") as log:
        process = subprocess.Popen(words, cwd=folder, stdout=log, stderr=log)
    try:
        yield Prometheus(port)
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


class Prometheus:
    """Answers of a Prometheus."""

    def __init__(self, port: int) -> None:
        self._port = port

    def get(self, what: str, **about: object) -> Any:
        """Return an answer; nothing before it listens."""
        connection = HTTPConnection("127.0.0.1", self._port, timeout=PATIENCE_S)
        try:
            connection.request("GET", f"/api/v1/{what}?{urlencode(about)}")
            answer = connection.getresponse()
            return json.loads(answer.read())["data"] if answer.status == 200 else None
        except ConnectionError:
            return None
        finally:
            connection.close()

    def target(self) -> dict[str, Any]:
        """Return its only target, once it has been scraped."""
        found: list[dict[str, Any]] = []

        def scraped() -> bool:
            targets = (self.get("targets") or {}).get("activeTargets") or []
            found[:] = [one for one in targets if one["health"] != "unknown"]
            return bool(found)

        wait_until(scraped)
        return found[0]

    def result(self, query: str) -> list[dict[str, Any]]:
        """Return what a query gives, once it gives something."""
        found: list[dict[str, Any]] = []

        def known() -> bool:
            found[:] = (self.get("query", query=query) or {}).get("result") or []
            return bool(found)

        wait_until(known)
        return found


def test_prometheus_scrapes_it_with_exemplars(live_page: Served, tmp_path: Path) -> None:
    with scraping(tmp_path, live_page, TOKEN) as prometheus:
        assert prometheus.target()["lastError"] == ""
        # Rates need two scrapes.
        (rate,) = prometheus.result(
            "sum by (le) (rate(dwell_cycle_latency_seconds_bucket{le='+Inf'}[1m])) > 0"
        )
        assert rate["metric"] == {"le": "+Inf"}
        (placed,) = prometheus.result("dwell_placement_info")
        assert placed["metric"]["placement"] == "LOC"
        (found, *_) = prometheus.get(
            "query_exemplars", query="dwell_cycle_latency_seconds_bucket", start=0, end=4e9
        )
        assert found["exemplars"][0]["labels"].keys() == {"run", "cycle"}
        (group,) = prometheus.get("rules")["groups"]
        assert len(group["rules"]) == 3
        assert {rule["health"] for rule in group["rules"]} <= {"ok", "unknown"}


def test_with_a_wrong_token_the_target_is_down(live_page: Served, tmp_path: Path) -> None:
    with scraping(tmp_path, live_page, "wrong") as prometheus:
        target = prometheus.target()
        assert target["health"] == "down"
        assert "401" in target["lastError"]


@pytest.mark.parametrize(
    "words", [("check", "rules", "rules.yml"), ("test", "rules", "rules_test.yml")]
)
def test_promtool_passes_the_rules(words: tuple[str, ...]) -> None:
    done = subprocess.run(
        [tool("promtool"), *words], cwd=EXAMPLES, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def queries() -> dict[str, str]:
    """Queries of the dashboard and the rules, by where they stand."""
    rules = yaml.safe_load((EXAMPLES / "rules.yml").read_text(encoding="utf-8"))
    board = json.loads((EXAMPLES / "dashboard.json").read_text(encoding="utf-8"))
    found = {rule["alert"]: rule["expr"] for group in rules["groups"] for rule in group["rules"]}
    for panel in board["panels"]:
        for target in panel.get("targets", ()):
            found[f"{panel['title']}/{target['refId']}"] = target["expr"]
    return found


def test_rules_and_dashboard_ask_for_series_that_there_are() -> None:
    cell = StandIn()
    cell.well()
    cell.cycle(0, 20)
    known = {"dwell_certificate_days", "dwell_certificate_expiry_timestamp_seconds"}
    for family in CellMetrics(cell.observer).collect():
        known |= {sample.name for sample in family.samples}
    asked = {name for query in queries().values() for name in re.findall(r"dwell_\w+", query)}
    assert asked <= known
    assert known - asked <= {
        *("dwell_cycle_latency_seconds_sum", "dwell_cycle_latency_seconds_count"),
        *("dwell_cycle_latency_seconds_created", "dwell_violation_ratio", "dwell_windows_total"),
        *("dwell_unread_cycles_total", "dwell_task_placement_info"),
        *("dwell_silences_total", "dwell_release_ratio", "dwell_stage_seconds"),
        *("dwell_stage_inputs_total", "dwell_flow_bytes_total"),
        "dwell_certificate_days",
    }


def test_the_queries_of_the_dashboard_are_queries(tmp_path: Path) -> None:
    variables = {"$__rate_interval": "1m", "$cell": "hall"}
    rules = []
    for number, query in enumerate(queries().values()):
        for name, value in variables.items():
            query = query.replace(name, value)
        rules.append({"record": f"query:{number}", "expr": query})
    file = tmp_path / "queries.yml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "queries", "rules": rules}]}))
    done = subprocess.run(
        [tool("promtool"), "check", "rules", file], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
