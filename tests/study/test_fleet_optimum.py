"""The plan against every placement of small random fleets, as the ledger plays them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dwell.control.ledger import FleetLedger
from dwell.study.fleet_plan import plan_fleet
from tests.cells.random_fleets import every_phi, priced_cells, random_fleet

LIMIT = 0.05


@pytest.mark.parametrize("seed", range(6))
def test_no_placements_are_better_than_the_plan_nor_serve_more_cells(seed: int) -> None:
    """Better by half a per cent; of those that serve most cells, too."""
    fleet = random_fleet(seed, most=4)
    # What cells serve is no part of Φ, so both plans are compared with the same plays.
    ledger = FleetLedger(priced_cells(fleet), fleet.shared)
    phi = every_phi(ledger)
    planned = tuple(plan_fleet(fleet).placements.values())
    assert phi[planned] <= 1.005 * min(phi.values())

    served = {placements: served_at(ledger, placements) for placements in phi}
    serving = plan_fleet(replace(fleet, objective="served", limit=LIMIT))
    planned = tuple(serving.placements.values())
    most = max(served.values())
    assert served[planned] == most
    assert phi[planned] <= 1.005 * min(phi[one] for one in phi if served[one] == most)


def served_at(ledger: FleetLedger, placements: tuple[str, ...]) -> int:
    """Return how many cells miss no more than the limit, as played."""
    cells = ledger.prices.price(placements).cells
    return sum(cell is not None and cell.qos.violation_rate <= LIMIT for cell in cells)
