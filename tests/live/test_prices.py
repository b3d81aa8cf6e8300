"""Prices of links in a live cell, which measures none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tests.live.replayed import SYNCHRONOUS, Clocks, messages_of, recorded, replay, simulate
from tests.live.small_world import canonical


def test_a_live_run_of_links_with_prices_has_no_measured_price(tmp_path: Path) -> None:
    cell = canonical(20, decide_cycles=5, estimator="tests.live.replayed:Dated", fallbacks=())
    links = {name: replace(one, price_per_gb=0.5) for name, one in cell.fabric.links.items()}
    cell = replace(cell, fabric=replace(cell.fabric, links=links))
    played = simulate(cell, "baseline", windows=3, seed=0)
    _, controller, _, _, rows = replay(played, SYNCHRONOUS, messages_of(played, Clocks()))
    live = recorded(tmp_path, controller, rows)
    for table in (live.windows, live.decisions):
        assert table.height > 0
        assert table["seen_price_per_hour"].null_count() == table.height
    assert played.run.windows["seen_price_per_hour"].null_count() == 0
