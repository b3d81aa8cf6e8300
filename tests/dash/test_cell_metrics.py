"""A live cell's numbers for Prometheus: what they say, what they are called, what is absent."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from cryptography import x509
from prometheus_client.openmetrics.parser import text_string_to_metric_families as openmetrics
from prometheus_client.parser import text_string_to_metric_families as plain_text

from dwell.dash.metrics import CellMetrics
from dwell.live.host.security import Security
from dwell.live.trust.authority import Authority
from dwell.model import evolve
from tests.cells.small import make_problem
from tests.dash.stand_in import StandIn
from tests.live.replicated_cells import replicated
from tests.waiting import wait_until

ROOT = Path(__file__).parents[2]
OPENMETRICS = "application/openmetrics-text;version=1.0.0,text/plain;version=0.0.4;q=0.5,*/*;q=0.1"
PLAIN = "text/plain;version=0.0.4"
MARKUP = "<script>alert(1)</script>"


def samples(cell: StandIn) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Samples by name and labels, without the cell's own."""
    page, _ = CellMetrics(cell.observer).page(PLAIN)
    found = {}
    for family in plain_text(page.decode()):
        for sample in family.samples:
            labels = dict(sample.labels)
            assert labels.pop("cell") == cell.problem.name
            found[sample.name, tuple(sorted(labels.items()))] = sample.value
    return found


def value(cell: StandIn, name: str, **labels: str) -> float | None:
    return samples(cell).get((name, tuple(sorted(labels.items()))))


@pytest.fixture
def cell() -> StandIn:
    cell = StandIn()
    cell.well()
    for number, latency_ms in enumerate((12, 20, 31, 45, None, 28)):
        cell.cycle(number, latency_ms)
    return cell


def test_latencies_are_counted_by_bounds_of_which_one_is_the_deadline(cell: StandIn) -> None:
    deadline = f"{cell.problem.pipeline.deadline_ms / 1e3:g}"
    assert value(cell, "dwell_cycle_latency_seconds_bucket", le="0.02") == 2
    assert value(cell, "dwell_cycle_latency_seconds_bucket", le=deadline) == 4
    assert value(cell, "dwell_cycle_latency_seconds_count") == 5
    assert value(cell, "dwell_cycle_latency_seconds_sum") == pytest.approx(0.136)
    assert value(cell, "dwell_missed_cycles_total") == 2
    assert value(cell, "dwell_cycles_total", outcome="actuated") == 5
    assert value(cell, "dwell_cycles_total", outcome="lost") == 1
    assert value(cell, "dwell_cycles_total", outcome="stale") == 0


def test_a_task_with_two_copies_is_on_two_nodes() -> None:
    cell = StandIn(replicated(), placement="BOTH")
    cell.well()
    assert value(cell, "dwell_placement_info", placement="BOTH") == 1
    for task, nodes in {"perception": ("R1", "E"), "planning": ("R2", "E")}.items():
        for node in nodes:
            assert value(cell, "dwell_task_placement_info", task=task, node=node) == 1


def test_each_cycle_is_counted_once_however_often_somebody_asks(cell: StandIn) -> None:
    metrics = CellMetrics(cell.observer)
    for _ in range(3):
        metrics.page(PLAIN)
    cell.cycle(6, 40)
    page, _ = metrics.page(PLAIN)
    assert f'latency_seconds_count{{cell="{cell.problem.name}"}} 6.0' in page.decode()


def test_cycles_that_it_was_too_slow_for_are_counted_as_such() -> None:
    cell = StandIn(most_cycles=10)
    for number in range(25):
        cell.cycle(number, 20)
    assert value(cell, "dwell_unread_cycles_total") == 15
    assert value(cell, "dwell_cycle_latency_seconds_count") == 10
    assert value(cell, "dwell_cycles_total", outcome="actuated") == 25


