"""Prices of a placement per hour, for tables and `--json`: of its bytes, and of its nodes."""

from __future__ import annotations

from dwell.model import Placement, Problem


def placement_prices(
    problem: Problem, placement: Placement, bytes_price: float | None
) -> dict[str, float]:
    """Return the prices that the cell declares, by column of `dwell.study.metric`."""
    prices = {}
    if problem.fabric.has_prices and bytes_price is not None:
        prices["seen_price_per_hour"] = bytes_price
    if problem.fabric.has_node_prices:
        prices["nodes_price_per_hour"] = problem.fabric.price_per_hour(placement.nodes)
    return prices