def test_cycles_are_counted_though_nobody_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dwell.dash.metrics.EVERY_S", 0.001)
    cell = StandIn(most_cycles=10)
    with CellMetrics(cell.observer) as metrics:
        for number in range(50):
            cell.cycle(number, 20)
            wait_until(lambda: metrics.counted == cell.cycles.upto)
        page, _ = metrics.page(PLAIN)
    name = f'{{cell="{cell.problem.name}"}}'
    assert f"dwell_unread_cycles_total{name} 0.0" in page.decode()
    assert f"dwell_cycle_latency_seconds_count{name} 50.0" in page.decode()


def test_exemplars_name_run_and_cycle(cell: StandIn) -> None:
    page, content_type = CellMetrics(cell.observer).page(OPENMETRICS)
    assert content_type.startswith("application/openmetrics-text; version=1.0.0")
    families = {family.name: family for family in openmetrics(page.decode())}  # type: ignore[no-untyped-call]
    found = {
        sample.labels["le"]: (sample.exemplar.labels, sample.exemplar.value)
        for sample in families["dwell_cycle_latency_seconds"].samples
        if sample.exemplar is not None
    }
    assert found["0.05"] == ({"run": "7", "cycle": "3"}, 0.045)
    assert families["dwell_placement"].type == "info"


def test_ages_of_chains() -> None:
    chain = {"from": "sensing", "to": "control", "max_age_ms": 60.0}
    cell = StandIn(evolve(make_problem(), {"chains": {"reaction": chain}}))
    cell.well()
    assert value(cell, "dwell_chain_age_seconds", chain="reaction") == 0.08
    assert value(cell, "dwell_chain_age_missed_ratio", chain="reaction") == 0.25
    assert value(cell, "dwell_chain_reaction_seconds", chain="reaction") == math.inf


@pytest.mark.parametrize("accept", ["", "*/*", "text/html", PLAIN])
def test_who_asks_for_no_openmetrics_gets_text(cell: StandIn, accept: str) -> None:
    page, content_type = CellMetrics(cell.observer).page(accept)
    assert content_type.startswith("text/plain")
    assert list(plain_text(page.decode()))


def test_what_the_controller_tells(cell: StandIn) -> None:
    assert value(cell, "dwell_health", health="ok") == 1
    assert value(cell, "dwell_health", health="stalled") == 0
    assert value(cell, "dwell_placement_info", placement="LOC") == 1
    assert value(cell, "dwell_task_placement_info", task="perception", node="R1") == 1
    assert value(cell, "dwell_migrations_total", reason="migrate") == 2
    assert value(cell, "dwell_migrations_total", reason="guard") == 1
    assert value(cell, "dwell_migrations_total", reason="pinned") == 0
    assert value(cell, "dwell_utilisation_ratio", node="R1", kind="cpu") == 0.5
    assert value(cell, "dwell_estimated_cost", placement="HYB") == 2.5
    assert value(cell, "dwell_clock_bound_seconds") == 0.00025
    assert value(cell, "dwell_window_unproven") == 0
    assert value(cell, "dwell_violation_ratio") == 0.1
    assert value(cell, "dwell_release_ratio") == 0.75
    assert value(cell, "dwell_silences_total") == 3
    assert value(cell, "dwell_windows_total") == 12
    stage = {"task": "perception", "node": "R1"}
    assert value(cell, "dwell_stage_seconds", **stage, quantile="0.5") == 0.012
    assert value(cell, "dwell_stage_seconds", **stage, quantile="0.95") == 0.02
    assert value(cell, "dwell_stage_inputs_total", **stage, outcome="replaced") == 40
    ends = {"source": "perception@R1", "target": "planning@R2"}
    assert value(cell, "dwell_flow_bytes_total", **ends) == 123_456
    assert value(cell, "dwell_guard_fallback") == 0


def test_what_is_not_known_is_absent(cell: StandIn) -> None:
    assert value(cell, "dwell_utilisation_ratio", node="E", kind="cpu") is None
    assert value(cell, "dwell_estimated_cost", placement="SO") is None
    idle = {"task": "planning", "node": "R2", "quantile": "0.5"}
    assert value(cell, "dwell_stage_seconds", **idle) is None
    cell.status = {**cell.status, "bound_ms": None}
    assert value(cell, "dwell_clock_bound_seconds") is None
    cell.status = {"health": "absent"}
    assert value(cell, "dwell_health", health="absent") == 1
    names = {name for name, _ in samples(cell)}
    assert not names & {"dwell_migrations_total", "dwell_process_heard", "dwell_violation_ratio"}
    assert {"dwell_placement_info", "dwell_cycles_total"} <= names


def test_of_a_cell_of_which_nothing_was_heard_nothing_is_said() -> None:
    cell = StandIn(status={"health": "absent"}, placement="", at_s=0.0)
    assert {name for name, _ in samples(cell)} == {
        *("dwell_health", "dwell_deadline_seconds", "dwell_unread_cycles_total")
    }


def test_who_is_heard(cell: StandIn) -> None:
    processes = {
        **cell.status["processes"],
        "perception@E": {"heard": False, "ready": False, "note": ""},
        "agent@E": {"heard": True, "ready": False, "note": ""},
        # Of no process of the cell.
        MARKUP: {"heard": True, "ready": True, "note": ""},
    }
    del processes["stamper@R1"]
    cell.status = {**cell.status, "processes": processes}
    assert value(cell, "dwell_process_heard", process="perception@E") == 0
    assert value(cell, "dwell_process_ready", process="perception@E") is None
    assert value(cell, "dwell_process_heard", process="stamper@R1") == 0
    assert value(cell, "dwell_process_ready", process="agent@E") == 0
    assert value(cell, "dwell_process_heard", process="planning@R2") == 1


def test_no_text_of_the_cell_becomes_a_label(cell: StandIn) -> None:
    cell.status = {
        **cell.status,
        "health": MARKUP,
        "headline": MARKUP,
        "moves": {MARKUP: 1, "migrate": MARKUP},
        "window": {"estimates": {MARKUP: 1.0}, "utilisation": {MARKUP: 1.0, "R1": MARKUP}},
        "processes": {MARKUP: {"heard": True, "ready": True, "note": MARKUP}},
    }
    cell.placement = MARKUP
    for accept in (PLAIN, OPENMETRICS):
        page, _ = CellMetrics(cell.observer).page(accept)
        assert b"script" not in page


def test_the_days_that_are_left_of_a_certificate_in_use(cell: StandIn) -> None:
    cell.status = {
        **cell.status,
        "certificates": {"R1": {"days": -0.5}, "E": {"days": MARKUP}, MARKUP: {"days": 1.0}},
    }
    assert value(cell, "dwell_certificate_days", subject="R1") == -0.5
    page, _ = CellMetrics(cell.observer).page(PLAIN)
    assert page.count(b"dwell_certificate_days{") == 1


def test_the_ends_of_certificates(cell: StandIn, tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "authority", cell=cell.problem.name)
    authority.issue("E", "node", days=30)
    keyring = SimpleNamespace(roster=authority.roster)
    cell.security = cast("Security", SimpleNamespace(keyring=keyring))
    data = (authority.folder / "E" / "cert.pem").read_bytes()
    expires = x509.load_pem_x509_certificate(data).not_valid_after_utc
    found = value(cell, "dwell_certificate_expiry_timestamp_seconds", subject="E")
    assert found == expires.timestamp()


def test_promtool_finds_nothing_to_complain_of(cell: StandIn) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("no promtool; it is in Debian's package prometheus")
    page, _ = CellMetrics(cell.observer).page(PLAIN)
    done = subprocess.run(
        [promtool, "check", "metrics"], input=page, check=False, capture_output=True
    )
    # Days are what people count certificates in; the other metric has seconds.
    lines = [line for line in done.stderr.splitlines() if b"dwell_certificate_days" not in line]
    assert (done.stdout, lines) == (b"", [])


def test_the_page_of_the_documentation_has_all_metrics(cell: StandIn) -> None:
    families = {family.name: family for family in CellMetrics(cell.observer).collect()}
    text = (ROOT / "docs/reference/metrics.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(dwell_\w+)` \|.*\| (.*) \|$", text, re.MULTILINE))
    suffixes = {"counter": "_total", "info": "_info"}
    assert rows == {
        f"{family.name}{suffixes.get(family.type, '')}": family.documentation
        for family in families.values()
    }
